"""Two detectors, or two versions, on the same scenes: what differs, with an interval, how likely
chance alone does that, and whether the new one is worse.

Only differences within a scene count. Success, false teats and misses are compared as counted,
success where the two disagree (McNemar, Psychometrika 12, 1947); errors by the differences on teats
that both found, a pose once, each change up to the limit (beyond it a teat has failed).

The gate: a scene lost, a false teat or a miss more, or a mean error (distance, or absolute along an
axis) larger by more than the margin is worse. No worse is shown only where the upper bound of the
distance's change over all poses, those not run included, stays within the margin (non-inferiority;
ICH E9, 3.3.2). A situation whose mean distance grew by more than the margin is worse where chance,
adjusted for all situations, doesn't explain it; else the gate is inconclusive.

A further look at what was compared before takes half of the chance that earlier ones left, for a
bound that holds at every number of poses (`sequential`): the first look is one-sided and has half
of 1 - confidence, all that follow have the other half.

Of thousands of scenes some are always lost and others won. With a margin of the rate not each lost
one is worse, but a share of right ones that fell by more than it, in all or a situation, where
chance doesn't explain it; no worse is shown only where its interval stays within.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from math import expm1, log, pi, sqrt
from statistics import NormalDist

import numpy as np
import numpy.typing as npt
import scipy

from bench.scoring.decisions import Verdict
from bench.scoring.errors import Floats, as_values, numbered
from bench.scoring.matching import Counts, counted
from bench.scoring.rates import Rate, crossing, exact_percent, fewest, percent
from bench.scoring.scene import SceneScore
from bench.scoring.sequential import least_mean, least_rate, shows_mean
from textfiles.text import plural

FLIPS = 9999  # of signs, at random
BATCH = 2_000_000  # numbers drawn at once
MANY = 1000  # poses: from here on a sum of random signs is normal to within its own rounding
MOST_POSES = 1_000_000


@dataclass(frozen=True, slots=True)
class Discordance:
    """Scenes (or poses) by who succeeded."""

    both: int = 0
    only_old: int = 0
    only_new: int = 0
    neither: int = 0

    @property
    def n(self) -> int:
        """All scenes."""
        return self.both + self.only_old + self.only_new + self.neither

    @property
    def difference(self) -> float | None:
        """Success rate, new less old, -1 to 1; None where nothing was compared."""
        return (self.only_new - self.only_old) / self.n if self.n else None

    @property
    def p_value(self) -> float:
        """Exact two-sided McNemar: the discordant scenes' binomial test against one half."""
        discordant, fewer = self.only_old + self.only_new, min(self.only_old, self.only_new)
        return min(1.0, 2.0 * float(scipy.special.bdtr(fewer, discordant, 0.5)))

    def interval(self, confidence: float = 0.95) -> tuple[float, float] | None:
        """Score interval of `difference` (Tango, Statistics in Medicine 17, 1998), approximate: the
        exact `p_value` decides. None where nothing was compared.
        """
        estimate = self.difference
        if estimate is None:
            return None
        z = NormalDist().inv_cdf((1.0 + confidence) / 2.0)
        return (
            crossing(lambda d: self._score(d) - z, -1.0, estimate),
            crossing(lambda d: self._score(d) + z, estimate, 1.0),
        )

    def _score(self, difference: float) -> float:
        """Tango's statistic (b - c - n d) / sqrt(n (2 q + d (1 - d))), q the likeliest share of
        `only_old` under the difference d.
        """
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
    """Mean over poses of new - old; `low` and `high` are one-sided bounds of confidence (1 +
    `confidence`) / 2. None where nothing was compared. ``capped``: of ``rows`` those whose change
    counts as the limit, which it exceeds.
    """

    poses: int
    mean: float | None = None
    low: float | None = None
    high: float | None = None
    p_value: float | None = None
    confidence: float = 0.95
    capped: int = 0
    rows: int = 0


def discordance(old: npt.ArrayLike, new: npt.ArrayLike) -> Discordance:
    """Who succeeded in each scene, from two columns (n,). Raises ValueError for two lengths."""
    a, b = np.asarray(old, dtype=np.bool_).ravel(), np.asarray(new, dtype=np.bool_).ravel()
    if a.shape != b.shape:
        raise ValueError(
            f"paired successes: {len(a)} old and {len(b)} new ones; give both for the same scenes,"
            " in the same order"
        )
    return Discordance(
        int((a & b).sum()), int((a & ~b).sum()), int((~a & b).sum()), int((~a & ~b).sum())
    )


