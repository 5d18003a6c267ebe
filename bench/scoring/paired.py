"""Two detectors, or two versions, on the same scenes: what differs, with an interval, and how likely chance alone does that.

Only differences within a scene count, so what makes a scene hard falls out. Success is compared on the scenes where the two disagree
(McNemar, Psychometrika 12, 1947), errors by their differences, resampled by pose (Efron, JASA 82, 1987), since teats and repeats of one
pose are not independent. Knows neither detectors nor runs: `old` and `new` are columns of the same rows.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from math import sqrt
from statistics import NormalDist

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq
from scipy.special import bdtr
from scipy.stats import bootstrap, ttest_1samp

from bench.scoring.points import Floats, as_values, numbered

RESAMPLES = 9999
BATCH = 2_000_000  # numbers drawn at once
FEW = 10  # poses: resampling fewer knows too little of the spread, and its interval is too narrow
MANY = 1000  # poses: from here on the mean is normal to within its own rounding, and Student's interval is the same


@dataclass(frozen=True, slots=True)
class Discordance:
    """Scenes (or poses) by who succeeded; adds field by field."""

    both: int = 0
    only_old: int = 0
    only_new: int = 0
    neither: int = 0

    def __add__(self, other: Discordance) -> Discordance:
        return Discordance(
            self.both + other.both, self.only_old + other.only_old, self.only_new + other.only_new, self.neither + other.neither
        )

    @property
    def n(self) -> int:
        """All scenes."""
        return self.both + self.only_old + self.only_new + self.neither

    @property
    def difference(self) -> float | None:
        """Success rate of the new one less that of the old one, from -1 to 1; None where nothing was compared."""
        return (self.only_new - self.only_old) / self.n if self.n else None

    @property
    def p_value(self) -> float:
        """Exact two-sided McNemar: the binomial test of the discordant scenes against one half; 1 where there are none."""
        discordant = self.only_old + self.only_new
        return min(1.0, 2.0 * float(bdtr(min(self.only_old, self.only_new), discordant, 0.5))) if discordant else 1.0

    def interval(self, confidence: float = 0.95) -> tuple[float, float] | None:
        """Score interval of `difference` (Tango, Statistics in Medicine 17, 1998); None where nothing was compared.

        It has a width also where no scene is discordant. It is approximate, `p_value` is exact: where the two disagree, `p_value` decides.
        """
        estimate = self.difference
        if estimate is None:
            return None
        z = NormalDist().inv_cdf((1.0 + confidence) / 2.0)
        return _crossing(lambda d: self._score(d) - z, -1.0, estimate), _crossing(lambda d: self._score(d) + z, estimate, 1.0)

    def _score(self, difference: float) -> float:
        """Tango's statistic (b - c - n d) / sqrt(n (2 q + d (1 - d))), q the likeliest share of `only_old` under the difference d."""
        n, b, c = self.n, self.only_new, self.only_old
        p = -b - c + (2 * n - b + c) * difference
        root = max(0.0, p * p + 8.0 * n * c * difference * (1.0 - difference))
        q = (sqrt(root) - p) / (4.0 * n)
        variance = n * (2.0 * q + difference * (1.0 - difference))
        offset = b - c - n * difference
        if variance <= 1e-12 * n:
            return 0.0 if abs(offset) < 1e-9 * n else float(np.copysign(1e9, offset))
        return offset / sqrt(variance)


@dataclass(frozen=True, slots=True)
class PairedDifference:
    """Mean over poses of new - old, in the values' unit; below 0 the new one is better where the values are errors.

    `low` and `high` are each one-sided bounds of confidence (1 + `confidence`) / 2, None where fewer than two poses were compared.
    """

    poses: int
    mean: float | None = None
    low: float | None = None
    high: float | None = None
    p_value: float | None = None
    confidence: float = 0.95


def discordance(old: npt.ArrayLike, new: npt.ArrayLike) -> Discordance:
    """Who succeeded in each scene: two columns (n,) of true and false. Raises ValueError where their lengths differ."""
    a, b = np.asarray(old, dtype=np.bool_).ravel(), np.asarray(new, dtype=np.bool_).ravel()
    if a.shape != b.shape:
        raise ValueError(f"paired successes: {len(a)} old and {len(b)} new ones; give both for the same scenes, in the same order")
    return Discordance(int((a & b).sum()), int((a & ~b).sum()), int((~a & b).sum()), int((~a & ~b).sum()))


