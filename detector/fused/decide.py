"""Accepts or rejects each fitted teat, with the reason.

Asked in turn: end and sides seen in each picture, edges where predicted, a teat's size, a certain
place, warmth, no overlap with a better teat. A doubt rejects.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from detector.fused.edges import CLEAR
from detector.fused.fit import Parameters
from detector.fused.model import (
    CZ,
    END,
    HEIGHT,
    LEAN_X,
    LEAN_Z,
    RADIUS,
    SIDE_A,
    SIDE_B,
    TAPER,
    Rows,
    apexes,
    axes,
)
from detector.fused.refine import FINE_OUTLINE, SHAPE_ALONG_MM, Fitted, on_one_bar
from detector.fused.thermal import Field
from detector.geometry import Array, Camera, Motion

_CLOSE_PX, _MOST_SD_PX = 0.6, 1.2
# of an end in one picture, where both sides were followed up to it; and closely
_LEAST_FOLLOWED, _LEAST_FOLLOWED_CLOSE = 0.3, 0.2
_LEAST_BETWEEN, _LEAST_COLD = 0.65, 0.6  # of the end, where no side is warm; where one isn't
# merit of the farthest end that sides lead to: a nearer one shows up to 0.28 more of itself, in two
# pictures, twice
_FARTHEST = 0.9
_SHAPED = 2.0  # of a fit of any shape: it was begun where the usual shape doesn't fit
_WARM = 0.9  # of the thermal outline: what makes up for optical edges
_BOTH_WARM, _LESS = 0.85, 0.03  # of it with both sides; how much less is enough then
_LEANS = "it leans more than a teat does"
_SIZE = "it isn't of a teat's size"
OUTLINE = "its outline isn't that of a teat"
ELSEWHERE = "the thermal picture shows its outline elsewhere"
_UNSURE = "its place is too unsure"
_WORSE = "a better one is in the same place"
_FAR = "it is too far from the other ends to be of their udder"
_LEAST_SHAPED_END, _WHOLE_SIDE = 0.4, 0.97  # of a short teat's end; of a long one's side
_WHOLE_END, _HALF_END, _LEAST_OTHER_SIDE = 0.9, 0.65, 0.2
_UNLIKE_SIDES = 0.5  # one picture shows a side that the other doesn't
_CLEAR_END, _CLEAR_SIDES = 0.65, 0.75  # of an outline that nothing but a teat has
_CLEAR_MISFIT_PX, _CLOSE_MISFIT_PX = 0.1, 0.12
_SURE_MISFIT_PX, _SURE_MM = 0.06, 1.05  # of a fit to which one side is enough
_LEAST_END_THEN = 0.78  # where one picture shows a side that the other doesn't
# of the end in one picture and of the sides in both, where the other shows no end but the thermal
_END_ALONE, _SIDES_ALONE = 0.85, 0.6
# of the thermal end, and of all sides, of a teat whose end only the thermal picture shows
_THERMAL_END, _ALL_SIDES = 0.7, 0.9
_ALONG_MM = np.arange(0.0, 44.0, 4.0)  # where a teat must be warm: from the ball's middle down
_ACROSS = (-1.7, -0.6, 0.0, 0.6, 1.7)  # of the radius: two lines beside it
# shares of the thermal outline (end, better side, other) that make it one of its own, and how
# unlike its surroundings it must be, as a share of the warmest teat's
_OWN_OUTLINE, _OWN_WARMTH = (0.6, 0.5, 0.35), 0.2
_EVEN = 0.06  # of a teat's warmth: how unlike the lines of one without a thermal outline may be
_GAP = 0.5  # of a teat's warmth: cooler than such surroundings is a gap between teats,
_COLD_GAP = 0.2  # as is what has less warmth than this, between two that have more
_BARREL_MM, _NARROWEST_MM = 20.0, 5.5  # how far below its end a teat is judged; an end's radius
_TEATS = 4  # of an udder
_AXIS_MM = np.linspace(0.0, 60.0, 7)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence(Rows):
    """For m fitted teats: seen shares of the outline (m, 3 views: left, right, thermal); misfit px
    (m,); warmth (m, 3 lines), and beside it, or NaN; largest standard deviation mm (m,).
    """

    end: Array
    side: Array  # the better side
    both: Array  # the other
    misfit_px: Array
    warmth: Array
    beside: Array  # (m, 2 lines)
    sd_mm: Array
    # whether both sides were followed up to where the last of an end is seen
    followed: NDArray[np.bool_]
    shaped: NDArray[np.bool_]  # fitted as a short teat of any shape
    # the median distance (m, 3 parts) of the thermal outline, NaN where it shows none
    thermal_px: Array

    @property
    def merit(self) -> Array:
        """One number (m,) by which the better of two is chosen."""
        return np.asarray(
            (2 * self.end + self.side + self.both)[:, :2].sum(axis=1)
            - 4 * self.misfit_px
            + _FARTHEST * self.followed
            + _SHAPED * self.shaped
        )


def weigh(fitted: Fitted, covariances: Array, warmth: Array) -> Evidence:
    """Evidence from edges about m teats, covariances (m, 3, 3), and warmth (m, 5)."""
    seen, part = fitted.seen, FINE_OUTLINE.part
    m, n = len(fitted.weight), len(part)
    offset, weight, sd = (
        np.nan_to_num(a.reshape(m, -1, n), nan=9.0)
        for a in (seen.offset_px, fitted.weight, seen.sd_px)
    )
    good = (weight > 0) & (np.abs(offset) < _CLOSE_PX) & (sd < _MOST_SD_PX)
    open_ = ~fitted.hidden.reshape(m, -1, n)
    shares = {
        p: _share(good[:, :, part == p], open_[:, :, part == p]) for p in (SIDE_A, END, SIDE_B)
    }
    optical = weight[:, :2].reshape(m, -1)
    squares = (offset[:, :2].reshape(m, -1) ** 2 * optical).sum(axis=1)
    misfit = np.sqrt(squares / np.maximum(optical.sum(axis=1), 1e-9))
    sides = np.stack([shares[SIDE_A], shares[SIDE_B]])
    largest = np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])
    better, other, thermal = sides.max(axis=0), sides.min(axis=0), _thermal_offsets(fitted)
    inside, beside = warmth[:, 1:-1], warmth[:, [0, -1]]
    return Evidence(
        shares[END], better, other, misfit, inside, beside, largest, fitted.followed,
        fitted.shaped, thermal,
    )  # fmt: skip


def unlike_covariances(teats: Array, evidence: Evidence, p: Parameters) -> Array:
    """(m, 3, 3) mm^2 of the ends of teats (m, 8), right camera's frame: what a teat that isn't the
    model's, or of which too little is seen, adds to its fit's covariance.
    """
    axis = axes(teats)
    across = np.cross(axis, teats[:, :3])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    optical, thermal_end = evidence.end[:, :2].mean(axis=1), evidence.thermal_px[:, END]
    partly = optical < _WHOLE_END
    # the other side of an end that is seen in part may be a neighbour's
    one_side = (evidence.both[:, :2].min(axis=1) <= p.least_side) | (
        partly & (evidence.both[:, 2] <= _LEAST_OTHER_SIDE)
    )
    short = evidence.shaped | (evidence.side.max(axis=1) < _WHOLE_SIDE)
    in_part = partly & np.isnan(thermal_end)
    unlike_mm = teats[:, RADIUS] * np.abs(teats[:, HEIGHT] - 1.0)
    half_end = in_part & evidence.followed & (optical < _HALF_END)
    in_part_mm = np.where(half_end, p.half_end_sd_mm, p.end_in_part_sd_mm)
    along2 = (p.end_unlike_share * unlike_mm) ** 2 + in_part_mm**2 * in_part
    along2 += (short & ~evidence.shaped) * SHAPE_ALONG_MM**2
    along2 += thermal_ends(evidence, p) * p.thermal_end_sd_mm**2
    across2 = one_side * np.where(short, p.short_one_side_sd_mm, p.one_side_sd_mm) ** 2
    sight = teats[:, :3] / np.linalg.norm(teats[:, :3], axis=1, keepdims=True)
    deep2 = (np.ptp(evidence.both[:, :2], axis=1) > _UNLIKE_SIDES) * p.one_sees_sd_mm**2
    deep2 += _one_sees_a_side(evidence) * p.one_sees_in_part_sd_mm**2
    return np.asarray(
        np.einsum("m,mi,mj->mij", along2, axis, axis)
        + np.einsum("m,mi,mj->mij", across2, across, across)
        + np.einsum("m,mi,mj->mij", deep2, sight, sight)
        + np.einsum("m,ij->mij", short * p.short_sd_mm**2, np.eye(3))
    )


def _share(good: NDArray[np.bool_], open_: NDArray[np.bool_]) -> Array:
    """Share (m, views) of good points of those not hidden (m, views, k); mostly hidden: missing."""
    return np.asarray(
        (good & open_).sum(axis=2) / np.maximum(open_.sum(axis=2), 0.4 * good.shape[2])
    )


def _thermal_offsets(fitted: Fitted) -> Array:
    """Median offsets (m, 3 parts) of thermal edges, sensor px; NaN where few edges are clear."""
    part = FINE_OUTLINE.part
    thermal = slice(2 * len(part), 3 * len(part))
    open_, offset = ~fitted.hidden[:, thermal], fitted.seen.offset_px[:, thermal]
    clear = open_ & (fitted.seen.clarity[:, thermal] > CLEAR) & np.isfinite(offset)
    medians = np.full((len(clear), 3), np.nan)
    values = np.where(clear, offset, np.inf)
    for p in (SIDE_A, END, SIDE_B):
        at = part == p
        count = clear[:, at].sum(axis=1)
        enough = count > 0.5 * np.maximum(open_[:, at].sum(axis=1), 0.3 * at.sum())
        ranked, rows = np.sort(values[:, at], axis=1), np.flatnonzero(enough)
        middle = count[rows]
        medians[rows, p] = 0.5 * (ranked[rows, (middle - 1) // 2] + ranked[rows, middle // 2])
    return medians


def warmth_across(
    teats: Array, warm: Field, lens: Camera, thermal_from_right: Motion, px_a_sensor_px: float
) -> Array:
    """Medians (m, 5) of the thermal picture along lines down teats (m, 8): one to the left, three
    inside, one to the right; NaN outside.
    """
    axis = axes(teats)
    line = teats[:, None, None, :3] + _ALONG_MM[:, None] * axis[:, None, None]
    across = np.cross(axis, [0.0, 0.0, -1.0])[:, None, None]
    aside = np.array(_ACROSS)[:, None, None] * teats[:, None, None, RADIUS, None] * across
    points = (line + aside).reshape(-1, 3)
    pixels = (lens.project(thermal_from_right.apply(points)) + 0.5) / px_a_sensor_px - 0.5
    shape = (len(teats), len(_ACROSS), len(_ALONG_MM), 2)
    at = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(int).reshape(shape)
    rows, columns = warm.shape
    inside = (at[..., 0] >= 0) & (at[..., 0] < columns) & (at[..., 1] >= 0) & (at[..., 1] < rows)
    values = warm[np.clip(at[..., 1], 0, rows - 1), np.clip(at[..., 0], 0, columns - 1)]
    half = len(_ALONG_MM) // 2  # the median of an odd number
    middle = np.partition(values, half, axis=2)[..., half]
    return np.where(inside.mean(axis=2) > 0.5, middle, np.nan)


def objections(
    teats: Array, evidence: Evidence, surroundings: float, p: Parameters
) -> list[str | None]:
    """Why teats (m, 8) are rejected, or None. ``surroundings``: the level without warmth."""
    one_sees, by_warmth = _one_sees_a_side(evidence), thermal_ends(evidence, p)
    reasons: list[str | None] = [
        _objection(teats[i], evidence, i, p, one_sees=one_sees[i], by_warmth=by_warmth[i])
        for i in range(len(teats))
    ]
    clean = [i for i, reason in enumerate(reasons) if reason is None]
    # a straw may hide the warmth of one line
    whole = (evidence.end[:, :2].min(axis=1) > _CLEAR_END) & (
        evidence.both[:, :2].min(axis=1) > _CLEAR_SIDES
    )
    whole &= evidence.misfit_px < p.good_misfit_px
    # one with its whole end in all pictures, all but one, behind another teat
    in_all = (evidence.end.min(axis=1) > _WHOLE_END) & (evidence.misfit_px < _CLEAR_MISFIT_PX)
    in_all &= evidence.side[:, :2].min(axis=1) > _CLEAR_SIDES
    lines_cold = np.where(in_all, 2, whole)
    least = np.sort(evidence.warmth, axis=1)[np.arange(len(teats)), lines_cold]
    if clean:
        reference = max(float(np.median(evidence.warmth[i])) for i in clean)
        for i in clean:
            as_warm = least[i] - surroundings >= p.least_warmth * (reference - surroundings)
            no_outline = max(evidence.end[i, 2], evidence.side[i, 2]) < p.least_end
            uneven = np.ptp(evidence.warmth[i]) > _EVEN * abs(reference - surroundings)
            if (no_outline and uneven) or not (
                as_warm or _own_warmth(evidence, i, surroundings, reference)
            ):
                reasons[i] = "it isn't warm all over"
    kept: list[int] = []
    merit = evidence.merit
    for i in sorted((i for i in clean if reasons[i] is None), key=lambda i: -merit[i]):
        if any(_passes_through(teats[i], teats[k], p.overlap) for k in kept):
            reasons[i] = _WORSE
        else:
            kept.append(i)
    ends_mm = apexes(teats[kept])
    half_seen = evidence.end[kept, :2].mean(axis=1) < p.least_end_alone
    partly_seen = evidence.end[kept].min(axis=1) < _WHOLE_END
    for gap_mm, doubtful in ((p.udder_mm, half_seen), (p.widest_udder_mm, partly_seen)):
        for i in _of_another(ends_mm, merit[kept], gap_mm):
            if doubtful[i] or evidence.shaped[kept[i]]:
                reasons[kept[i]] = _FAR
    return reasons


def _of_another(ends_mm: Array, merit: Array, udder_mm: float) -> list[int]:
    """Which of ends (n, 3) are in another group than most; a gap of ``udder_mm`` parts groups."""
    far = np.linalg.norm(ends_mm[:, None] - ends_mm, axis=2) > udder_mm
    if not far.any():
        return []
    _, group = connected_components(~far, directed=False)
    weight = [(np.sum(group == g), merit[group == g].sum()) for g in group]
    best = max(weight, default=None)
    return [i for i, each in enumerate(weight) if each != best]


def _own_warmth(evidence: Evidence, i: int, surroundings: float, reference: float) -> bool:
    """Whether the thermal picture shows the teat's own outline, warmer or cooler than what is
    beside it. ``reference``: the warmest teat.
    """
    shares = [evidence.end[i, 2], evidence.side[i, 2], evidence.both[i, 2]]
    beside = np.nan_to_num(evidence.beside[i], nan=surroundings)
    inside, full = float(np.median(evidence.warmth[i])), reference - surroundings
    unlike = inside - beside
    own = all(share >= least for share, least in zip(shares, _OWN_OUTLINE, strict=True))
    cold = inside - surroundings < _COLD_GAP * full
    warmer = beside - surroundings > (_COLD_GAP if cold else _GAP) * full
    gap = (unlike < 0).all() and warmer.all()
    return bool(own and np.abs(unlike).min() > _OWN_WARMTH * full and not gap)


def settled(evidence: Evidence, reasons: list[str | None], p: Parameters) -> bool:
    """Whether four teats or more are accepted, all of them with their whole ends and sides."""
    accepted = [i for i, reason in enumerate(reasons) if reason is None]
    end, side = evidence.end[accepted, :2], evidence.both[accepted, :2]
    whole = (end > p.whole_end_both) & (side > _CLEAR_SIDES)
    return bool(len(accepted) >= _TEATS and whole.all())


def doubts(
    teats: Array, evidence: Evidence, reasons: list[str | None], p: Parameters
) -> tuple[list[int], list[int]]:
    """Of teats (m, 8), those that may bridge two, and those that may be too high or low; a few
    each.

    Both have their sides, but not all of their end. A teat with both sides hardly bridges two.
    """
    both = evidence.both[:, :2].min(axis=1) > p.least_side
    partial = (evidence.end[:, :2].min(axis=1) < np.where(both, p.whole_end_both, p.whole_end)) & (
        evidence.side[:, :2].min(axis=1) > p.least_side
    )
    same = on_one_bar(teats)
    whole = [i for i, reason in enumerate(reasons) if reason is None and not partial[i]]
    open_ = [
        int(i)
        for i in np.argsort(-evidence.merit)
        if partial[i]
        and (maybe_hidden(reasons[i]) or reasons[i] == _SIZE)
        and not same[i, whole].any()
    ]
    half = evidence.end[:, :2].max(axis=1) > 0.5 * p.whole_end
    bridging, shifted = [i for i in open_ if half[i] and not both[i]], [i for i in open_ if both[i]]
    bridging = [i for i, reason in enumerate(reasons) if reason == _LEANS] + bridging
    one_each = [i for n, i in enumerate(shifted) if not same[i, shifted[:n]].any()]
    return bridging[: p.most_doubts], one_each[: p.most_doubts]


def shapes(teats: Array, evidence: Evidence, reasons: list[str | None], p: Parameters) -> list[int]:
    """Of teats (m, 8), those that show an end in all pictures but don't fit: one a place."""
    end = evidence.end.min(axis=1) > _LEAST_SHAPED_END
    rejected = np.array([reason is not None for reason in reasons])
    unlike = (evidence.side.max(axis=1) < _WHOLE_SIDE) & (
        rejected | (evidence.misfit_px > p.good_misfit_px / 3)
    )
    same = on_one_bar(teats)
    sound = [k for k, reason in enumerate(reasons) if reason is None and not unlike[k]]
    kept: list[int] = []
    for i in np.argsort(-evidence.merit, kind="stable").tolist():
        if (
            end[i]
            and unlike[i]
            and not same[i, kept + sound].any()
            and not any(_passes_through(teats[i], teats[k], p.overlap) for k in sound)
        ):
            kept.append(i)
    return kept[: p.most_shapes]


