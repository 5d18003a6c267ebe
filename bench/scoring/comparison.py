"""A new detector against an old one on the same scenes: paired differences by situation, and whether the new one is worse.

Success, false teats and misses are compared as they are counted; errors only on teats that both found, for a difference needs two. An
error's change counts up to the limit: a teat farther off has failed, and failures are counted. The gate asks one thing, "is it worse?": a
scene that passed and now fails, a false teat or a miss more, or a mean error larger by more than the margin is worse; the mean distance,
and the mean absolute error along each axis too, for a large error along one axis hides a new one across it. It is shown to be no worse
only where the upper bound of the distance's change over all poses stays within the margin (non-inferiority; ICH E9, 3.3.2), those
included that weren't run; else it is inconclusive, however little changed in the poses that were. A situation whose mean distance grew by
more than the margin is worse where chance doesn't explain it (adjusted for all situations), and leaves the gate open where it may. Knows
neither runs nor frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.scoring.decisions import Verdict, poses_told
from bench.scoring.matching import Counts, added
from bench.scoring.paired import Discordance, PairedDifference, discordance, holm, paired_difference, pose_differences, poses_to_show
from bench.scoring.points import Floats
from bench.scoring.rates import Rate, exact_percent, percent
from bench.scoring.scene import SceneScore

ALPHA = 0.05
MARGIN_SHARE = 0.05  # of the error's limit: the margin where none is named


@dataclass(frozen=True, slots=True)
class ScenePair:
    """One scene scored for both. Repeats of a pose share `pose`."""

    scene: str
    pose: str
    situation: str
    old: SceneScore
    new: SceneScore


@dataclass(frozen=True, slots=True)
class Row:
    """What differs in one situation, or in all (`situation` None). Errors are of teats that both found, mm; `success` counts poses.

    `axes` are the differences of the mean absolute error along the world's x, y and z. The p-values adjusted by Holm are over the
    situations of one comparison; None in the pooled row, which is one question.
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
    """Whether the new one is worse: NOT_MET says that it is, MET that it is shown to be no worse. One reason a line."""

    verdict: Verdict
    reasons: tuple[str, ...]
    margin_mm: float


@dataclass(frozen=True, slots=True)
class Compared:
    """The whole comparison: pooled, by situation, and the gate."""

    pooled: Row
    situations: tuple[Row, ...]
    gate: Gate
    confidence: float


def compare(
    pairs: Sequence[ScenePair], *, margin_mm: float | None = None, confidence: float = 0.95, seed: int = 0, unpaired: int = 0
) -> Compared:
    """Compare on `pairs`; `unpaired` scenes of the old one have no counterpart.

    Raises ValueError for no pair, a margin below 0, or a scene that was scored with two limits: its success means two things then.
    `margin_mm` is by default a twentieth of the limit that the scenes were scored with.
    """
    if not pairs:
        raise ValueError("compare: the two have no scene in common")
    for pair in pairs:
        if pair.old.limit_mm != pair.new.limit_mm:
            limits = f"{pair.old.limit_mm:g} mm and {pair.new.limit_mm:g} mm"
            raise ValueError(f"compare: {pair.scene} was scored within {limits}; score both by the same rules")
    margin = MARGIN_SHARE * _limit_mm(pairs) if margin_mm is None else margin_mm
    if not 0.0 <= margin < float("inf"):
        raise ValueError(f"margin: {margin} mm must be 0 or more")
    pooled = _row(None, pairs, confidence, seed)
    names = dict.fromkeys(pair.situation for pair in pairs)
    rows = [_row(name, [pair for pair in pairs if pair.situation == name], confidence, seed) for name in names]
    adjusted = _adjusted(rows)
    return Compared(pooled, adjusted, gate(pairs, pooled, margin, unpaired, adjusted if len(adjusted) > 1 else ()), confidence)


def gate(pairs: Sequence[ScenePair], pooled: Row, margin_mm: float, unpaired: int = 0, situations: Sequence[Row] = ()) -> Gate:
    """Is the new one worse on these scenes?"""
    worse = [f"{pair.scene} passed and now fails: {why_failed(pair.new)}" for pair in pairs if pair.old.success and not pair.new.success]
    worse += _more("false teat", pooled.old.false, pooled.new.false) + _more("missed teat", pooled.old.missed, pooled.new.missed)
    mean, high = pooled.radial.mean, pooled.radial.high
    errors = (
        ("distance to the teat end", pooled.radial),
        *((f"error along {name}", axis) for name, axis in zip("xyz", pooled.axes, strict=True)),
    )
    grown = [(what, found.mean) for what, found in errors if found.mean is not None and found.mean > margin_mm]
    worse += [f"the mean {what} grew by {by:.3f} mm, more than the margin of {margin_mm:g} mm" for what, by in grown]
    shown, perhaps = _grown_in(situations, margin_mm)
    worse += shown
    if worse:
        return Gate(Verdict.NOT_MET, tuple(worse), margin_mm)
    open_questions = list(perhaps)
    if unpaired:
        open_questions.append(f"{unpaired} scenes of the old one were not run with the new one")
    if mean is None or high is None:
        open_questions.append("no teat was found by both, so no error was compared")
    elif high > margin_mm:
        open_questions.append(_hidden(pairs, pooled.radial, margin_mm))
    if open_questions:
        return Gate(Verdict.INCONCLUSIVE, tuple(open_questions), margin_mm)
    tail = (1.0 + pooled.radial.confidence) / 2.0
    failing = Rate(0, pooled.poses).upper_bound(tail) or 0.0
    bounds = (
        f"over all poses the mean distance grew by at most {high:.3f} mm (margin {margin_mm:g} mm) "
        f"and at most {percent(failing)} of poses are lost anew ({poses_told(pooled.poses)}, "
        f"{exact_percent(tail)} confidence each)"
    )
    return Gate(Verdict.MET, ("no scene lost, no false or missed teat more", bounds), margin_mm)