def paired_difference(
    old: npt.ArrayLike,
    new: npt.ArrayLike,
    poses: Sequence[Hashable] | None = None,
    *,
    limit: float,
    confidence: float = 0.95,
    seed: int = 0,
) -> PairedDifference:
    """Mean of new - old over poses, with its bounds and p-value."""
    differences = pose_differences(old, new, poses, limit=limit)
    if not len(differences):
        return PairedDifference(0, confidence=confidence)
    tail = (1.0 + confidence) / 2.0
    low, high = -upper_bound(-differences, limit, tail), upper_bound(differences, limit, tail)
    p_value = sign_flip_p(differences, seed)
    changes = np.abs(as_values(new, "new errors") - as_values(old, "old errors"))
    figures = float(differences.mean()), low, high, p_value, confidence
    capped = int((changes > limit).sum())
    return PairedDifference(len(differences), *figures, capped=capped, rows=len(changes))


def upper_bound(values: Floats, limit: float, confidence: float) -> float:
    """Upper bound on the mean of what `values` (n,) are independent draws of, none above `limit`.

    The quantile of the mean of the values and, as one that wasn't seen, `limit`, under uniform
    random weights that sum to 1 (Gaffke, Mathematical Methods of Statistics 14, 2005;
    Learned-Miller and Thomas, arXiv:1905.06208). Clopper and Pearson's bound where values are 0 or
    `limit`. No counterexample to its confidence is known, nor a proof.
    """
    n, chance = len(values), 1.0 - confidence
    share = -expm1(log(chance) / n)
    # if all were as this one
    low, high = (end + (limit - end) * share for end in (float(values.min()), float(values.max())))
    if high - low <= 1e-6 * limit:
        return high
    return crossing(lambda mean: _chance_above(values, limit, mean, n) - chance, low, high)


def _chance_above(values: Floats, limit: float, mean: float, n: int) -> float:
    """The chance that the mean under random weights of `n` values like these, and of `limit`,
    exceeds `mean`: that of a weighted sum of gamma variables to exceed 0, its characteristic
    function inverted (Davies, Applied Statistics 29, 1980).
    """
    offsets = np.append(values, limit) - mean
    shapes = np.append(np.full(len(values), n / len(values)), 1.0)
    reach = abs(float(shapes @ offsets)) + 10.0 * sqrt(float(shapes @ offsets**2))
    reach += 35.0 * float(np.abs(offsets).max())
    total, steps = 0.5, np.arange(64) + 0.5
    while True:
        turned = np.outer(2.0 * pi / reach * steps, offsets)
        sizes = np.exp(-0.5 * (np.log1p(turned**2) @ shapes))
        total += float(np.sum(sizes * np.sin(np.arctan(turned) @ shapes) / (pi * steps)))
        if sizes[-1] < 1e-9 or steps[-1] > 2e4:
            return total
        steps += len(steps)