def maybe_hidden(reason: str | None) -> bool:
    """Whether a nearer teat may explain what speaks against this one, if anything."""
    return reason is None or "seen" in reason or reason in (OUTLINE, _UNSURE, _WORSE)


def _objection(
    teat: Array, evidence: Evidence, i: int, p: Parameters, *, one_sees: bool, by_warmth: bool
) -> str | None:
    for view, name in enumerate(("left", "right")):
        if unseen := _unseen(evidence, i, view, p, by_warmth=by_warmth):
            return f"{unseen} in the {name} picture"
    if one_sees and evidence.end[i, :2].min() < _LEAST_END_THEN:
        return "a side of it is seen in one picture only"
    if evidence.misfit_px[i] > p.greatest_misfit_px:
        return OUTLINE
    # a funnel's end is narrower than its barrel, a bottle's wider
    barrel_mm = teat[RADIUS] + _BARREL_MM * teat[TAPER]
    if not (p.least_radius_mm < barrel_mm < p.greatest_radius_mm and teat[RADIUS] > _NARROWEST_MM):
        return _SIZE
    if max(abs(teat[LEAN_X]), abs(teat[LEAN_Z])) > p.greatest_lean:
        return _LEANS
    if not p.nearest_mm < teat[CZ] < p.farthest_mm:
        return "it is outside of the working volume"
    if not np.isfinite(evidence.warmth[i]).all():
        return "the thermal picture doesn't reach it"
    if _elsewhere(evidence.thermal_px[i], p.greatest_thermal_px):
        return ELSEWHERE
    return _UNSURE if evidence.sd_mm[i] > p.greatest_sd_mm else None


