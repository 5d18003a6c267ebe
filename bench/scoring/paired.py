"""Two detectors, or two versions, on the same scenes: what differs, with an interval, and how likely chance alone does that.

Only differences within a scene count, so what makes a scene hard falls out. Success is compared on the scenes where the two disagree
(McNemar, Psychometrika 12, 1947), errors by their differences, pose by pose, since teats and repeats of one pose are not independent.
Knows neither detectors nor runs: `old` and `new` are columns of the same rows.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from math import expm1, log, pi, sqrt
from statistics import NormalDist

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq
from scipy.special import bdtr, ndtr

from bench.scoring.points import Floats, as_values, numbered

FLIPS = 9999
BATCH = 2_000_000  # numbers drawn at once
MANY = 1000  # poses: from here on a sum of random signs is normal to within its own rounding
MOST_POSES = 1_000_000


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

    A value's change counts at most `limit` either way. `low` and `high` are each one-sided bounds
    of confidence (1 + `confidence`) / 2 on the mean over all poses; None where none was compared.
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
    limit: float,
    confidence: float = 0.95,
    seed: int = 0,
) -> PairedDifference:
    """Mean difference new - old of errors (n,) of the same teats, with an interval (`upper_bound`) and the p-value of `sign_flip_p`.

    Each pose counts once, with the mean of its differences.
    """
    differences = pose_differences(old, new, poses, limit=limit)
    if not len(differences):
        return PairedDifference(0, confidence=confidence)
    tail = (1.0 + confidence) / 2.0
    low, high = -upper_bound(-differences, limit, tail), upper_bound(differences, limit, tail)
    p_value = sign_flip_p(differences, seed)
    return PairedDifference(len(differences), float(differences.mean()), low, high, p_value, confidence)


def upper_bound(values: Floats, limit: float, confidence: float) -> float:
    """Upper bound on the mean of what `values` (n,) are independent draws of, none above `limit`.

    The quantile of the mean of the values and, as one that wasn't seen, `limit`, under random
    weights that sum to 1, all such weights alike likely (Gaffke, Mathematical Methods of Statistics
    14, 2005; Learned-Miller and Thomas, arXiv:1905.06208). Clopper and Pearson's bound where values
    are 0 or `limit`. No distribution is known for which it holds less often than it says; that
    there is none isn't proven.
    """
    n, chance = len(values), 1.0 - confidence
    share = -expm1(log(chance) / n)
    low, high = (end + (limit - end) * share for end in (float(values.min()), float(values.max())))  # if all were as this one
    if high - low <= 1e-6 * limit:
        return high
    return float(brentq(lambda mean: _chance_above(values, limit, mean, n) - chance, low, high, xtol=1e-9 * limit))


def poses_to_show(values: Floats, limit: float, margin: float, confidence: float) -> int | None:
    """Fewest poses with differences such as these `values` whose `upper_bound` is at most `margin`; None where MOST_POSES don't do."""
    low, high = 0, 1
    while _chance_above(values, limit, margin, high) > 1.0 - confidence:
        low, high = high, 2 * high
        if high > MOST_POSES:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if _chance_above(values, limit, margin, middle) > 1.0 - confidence else (low, middle)
    return high


def _chance_above(values: Floats, limit: float, mean: float, n: int) -> float:
    """The chance that a mean under random weights exceeds `mean`: of `n` values distributed like `values`, and of `limit`.

    Such weights are shares of gamma variables, so this is the chance that a weighted sum of those
    exceeds 0: its characteristic function inverted (Davies, Applied Statistics 29, 1980).
    """
    offsets, shapes = np.append(values, limit) - mean, np.append(np.full(len(values), n / len(values)), 1.0)
    reach = abs(float(shapes @ offsets)) + 10.0 * sqrt(float(shapes @ offsets**2)) + 35.0 * float(np.abs(offsets).max())
    total, steps = 0.5, np.arange(64) + 0.5
    while True:
        turned = np.outer(2.0 * pi / reach * steps, offsets)
        sizes = np.exp(-0.5 * (np.log1p(turned**2) @ shapes))
        total += float(np.sum(sizes * np.sin(np.arctan(turned) @ shapes) / (pi * steps)))
        if sizes[-1] < 1e-9 or steps[-1] > 2e4:
            return total
        steps += len(steps)


def sign_flip_p(differences: Floats, seed: int = 0, flips: int = FLIPS) -> float:
    """Two-sided p-value of a mean of 0: how often signs thrown at random give a mean as far from 0 (Fisher, The Design of Experiments, 21).

    All 2^n signs where they are at most `flips`, else that many at random and the one seen; for more than MANY values the normal limit.
    """
    values = differences[differences != 0.0]
    n = len(values)
    if n == 0:
        return 1.0
    seen = abs(float(values.sum())) * (1.0 - 1e-12)
    if 2**n <= flips:
        signs = 1.0 - 2.0 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1)
        return float(np.mean(np.abs(signs @ values) >= seen))
    if n > MANY:
        return 2.0 * float(ndtr(-seen / sqrt(float(values @ values))))
    rng, extreme, left = np.random.default_rng(seed), 0, flips
    while left:
        rows = min(left, max(1, BATCH // n))
        sums = (1.0 - 2.0 * rng.integers(0, 2, (rows, n), dtype=np.int8)) @ values
        extreme, left = extreme + int((np.abs(sums) >= seen).sum()), left - rows
    return (extreme + 1) / (flips + 1)


def pose_differences(old: npt.ArrayLike, new: npt.ArrayLike, poses: Sequence[Hashable] | None = None, *, limit: float) -> Floats:
    """The mean of new - old of each pose (p,), at most `limit` a row either way, poses in order of appearance.

    Without `poses` each row is a pose of its own.
    """
    a, b = as_values(old, "old errors"), as_values(new, "new errors")
    if len(a) != len(b):
        raise ValueError(f"paired errors: {len(a)} old and {len(b)} new ones; give both for the same teats, in the same order")
    changes = np.clip(b - a, -limit, limit)
    if poses is None:
        return changes
    if len(poses) != len(a):
        raise ValueError(f"paired errors: {len(poses)} pose names for {len(a)} values; give the pose of each value")
    codes = numbered(poses)
    return np.asarray(np.bincount(codes, changes) / np.bincount(codes), dtype=np.float64) if len(codes) else changes


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