def _hidden(pairs: Sequence[ScenePair], found: PairedDifference, margin_mm: float) -> str:
    """What the poses that were not run may hide, and how many poses would show that they don't."""
    limit_mm, (old, new, poses) = _limit_mm(pairs), _common(pairs)
    changes = pose_differences(np.linalg.norm(old, axis=1), np.linalg.norm(new, axis=1), poses, limit=limit_mm)
    needed = poses_to_show(changes, limit_mm, margin_mm, (1.0 + found.confidence) / 2.0)
    more = "no number of poses with such changes shows less" if needed is None else f"{needed} poses with such changes show less"
    return (
        f"the mean distance changed by {found.mean:+.3f} mm in {poses_told(found.poses)}; poses "
        f"that were not run may hide that it grew by {found.high:.3f} mm "
        f"(margin {margin_mm:g} mm): {more}"
    )


def _grown_in(situations: Sequence[Row], margin_mm: float) -> tuple[list[str], list[str]]:
    """Situations whose mean distance grew by more than the margin, which the mean over all may hide: shown, and perhaps by chance."""
    shown: list[str] = []
    perhaps: list[str] = []
    for row in situations:
        by, p = row.radial.mean, row.radial_holm
        if by is None or by <= margin_mm:
            continue
        grew = f"in {row.situation} the mean distance to the teat end grew by {by:.3f} mm"
        if p is not None and p < ALPHA:
            shown.append(f"{grew}, more than the margin of {margin_mm:g} mm (adjusted p = {p:.3f})")
        else:
            perhaps.append(f"{grew}, which {row.poses} poses don't tell from chance: compare on more poses of it")
    return shown, perhaps


def why_failed(score: SceneScore) -> str:
    """What made a scene fail, in words."""
    counts, worst = score.counts, max(score.radial_mm, default=0.0)
    parts = [f"{counts.missed} missed" if counts.missed else "", f"{counts.false} false" if counts.false else ""]
    parts += [f"{worst:.2f} mm off (limit {score.limit_mm:g} mm)" if worst > score.limit_mm else ""]
    parts += ["" if score.in_time else f"too slow ({score.seconds:.2f} s)"]
    return ", ".join(part for part in parts if part) or "it succeeded"


def common_errors(pair: ScenePair) -> tuple[Floats, Floats]:
    """The errors (k, 3) of the teats that both found, old and new, row by row the same teat."""
    at = {teat: row for row, (_, teat) in enumerate(pair.new.match.pairs)}
    rows = [(row, at[teat]) for row, (_, teat) in enumerate(pair.old.match.pairs) if teat in at]
    olds, news = [a for a, _ in rows], [b for _, b in rows]
    return pair.old.errors_mm[olds].reshape(-1, 3), pair.new.errors_mm[news].reshape(-1, 3)


def _limit_mm(pairs: Iterable[ScenePair]) -> float:
    return min(pair.old.limit_mm for pair in pairs)


def _common(pairs: Iterable[ScenePair]) -> tuple[Floats, Floats, list[str]]:
    """The errors (k, 3) of all teats that both found, old and new, and their poses."""
    errors = [(pair.pose, *common_errors(pair)) for pair in pairs]
    old, new = (np.concatenate([both[side] for both in errors]) for side in (1, 2))
    return old, new, [pose for pose, common, _ in errors for _ in common]


def _row(situation: str | None, pairs: Sequence[ScenePair], confidence: float, seed: int) -> Row:
    old, new, poses = _common(pairs)

    def differ(a: Floats, b: Floats) -> PairedDifference:
        return paired_difference(a, b, poses, limit=_limit_mm(pairs), confidence=confidence, seed=seed)

    x, y, z = (differ(np.abs(old[:, k]), np.abs(new[:, k])) for k in range(3))
    return Row(
        situation=situation,
        scenes=len(pairs),
        poses=len({pair.pose for pair in pairs}),
        teats=len(old),
        success=_successes(pairs),
        radial=differ(np.linalg.norm(old, axis=1), np.linalg.norm(new, axis=1)),
        axes=(x, y, z),
        old=added(pair.old.counts for pair in pairs),
        new=added(pair.new.counts for pair in pairs),
    )


def _successes(pairs: Iterable[ScenePair]) -> Discordance:
    """By pose: a pose succeeds when all its repeats do."""
    old: dict[str, bool] = {}
    new: dict[str, bool] = {}
    for pair in pairs:
        old[pair.pose] = old.get(pair.pose, True) and pair.old.success
        new[pair.pose] = new.get(pair.pose, True) and pair.new.success
    return discordance(list(old.values()), list(new.values()))


def _adjusted(rows: Sequence[Row]) -> tuple[Row, ...]:
    success = holm([row.success.p_value for row in rows])
    asked = [row for row in rows if row.radial.p_value is not None]
    radial = dict(zip((row.situation for row in asked), holm([row.radial.p_value or 0.0 for row in asked]), strict=True))
    return tuple(replace(row, success_holm=p, radial_holm=radial.get(row.situation)) for row, p in zip(rows, success, strict=True))


def _more(what: str, old: int, new: int) -> list[str]:
    more = new - old
    return [f"{more} {what}{'s' if more > 1 else ''} more ({new} instead of {old})"] if more > 0 else []