def _one_sees_a_side(evidence: Evidence) -> NDArray[np.bool_]:
    """Of which of m teats one picture shows a side that the other doesn't, and warmth hardly an
    end: two things may be taken for one, at a wrong depth.
    """
    return np.asarray(
        (np.ptp(evidence.both[:, :2], axis=1) > _UNLIKE_SIDES)
        & (evidence.end[:, 2] < 0.7)
        & (evidence.end[:, :2].min(axis=1) < _WHOLE_END)
    )


def _unseen(evidence: Evidence, i: int, view: int, p: Parameters, *, by_warmth: bool) -> str | None:
    """What of teat ``i`` an optical picture shows too little of."""
    end = evidence.end[i, view]
    warm = np.isfinite(evidence.thermal_px[i, [SIDE_A, SIDE_B]])
    followed = evidence.followed[i] and evidence.both[i, :2].min() > 0.8
    least = p.least_end_followed if followed else p.least_end_alone
    sure = evidence.misfit_px[i] < _SURE_MISFIT_PX
    if followed and sure and evidence.both[i, 2] > 0.8:
        least = p.least_end_sure
    partial = evidence.end[i, :2].mean() < least
    alone = partial and evidence.end[i, 2] < (_LEAST_BETWEEN if followed else 0.5)
    # a gap has two sides too
    least = _LEAST_BETWEEN if evidence.followed[i] and not warm.any() else _LEAST_COLD
    between_two = not warm.all() and evidence.end[i, :2].mean() < least
    least_end = (_LEAST_FOLLOWED_CLOSE if sure else _LEAST_FOLLOWED) if followed else p.least_end
    by_other = (
        evidence.end[i, :2].max() > _END_ALONE
        and evidence.end[i, 2] > _WARM
        and evidence.both[i, :2].min() > _SIDES_ALONE
    )
    short = (end < least_end and not by_other) or alone or between_two
    if short and not by_warmth:
        return "its end isn't seen"
    sure = sure and evidence.sd_mm[i] < _SURE_MM
    whole_side = evidence.side[i].min() > _WHOLE_SIDE
    one_sided = evidence.both[i, :2].max() < p.least_side and not (sure and whole_side)
    good = evidence.misfit_px[i] < p.good_misfit_px
    warm_end = np.isfinite(evidence.thermal_px[i, END]) or (
        good
        and end > p.least_end_alone
        and (evidence.end[i, 2] >= 0.4 or (end > _WHOLE_END and evidence.both[i, 2] > 0.8))
    )
    if one_sided and (end < p.least_end_one_sided * (1.0 if good else 1.4) or not warm_end):
        return "only a side of it and too little of its end are seen"
    both_warm = min(evidence.end[i, 2], evidence.both[i, 2]) > _BOTH_WARM
    warm_round = both_warm or min(evidence.end[i, 2], evidence.side[i, 2]) > _WARM
    warm_round &= bool(evidence.misfit_px[i] < _CLOSE_MISFIT_PX)
    least = p.least_end_unsure_warm if warm_round else p.least_end_unsure
    least_either = p.least_end_unsure_either - (_LESS if both_warm else 0.0)
    ends = evidence.end[i, :2]
    too_little = ends.mean() < least or ends.min() < least_either
    if one_sided and evidence.sd_mm[i] > p.sure_one_sided_mm and too_little:
        return "only a side of it and not all of its end are seen"
    if evidence.side[i, view] < p.least_side and not _held_by_thermal(evidence, i):
        return "neither side is seen"
    return None