def paired_difference(
    old: npt.ArrayLike,
    new: npt.ArrayLike,
    poses: Sequence[Hashable] | None = None,
    *,
    confidence: float = 0.95,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> PairedDifference:
    """Mean difference new - old of errors (n,) of the same teats, with a bootstrap interval over poses (BCa; `seed` draws the resamples).

    Each pose counts once, with the mean of its differences. The p-value is that of the sign-flip test (`sign_flip_p`). For fewer than FEW
    poses the interval is Student's, for more than MANY both are.
    """
    differences = pose_differences(old, new, poses)
    n = len(differences)
    if n == 0:
        return PairedDifference(0, confidence=confidence)
    mean = float(differences.mean())
    if n == 1:
        return PairedDifference(1, mean, confidence=confidence)
    if float(np.ptp(differences)) <= 1e-12 * max(1.0, abs(mean)):  # all alike: nothing to resample, and BCa isn't defined
        return PairedDifference(n, mean, mean, mean, sign_flip_p(differences, seed), confidence)
    if not FEW <= n <= MANY:
        test = ttest_1samp(differences, 0.0)
        low, high = test.confidence_interval(confidence)
        p_value = float(test.pvalue) if n > MANY else sign_flip_p(differences, seed)
        return PairedDifference(n, mean, float(low), float(high), p_value, confidence)
    found = bootstrap(
        (differences,), np.mean, n_resamples=resamples, batch=max(1, BATCH // n), confidence_level=confidence,
        method="BCa", vectorized=True, rng=np.random.default_rng(seed),
    )  # fmt: skip
    low, high = (float(v) for v in found.confidence_interval)
    return PairedDifference(n, mean, low, high, sign_flip_p(differences, seed), confidence)


def sign_flip_p(differences: Floats, seed: int = 0, flips: int = RESAMPLES) -> float:
    """Two-sided p-value of a mean of 0: how often signs thrown at random give a mean as far from 0 (Fisher, The Design of Experiments, 21).

    All 2^n signs where they are at most `flips`, else that many at random and the one seen.
    """
    values = differences[differences != 0.0]
    n = len(values)
    if n == 0:
        return 1.0
    seen = abs(float(values.sum())) * (1.0 - 1e-12)
    if 2**n <= flips:
        signs = 1.0 - 2.0 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1)
        return float(np.mean(np.abs(signs @ values) >= seen))
    rng, extreme, left = np.random.default_rng(seed), 0, flips
    while left:
        rows = min(left, max(1, BATCH // n))
        sums = (1.0 - 2.0 * rng.integers(0, 2, (rows, n), dtype=np.int8)) @ values
        extreme, left = extreme + int((np.abs(sums) >= seen).sum()), left - rows
    return (extreme + 1) / (flips + 1)


def pose_differences(old: npt.ArrayLike, new: npt.ArrayLike, poses: Sequence[Hashable] | None = None) -> Floats:
    """The mean of new - old of each pose (p,), poses in order of appearance; without `poses` each row is a pose of its own."""
    a, b = as_values(old, "old errors"), as_values(new, "new errors")
    if len(a) != len(b):
        raise ValueError(f"paired errors: {len(a)} old and {len(b)} new ones; give both for the same teats, in the same order")
    if poses is None:
        return b - a
    if len(poses) != len(a):
        raise ValueError(f"paired errors: {len(poses)} pose names for {len(a)} values; give the pose of each value")
    codes = numbered(poses)
    return np.asarray(np.bincount(codes, b - a) / np.bincount(codes), dtype=np.float64) if len(codes) else b - a


def holm(p_values: Sequence[float]) -> tuple[float, ...]:
    """Adjusted p-values of several questions asked at once, in the given order (Holm, Scandinavian Journal of Statistics 6, 1979).

    A question whose adjusted value is below 0.05 is significant with 5 % for the whole family.
    """
    order = sorted(range(len(p_values)), key=lambda k: p_values[k])
    adjusted = [1.0] * len(p_values)
    highest = 0.0
    for rank, k in enumerate(order):
        if not 0.0 <= p_values[k] <= 1.0:
            raise ValueError(f"p-value {p_values[k]} is not between 0 and 1")
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[k]))
        adjusted[k] = highest
    return tuple(adjusted)


def _crossing(function: Callable[[float], float], low: float, high: float) -> float:
    """Where a falling function crosses 0 between `low` and `high`; the end that it doesn't leave where it doesn't."""
    if low == high or function(low) <= 0.0:
        return low
    return high if function(high) >= 0.0 else float(brentq(function, low, high, xtol=1e-10))