def sign_flip_p(differences: Floats, seed: int = 0) -> float:
    """Two-sided p-value of a mean of 0 under random signs (Fisher, The Design of Experiments, 21):
    all 2^n where at most FLIPS, else that many and the one seen; above MANY values the normal
    limit.
    """
    values = differences[differences != 0.0]
    n = len(values)
    if n == 0:
        return 1.0
    total = float(values.sum())
    seen = abs(total) * (1.0 - 1e-12)
    if 2**n <= FLIPS:
        signs = 1.0 - 2.0 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1)
        return float(np.mean(np.abs(signs @ values) >= seen))
    if n > MANY:
        return 2.0 * float(scipy.special.ndtr(-seen / sqrt(float(values @ values))))
    rng, extreme, left = np.random.default_rng(seed), 0, FLIPS
    while left:
        rows = min(left, max(1, BATCH // n))
        sums = total - 2.0 * (rng.integers(0, 2, (rows, n), dtype=np.int8) @ values)
        extreme, left = extreme + int((np.abs(sums) >= seen).sum()), left - rows
    return (extreme + 1) / (FLIPS + 1)


def pose_differences(
    old: npt.ArrayLike, new: npt.ArrayLike, poses: Sequence[Hashable] | None = None, *, limit: float
) -> Floats:
    """Mean of new - old of each pose (p,), clipped to `limit`; without `poses`, of each row."""
    a, b = as_values(old, "old errors"), as_values(new, "new errors")
    names = range(len(a)) if poses is None else poses
    if not len(a) == len(b) == len(names):
        raise ValueError(
            f"paired errors: {len(a)} old and {len(b)} new ones with {len(names)} pose names; give"
            " all for the same teats, in the same order"
        )
    codes, changes = numbered(names), np.clip(b - a, -limit, limit)
    return np.asarray(np.bincount(codes, changes) / np.bincount(codes), dtype=np.float64)


def holm(p_values: Sequence[float]) -> tuple[float, ...]:
    """Adjusted p-values of several questions asked at once, in the given order (Holm, Scandinavian
    Journal of Statistics 6, 1979): below 0.05 is significant with 5 % for the whole family.
    """
    p = np.asarray(p_values, dtype=np.float64)
    if not ((p >= 0.0) & (p <= 1.0)).all():
        raise ValueError(f"p-values {list(p_values)}: one is not between 0 and 1")
    order, adjusted = np.argsort(p, kind="stable"), np.empty(len(p))
    steps = np.minimum(1.0, np.arange(len(p), 0, -1) * p[order])
    adjusted[order] = np.maximum.accumulate(steps)
    return tuple(adjusted.tolist())


ALPHA = 0.05


def fewest_that_show(questions: int = 1) -> int:
    """How many poses that all point one way chance doesn't explain: by signs, and by who succeeded,
    n such have p = 2^(1 - n), as one of ``questions`` asked at once.
    """
    return fewest(lambda n: questions * 2.0 ** (1 - n) < ALPHA, 0)


def chance_text(n: int, what: str, questions: int = 1) -> str:
    """Why a difference in ``n`` poses is not taken as real: by their number alone, or perhaps by
    chance. ``what``: which poses count.
    """
    least = fewest_that_show(questions)
    if n >= least:
        return "which may be chance"
    return f"but {plural(n, 'pose')} {what} can show nothing by themselves: {least} can"


MARGIN_SHARE = 0.05  # of the error's limit: the margin where none is named


@dataclass(frozen=True, slots=True)
class ScenePair:
    """One scene scored for both. Repeats of a pose share `pose`. ``same``: the very same answer, of
    which a score doesn't tell, where one missed or invented end is as good as another.
    """

    scene: str
    pose: str
    situation: str
    old: SceneScore
    new: SceneScore
    same: bool = True


@dataclass(frozen=True, slots=True)
class ComparisonRow:
    """What differs in one situation, or in all (None): errors in mm of teats that both found,
    `success` in poses. `_holm`: adjusted over the situations.
    """

    situation: str | None
    scenes: int
    poses: int
    teats: int
    success: Discordance
    radial: PairedDifference
    axes: tuple[PairedDifference, PairedDifference, PairedDifference]
    old: Counts
    new: Counts
    success_holm: float | None = None
    radial_holm: float | None = None


@dataclass(frozen=True, slots=True)
class Gate:
    """NOT_MET: the new one is worse. MET: it is shown to be no worse. One reason a line."""

    verdict: Verdict
    reasons: tuple[str, ...]
    margin_mm: float
    margin_rate: float | None = None


@dataclass(frozen=True, slots=True)
class PairedComparison:
    """The whole comparison: pooled, by situation, and the gate."""

    pooled: ComparisonRow
    situations: tuple[ComparisonRow, ...]
    gate: Gate
    confidence: float
    identical: bool = False


def compare(
    pairs: Sequence[ScenePair],
    *,
    margin_mm: float | None = None,
    margin_rate: float | None = None,
    confidence: float = 0.95,
    seed: int = 0,
    unpaired: int = 0,
    again: int = 0,
) -> PairedComparison:
    """Compare on `pairs`. `margin_mm` is by default a twentieth of the limit; without `margin_rate`
    each scene lost counts. ``again``: earlier looks of the gate. Raises ValueError.
    """
    if not pairs:
        raise ValueError("compare: the two have no scene in common")
    for pair in pairs:
        if pair.old.limit_mm != pair.new.limit_mm:
            limits = f"{pair.old.limit_mm:g} mm and {pair.new.limit_mm:g} mm"
            raise ValueError(
                f"compare: {pair.scene} was scored within {limits}; score both by the same rules"
            )
    margin = MARGIN_SHARE * _limit_mm(pairs) if margin_mm is None else margin_mm
    if not 0.0 <= margin < float("inf"):
        raise ValueError(f"margin: {margin} mm must be 0 or more")
    parts: dict[str, list[ScenePair]] = {}
    for pair in pairs:
        parts.setdefault(pair.situation, []).append(pair)
    pooled = _row(None, pairs, confidence, seed)
    rows = [_row(name, part, confidence, seed) for name, part in parts.items()]
    success = holm([row.success.p_value for row in rows])
    radial = iter(holm([p for row in rows if (p := row.radial.p_value) is not None]))
    situations = tuple(
        replace(
            row, success_holm=p, radial_holm=None if row.radial.p_value is None else next(radial)
        )
        for row, p in zip(rows, success, strict=True)
    )
    several = situations if len(situations) > 1 else ()
    verdict = gate(pairs, pooled, margin, unpaired, several, margin_rate, again)
    # to the last bit
    identical = not unpaired and all(pair.same for pair in pairs)
    identical = identical and all(
        (old.counts, old.match.pairs) == (new.counts, new.match.pairs)
        and np.array_equal(old.errors_mm, new.errors_mm)
        for old, new in ((pair.old, pair.new) for pair in pairs)
    )
    if identical and verdict.verdict is Verdict.INCONCLUSIVE:
        chance, n = (1.0 - confidence) / 2.0 ** (1 + again), pooled.poses
        unseen = Rate(0, n).upper_bound(1.0 - chance) or 0.0
        most = percent(1.0 - least_rate(n, n, chance) if again else unseen)
        same = (
            f"identical answers in all {plural(len(pairs), 'frame set')}: nothing changed in these;"
            f" of other poses at most {most} have another answer ({plural(n, 'pose')},"
            f" {exact_percent(1.0 - chance)} confidence)"
        )
        # a margin of the rate says itself what scenes that were not run may hide
        reasons = (same,) if margin_rate is None else (same, *verdict.reasons)
        verdict = replace(verdict, reasons=reasons)
    return PairedComparison(pooled, situations, verdict, confidence, identical)


def gate(
    pairs: Sequence[ScenePair],
    pooled: ComparisonRow,
    margin_mm: float,
    unpaired: int = 0,
    situations: Sequence[ComparisonRow] = (),
    margin_rate: float | None = None,
    again: int = 0,
) -> Gate:
    """Is the new one worse on these scenes?"""
    chance = (1.0 - pooled.radial.confidence) / 2.0 ** (1 + again)
    worse, left_open = (
        _lost(pairs, pooled)
        if margin_rate is None
        else _fewer_right(pooled, situations, margin_rate, chance if again else None)
    )
    names = ("distance to the teat end", "error along x", "error along y", "error along z")
    for what, change in zip(names, (pooled.radial, *pooled.axes), strict=True):
        if change.mean is not None and change.mean > margin_mm:
            by = f"{_changed(change)}, more than the margin of {margin_mm:g} mm"
            worse.append(f"the mean {what} {by}")
    shown, perhaps = _grown_in(situations, margin_mm)
    worse, left_open = worse + shown, left_open + perhaps
    if worse:
        return Gate(Verdict.NOT_MET, tuple(worse), margin_mm, margin_rate)
    if unpaired:
        were = f"{plural(unpaired, 'scene')} of the old one {'was' if unpaired == 1 else 'were'}"
        left_open.append(f"{were} not run with the new one")
    high, tail, failing = _not_run(pairs, pooled, chance, again)
    if high is None:
        left_open.append("no teat was found by both, so no error was compared")
    elif high > margin_mm:
        needed = _needed(pairs, margin_mm, chance / 2.0)
        left_open.append(
            f"the mean distance {_changed(pooled.radial)} in"
            f" {plural(pooled.radial.poses, 'pose')}; poses that were not run may hide that it grew"
            f" by {high:.2f} mm (margin {margin_mm:g} mm): {needed}"
        )
    if left_open:
        return Gate(Verdict.INCONCLUSIVE, tuple(left_open), margin_mm, margin_rate)
    if high is None:
        raise AssertionError("left open above")
    grew = f"grew by at most {high:.2f} mm" if high >= 0 else f"shrank by at least {-high:.2f} mm"
    lost = f"at most {percent(failing)} of poses are lost anew ({plural(pooled.poses, 'pose')}, "
    bounds = (
        f"over all poses the mean distance {grew} (margin {margin_mm:g} mm) and {lost}"
        f"{exact_percent(tail)} confidence each, one-sided)"
    )
    if margin_rate is not None:
        fell = f"the share of right ones fell by at most {percent(margin_rate)}"
        bounds = f"over all poses the mean distance {grew}, and {fell}"
        return Gate(Verdict.MET, (bounds,), margin_mm, margin_rate)
    return Gate(Verdict.MET, ("no scene lost, no false or missed teat more", bounds), margin_mm)


def _changed(change: PairedDifference) -> str:
    """``grew by 5.00 mm or more``, of one that was measured."""
    if change.mean is None:
        raise ValueError("nothing was compared")
    more = " or more" if change.capped else ""
    return f"{'shrank' if round(change.mean, 2) < 0 else 'grew'} by {abs(change.mean):.2f} mm{more}"


def _not_run(
    pairs: Sequence[ScenePair], pooled: ComparisonRow, chance: float, again: int
) -> tuple[float | None, float, float]:
    """What poses that were not run may hide: how much the mean distance grew at most, with which
    confidence, and which share of poses is lost anew at most.
    """
    high, tail = pooled.radial.high, 1.0 - chance
    if not again:
        tail = (1.0 + pooled.radial.confidence) / 2.0
        return high, tail, Rate(0, pooled.poses).upper_bound(tail) or 0.0
    if high is not None:
        high = bound_again(_changes(pairs), _limit_mm(pairs), chance)
    return high, tail, 1.0 - least_rate(pooled.poses, pooled.poses, chance)


def _lost(pairs: Sequence[ScenePair], pooled: ComparisonRow) -> tuple[list[str], list[str]]:
    """Every scene lost is worse, and every false or missed teat more; nothing is left open."""
    worse = [
        f"{pair.scene} passed and now fails: {why_failed(pair.new)}"
        for pair in pairs
        if pair.old.success and not pair.new.success
    ]
    for what in ("false", "missed"):
        old, new = getattr(pooled.old, what), getattr(pooled.new, what)
        if new > old:
            worse.append(f"{plural(new - old, f'{what} teat')} more ({new} instead of {old})")
    return worse, []


def _fewer_right(
    pooled: ComparisonRow, situations: Sequence[ComparisonRow], margin: float, chance: float | None
) -> tuple[list[str], list[str]]:
    """Where the share of right poses fell by more than the margin: shown, and perhaps by chance."""
    shown, perhaps = [], []
    for row in (pooled, *situations):
        won, p = row.success, row.success.p_value if row.success_holm is None else row.success_holm
        fell = -(won.difference or 0.0)
        span = won.interval(pooled.radial.confidence)
        where = f"in {row.situation} the" if row.situation else "the"
        text = (
            f"{where} share of right poses fell by {100 * fell:.1f} % points (lost"
            f" {won.only_old}, won {won.only_new} of {won.n}; margin {100 * margin:g})"
        )
        if fell > margin and p < ALPHA:
            shown.append(f"{text}, p {f'= {p:.3f}' if p >= 0.0005 else '< 0.001'}")
        elif fell > margin:
            differ = won.only_old + won.only_new
            perhaps.append(f"{text}, {chance_text(differ, 'that differ', len(situations) or 1)}")
        elif row is pooled and (most := most_fallen(won, span, chance)) > margin:
            perhaps.append(
                f"poses that were not run may hide that the share of right ones fell by"
                f" {100 * most:.1f} % points (margin {100 * margin:g})"
            )
    return shown, perhaps


def most_fallen(won: Discordance, span: tuple[float, float] | None, chance: float | None) -> float:
    """How much the share of right poses fell at most: by its interval at a first look, at every
    look but for the ``chance`` at a further one.
    """
    if chance is None or not won.n:
        return -span[0] if span else 0.0
    counts = (won.only_old, won.both + won.neither, won.only_new)
    return 1.0 - least_mean((0.0, 1.0, 2.0), counts, chance)


def bound_again(values: Floats, limit: float, chance: float) -> float:
    """As `upper_bound`, at every look but for the ``chance``."""
    return limit - least_mean(limit - values, 1.0, chance)


def poses_again(values: Floats, limit: float, margin: float, chance: float) -> int | None:
    """Fewest such poses with `bound_again` at most `margin`; None beyond MOST_POSES."""

    def shows(poses: int) -> bool:
        counts = poses / len(values)
        return shows_mean(limit - values, counts, limit - margin, chance)

    return fewest(shows, 0) if shows(MOST_POSES) else None


def _grown_in(situations: Sequence[ComparisonRow], margin_mm: float) -> tuple[list[str], list[str]]:
    """Situations whose mean distance grew by more than the margin: shown, and perhaps by chance."""
    shown, perhaps = [], []
    for row in situations:
        by, p = row.radial.mean, row.radial_holm
        if by is None or by <= margin_mm:
            continue
        grew = f"in {row.situation} the mean distance to the teat end grew by {by:.2f} mm"
        if p is not None and p < ALPHA:
            shown.append(f"{grew}, more than the margin of {margin_mm:g} mm (adjusted p = {p:.3f})")
        else:
            n, asked = row.radial.poses, len(situations)
            few = chance_text(n, "of it", asked)
            chance = f"which {n} poses don't distinguish from chance: compare on more poses of it"
            perhaps.append(f"{grew}, {few if n < fewest_that_show(asked) else chance}")
    return shown, perhaps


def poses_needed(pairs: Sequence[ScenePair], margin_mm: float, chance: float) -> int | None:
    """How many poses, these with them, show at a further look that those not run hide nothing, but
    for the ``chance``; None where no number does.
    """
    changes = _changes(pairs)
    return poses_again(changes, _limit_mm(pairs), margin_mm, chance) if len(changes) else None


def _changes(pairs: Sequence[ScenePair]) -> Floats:
    """How the mean distance changed in each pose."""
    old, new, poses = common_errors(pairs)
    distances = np.linalg.norm(old, axis=1), np.linalg.norm(new, axis=1)
    return pose_differences(*distances, poses, limit=_limit_mm(pairs))


def _needed(pairs: Sequence[ScenePair], margin_mm: float, chance: float) -> str:
    needed = poses_needed(pairs, margin_mm, chance)
    if needed is None:
        return "no number of poses with such changes shows less"
    return f"{needed} poses with such changes, these among them, show less at a further look"


def why_failed(score: SceneScore) -> str:
    """What made a scene fail, in words."""
    counts, worst = score.counts, max(score.radial_mm, default=0.0)
    reasons = {
        f"{counts.missed} missed": counts.missed,
        f"{counts.false} false": counts.false,
        f"{worst:.2f} mm off (limit {score.limit_mm:g} mm)": worst > score.limit_mm,
        f"too slow ({score.seconds:.2f} s)": not score.in_time,
    }
    return ", ".join(text for text, holds in reasons.items() if holds) or "it succeeded"


def common_errors(pairs: Iterable[ScenePair]) -> tuple[Floats, Floats, list[str]]:
    """Errors (k, 3) of the teats that both found, old and new, with the pose of each row."""
    olds, news, poses = [np.zeros((0, 3))], [np.zeros((0, 3))], []
    for pair in pairs:
        at = {teat: row for row, (_, teat) in enumerate(pair.new.match.pairs)}
        rows = [(row, at[teat]) for row, (_, teat) in enumerate(pair.old.match.pairs) if teat in at]
        olds.append(pair.old.errors_mm[[row for row, _ in rows]])
        news.append(pair.new.errors_mm[[row for _, row in rows]])
        poses += [pair.pose] * len(rows)
    return np.concatenate(olds), np.concatenate(news), poses


def _limit_mm(pairs: Iterable[ScenePair]) -> float:
    return min(pair.old.limit_mm for pair in pairs)


def _row(
    situation: str | None, pairs: Sequence[ScenePair], confidence: float, seed: int
) -> ComparisonRow:
    old, new, poses = common_errors(pairs)

    def differ(a: Floats, b: Floats) -> PairedDifference:
        limit = _limit_mm(pairs)
        return paired_difference(a, b, poses, limit=limit, confidence=confidence, seed=seed)

    x, y, z = (differ(np.abs(old[:, k]), np.abs(new[:, k])) for k in range(3))
    # a pose succeeds when all its repeats do
    names = dict.fromkeys(pair.pose for pair in pairs)
    lost = (
        {pair.pose for pair in pairs if not pair.old.success},
        {pair.pose for pair in pairs if not pair.new.success},
    )
    return ComparisonRow(
        situation=situation,
        scenes=len(pairs),
        poses=len(names),
        teats=len(old),
        success=discordance(*([name not in failed for name in names] for failed in lost)),
        radial=differ(np.linalg.norm(old, axis=1), np.linalg.norm(new, axis=1)),
        axes=(x, y, z),
        old=counted(pair.old.match for pair in pairs),
        new=counted(pair.new.match for pair in pairs),
    )