def thermal_ends(evidence: Evidence, p: Parameters) -> NDArray[np.bool_]:
    """Which of m teats end where only the thermal picture shows it: what is behind them looks like
    them in the optical ones, which show both sides.
    """
    unseen = evidence.end[:, :2].min(axis=1) < p.least_end
    sides = evidence.both.min(axis=1) > _ALL_SIDES
    close = evidence.misfit_px < _SURE_MISFIT_PX
    return np.asarray(unseen & sides & close & (evidence.end[:, 2] > _THERMAL_END))


def _held_by_thermal(evidence: Evidence, i: int) -> bool:
    """Whether a teat may lack its sides in a picture: end well seen in both, end and a side in the
    thermal one, less clearly where the other optical picture shows a side; or short, its end whole.
    """
    end = evidence.end[i, :2].min()
    side = evidence.side[i, :2].max()
    thermal = min(evidence.end[i, 2], evidence.side[i, 2])
    short = evidence.shaped[i] and min(end, evidence.end[i, 2]) > 0.95
    return bool(
        short or (end > 0.7 and thermal > 0.9) or (end > 0.6 and thermal > 0.8 and side > 0.5)
    )


def _elsewhere(offset_px: Array, most_px: float) -> bool:
    """Whether warmth contradicts: beyond the end or both sides. Beyond one may be a neighbour."""
    side_a, end, side_b = np.nan_to_num(offset_px)
    return bool(
        abs(end) > most_px
        or min(side_a, side_b) < -most_px
        or (side_a > most_px and side_b > most_px)
    )


def _passes_through(a: Array, b: Array, share: float) -> bool:
    """Whether two solid teats (8,) would be in one another."""
    first, second = (t[:3] + _AXIS_MM[:, None] * axes(t[None]) for t in (a, b))
    nearest = np.linalg.norm(first[:, None] - second[None], axis=2).min()
    return bool(nearest < share * (a[RADIUS] + b[RADIUS]))
