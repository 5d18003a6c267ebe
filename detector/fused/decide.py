"""Accepts or rejects each fitted teat, with the reason.

Asked in turn: end and sides seen in each picture, edges where predicted, a teat's size, a certain
place, warmth, no overlap with a better teat. A doubt rejects.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from detector.fused.evidence import WHOLE_END, Evidence
from detector.fused.parameters import Parameters
from detector.fused.refine import on_one_bar
from detector.geometry import Array
from detector.outline.model import (
    CZ,
    END,
    LEAN_X,
    LEAN_Z,
    RADIUS,
    SIDE_A,
    SIDE_B,
    TAPER,
    apexes,
    axes,
)

_LEAST_FOLLOWED = 0.3  # of an end in one picture, where both sides were followed up to it
_BOTH_SIDES, _LEAST_WARM_END = 0.8, 0.4  # seen of both sides; of the thermal end, of a warm one
_NO_WARM_END = 0.2  # of one that isn't
_FAR_WARM_END = 0.7  # of one that is so far from the others that it may be no teat's
# half of an end, and most of it; of the other side; an sd: with less of them, nothing else may be
# doubtful
_HALF, _MOST, _LEAST_OTHER, _UNSURE_MM, _HALF_WARM = 0.6, 0.8, 0.5, 2.5, 0.5
_LEAST_BETWEEN, _LEAST_COLD = 0.65, 0.6  # of the end, where no side is warm; where one isn't
# sensor px, of a short teat of any shape, a fit that isn't close, and others: a teat's thermal
# outline is 0.15 within its optical one
_ALL_ROUND_PX, _HOTTER_K = (0.15, -0.02, 0.05), 1.0
_WARM = 0.9  # of the thermal outline: what makes up for optical edges
_BOTH_WARM, _LESS = 0.85, 0.03  # of it with both sides; how much less is enough then
# of the thermal end, and of the end in both optical pictures and in the mean; how far beyond the
# fit warmth may reach, sensor px: what makes up for sides in the optical pictures
_WARM_ARC, _HALF_ARC, _BEYOND_PX = 0.78, (0.45, 0.5), 0.12
_WHOLE_SD_MM = 13.0  # of an end that all pictures show whole
_LEANS = "it leans more than a teat does"
_SIZE = "it isn't of a teat's size"
OUTLINE = "its outline isn't that of a teat"
ELSEWHERE = "the thermal picture shows its outline elsewhere"
_UNSURE = "its place is too unsure"
_WORSE = "a better one is in the same place"
_FAR = "it is too far from the other ends to be of their udder"
_LEAST_SHAPED_END, WHOLE_SIDE = 0.4, 0.97  # of a short teat's end; of a long one's side
UNLIKE_SIDES = 0.5  # one picture shows a side that the other doesn't
_CLEAR_END, _CLEAR_SIDES = 0.65, 0.75  # of an outline that nothing but a teat has
_CLEAR_MISFIT_PX, _CLOSE_MISFIT_PX = 0.1, 0.12
_SURE_MISFIT_PX, _SURE_MM = 0.06, 1.05  # of a fit to which one side is enough
# where one picture shows a side that the other doesn't, and in a close fit
_LEAST_END_THEN, _LEAST_END_CLOSE, _CLOSE_THEN_PX = 0.78, 0.7, 0.08
# of the end in one picture and of the sides in both, where the other shows no end but the thermal
_END_ALONE, _SIDES_ALONE = 0.85, 0.6
# of the thermal end, and of all sides, of a teat whose end only the thermal picture shows
_THERMAL_END, _THERMAL_END_ALONE, _ALL_SIDES = 0.7, 0.8, 0.9
# shares of the thermal outline (end, better side, other) that make it one of its own, and how
# unlike its surroundings it must be, as a share of the warmest teat's
_OWN_OUTLINE, _OWN_WARMTH = (0.6, 0.5, 0.35), 0.2
# of the median warmth of so many teats that are seen well: a hose
_TOO_WARM, _ENOUGH_CLEAR = 1.3, 3
_EVEN = 0.06  # of a teat's warmth: how unlike the lines of one without a thermal outline may be
_GAP = 0.5  # of a teat's warmth: cooler than such surroundings is a gap between teats,
_COLD_GAP = 0.2  # as is what has less warmth than this, between two that have more
# enough of an end at the sides' stop; and of one that sides lead to, in the better picture and in
# the mean, where the fit is close
_LEAST_STOPPING, _LED_TO, _LED_TO_PX = 0.38, (0.7, 0.53), 0.08
_BARREL_MM, _NARROWEST_MM = 20.0, 5.5  # how far below its end a teat is judged; an end's radius
_AXIS_MM = np.linspace(0.0, 60.0, 7)


def objections(
    teats: Array, evidence: Evidence, surroundings: float, p: Parameters
) -> list[str | None]:
    """Why teats (m, 8) are rejected, or None. ``surroundings``: the level without warmth."""
    reasons = _alone(teats, evidence, p)
    clean = [i for i, reason in enumerate(reasons) if reason is None]
    for i, reason in _unlike_in_warmth(evidence, clean, surroundings, p):
        reasons[i] = reason
    merit, first = evidence.merit, list[int]()  # places in the order
    order = sorted((i for i in clean if reasons[i] is None), key=lambda i: -merit[i])
    through = _pass_through(teats[order], teats[order], p.overlap)
    for n, i in enumerate(order):
        if through[n, first].any():
            reasons[i] = _WORSE
        else:
            first.append(n)
    kept = [order[n] for n in first]
    ends_mm = apexes(teats[kept])
    half_seen = evidence.end[kept, :2].mean(axis=1) < p.least_end_alone
    half_seen |= evidence.end[kept, 2] < _FAR_WARM_END
    partly_seen = evidence.end[kept].min(axis=1) < WHOLE_END
    for gap_mm, doubtful in ((p.udder_mm, half_seen), (p.widest_udder_mm, partly_seen)):
        for i in _of_another(ends_mm, merit[kept], gap_mm):
            if doubtful[i] or evidence.shaped[kept[i]]:
                reasons[kept[i]] = _FAR
    for i in [i for i in kept if reasons[i] is None][p.prior.udder :]:  # the best come first
        reasons[i] = "it is one more than an udder has teats, and the worst"
    return reasons


def _unlike_in_warmth(
    evidence: Evidence, clean: list[int], surroundings: float, p: Parameters
) -> Iterator[tuple[int, str]]:
    """Which of the ``clean`` teats aren't as warm as teats are, and why."""
    end, misfit_px = evidence.end, evidence.misfit_px
    # a straw may hide the warmth of one line
    whole = (end[:, :2].min(axis=1) > _CLEAR_END) & (misfit_px < p.good_misfit_px)
    whole &= evidence.both[:, :2].min(axis=1) > _CLEAR_SIDES
    one_side = np.minimum(end[:, :2].min(axis=1), evidence.side.min(axis=1)) > WHOLE_SIDE
    whole |= one_side & (misfit_px < _SURE_MISFIT_PX)
    # another teat that of all but one, where all pictures show the whole end
    in_all = (end.min(axis=1) > WHOLE_END) & (misfit_px < _CLEAR_MISFIT_PX)
    in_all &= evidence.side[:, :2].min(axis=1) > _CLEAR_SIDES
    lines_cold = np.where(in_all, 2, whole)
    least = np.sort(evidence.warmth, axis=1)[np.arange(len(end)), lines_cold]
    warmth = evidence.usual_warmth - surroundings
    # a teat may be warmer than three others, but not something of which only half is seen
    clear = [i for i in clean if whole[i]]
    most = _TOO_WARM * float(np.median(warmth[clear])) if len(clear) >= _ENOUGH_CLEAR else np.inf
    shown = (whole | in_all) & (end[:, :2].min(axis=1) > WHOLE_END)
    too_warm = [i for i in clean if warmth[i] > most and not shown[i]]
    yield from ((i, "it is warmer than the teats that are seen well") for i in too_warm)
    left = [i for i in clean if i not in too_warm]
    full = max((float(warmth[i]) for i in left), default=0.0)
    for i in left:
        as_warm = least[i] - surroundings >= p.least_warmth * full
        no_outline = max(end[i, 2], evidence.side[i, 2]) < p.least_end
        even = np.ptp(evidence.warmth[i]) <= _EVEN * abs(full)
        # nothing else has its outline in all pictures, however cool
        as_shown = in_all[i] and even and least[i] - surroundings > _COLD_GAP * full
        own = as_warm or as_shown or _own_warmth(evidence, i, surroundings, full)
        if not own or (no_outline and not even):
            yield i, "it isn't warm all over"


def _of_another(ends_mm: Array, merit: Array, udder_mm: float) -> list[int]:
    """Which of ends (n, 3) are in another group than most; a gap of ``udder_mm`` parts groups."""
    far = np.linalg.norm(ends_mm[:, None] - ends_mm, axis=2) > udder_mm
    if not far.any():
        return []
    _, group = connected_components(~far, directed=False)
    weight = [(np.sum(group == g), merit[group == g].sum()) for g in group]
    best = max(weight, default=None)
    return [i for i, each in enumerate(weight) if each != best]


def _own_warmth(evidence: Evidence, i: int, surroundings: float, full: float) -> bool:
    """Whether the thermal picture shows the teat's own outline, warmer or cooler than what is
    beside it. ``full``: the warmth of the warmest teat.
    """
    shares = [evidence.end[i, 2], evidence.side[i, 2], evidence.both[i, 2]]
    beside = np.nan_to_num(evidence.beside[i], nan=surroundings)
    inside = float(evidence.usual_warmth[i])
    unlike = inside - beside
    own = all(share >= least for share, least in zip(shares, _OWN_OUTLINE, strict=True))
    cold = inside - surroundings < _COLD_GAP * full
    warmer = beside - surroundings > (_COLD_GAP if cold else _GAP) * full
    gap = (unlike < 0).all() and warmer.all()
    return bool(own and np.abs(unlike).min() > _OWN_WARMTH * full and not gap)


def settled(evidence: Evidence, reasons: list[str | None], p: Parameters) -> bool:
    """Whether an udder of teats is accepted, all of them with their whole ends and sides."""
    accepted = [i for i, reason in enumerate(reasons) if reason is None]
    end, side = evidence.end[accepted, :2], evidence.both[accepted, :2]
    whole = (end > p.whole_end_both) & (side > _CLEAR_SIDES)
    return bool(len(accepted) >= p.prior.udder and whole.all())


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
    return bridging[: p.most_bridging], one_each[: p.most_shifted]


def shapes(teats: Array, evidence: Evidence, reasons: list[str | None], p: Parameters) -> list[int]:
    """Of teats (m, 8), those that show an end in all pictures but don't fit: one a place."""
    end = evidence.end.min(axis=1) > _LEAST_SHAPED_END
    rejected = np.array([reason is not None for reason in reasons])
    unlike = (evidence.side.max(axis=1) < WHOLE_SIDE) & (
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
            and not _pass_through(teats[[i]], teats[sound], p.overlap).any()
        ):
            kept.append(i)
    return kept[: p.most_shapes]


def maybe_hidden(reason: str | None) -> bool:
    """Whether a nearer teat may explain what speaks against this one, if anything."""
    return reason is None or "seen" in reason or reason in (OUTLINE, _UNSURE, _WORSE)


def _alone(teats: Array, evidence: Evidence, p: Parameters) -> list[str | None]:
    """What speaks against each of teats (m, 8), whatever the others are: the first rule that
    objects.
    """
    unseen = {
        "its end isn't seen": _end_unseen(evidence, p),
        "only a side of it and too little of its end are seen": _too_little_seen(evidence, p),
        "only a side of it and not all of its end are seen": _unsure_side(evidence, p),
        "neither side is seen": _no_side(evidence, p),
    }
    in_one = [
        (objected[:, view], f"{words} in the {name} picture")
        for view, name in enumerate(("left", "right"))
        for words, objected in unseen.items()
    ]
    # a funnel's end is narrower than its barrel, a bottle's wider
    barrel_mm = teats[:, RADIUS] + _BARREL_MM * teats[:, TAPER]
    sized = (barrel_mm > p.prior.radii_mm[0]) & (barrel_mm < p.prior.radii_mm[1])
    sized &= teats[:, RADIUS] > _NARROWEST_MM
    within = (teats[:, CZ] > 0) & (teats[:, CZ] < 2500)
    least = np.where(evidence.misfit_px < _CLOSE_THEN_PX, _LEAST_END_CLOSE, _LEAST_END_THEN)
    one_sees = one_sees_a_side(evidence) & (evidence.end[:, :2].min(axis=1) < least)
    led_to = evidence.followed & (evidence.side.min(axis=1) > WHOLE_SIDE)
    one_sees &= ~(led_to & (evidence.misfit_px < _LED_TO_PX))
    most_mm = np.where(evidence.end.min(axis=1) > WHOLE_END, _WHOLE_SD_MM, p.greatest_sd_mm)
    rules: list[tuple[NDArray[np.bool_], str]] = [
        *in_one,
        (evidence.goes_on, "its sides are seen beyond its end"),
        (one_sees, "a side of it is seen in one picture only"),
        (_too_little(evidence), "part of its end is seen, and something else is doubtful too"),
        (evidence.misfit_px > p.greatest_misfit_px, OUTLINE),
        (~sized, _SIZE),
        (np.abs(teats[:, [LEAN_X, LEAN_Z]]).max(axis=1) > 0.85, _LEANS),
        (~within, "it is outside of the working volume"),
        (np.isnan(evidence.warmth.sum(axis=1)), "the thermal picture doesn't reach it"),
        (_elsewhere(evidence, p), ELSEWHERE),
        (evidence.sd_mm > most_mm, _UNSURE),
    ]
    reasons: list[str | None] = [None] * len(teats)
    for objected, words in reversed(rules):
        for i in np.flatnonzero(objected).tolist():
            reasons[i] = words
    return reasons


def one_sees_a_side(evidence: Evidence) -> NDArray[np.bool_]:
    """Of which of m teats one picture shows a side that the other doesn't, and warmth hardly an
    end: two things may be taken for one, at a wrong depth.
    """
    return np.asarray(
        (np.ptp(evidence.both[:, :2], axis=1) > UNLIKE_SIDES)
        & (evidence.end[:, 2] < 0.7)
        & (evidence.end[:, :2].min(axis=1) < WHOLE_END)
    )


def _too_little(evidence: Evidence) -> NDArray[np.bool_]:
    """Of which of m teats the optical pictures show too little of the end, while something else is
    doubtful too: a place that is unsure, a side that one shows only, edges that don't fit, or what
    is warm.
    """
    end, thermal = evidence.end[:, :2], evidence.end[:, 2]
    apart = evidence.misfit_px > _CLEAR_MISFIT_PX
    one_sided = evidence.both[:, :2].min(axis=1) < _LEAST_OTHER
    half = (end.mean(axis=1) < _HALF) & (end.max(axis=1) < _END_ALONE)
    faint = ~evidence.shaped & (evidence.side[:, :2].max(axis=1) < WHOLE_END)
    half &= ((evidence.sd_mm > _UNSURE_MM) & ~evidence.shaped) | ((one_sided | faint) & apart)
    cold = evidence.followed & (thermal < _NO_WARM_END)
    cold &= apart | ((evidence.both[:, 2] < _NO_WARM_END) & (end.min(axis=1) < _LEAST_OTHER))
    cold |= evidence.shaped & np.isnan(evidence.thermal_px[:, END])
    alone = evidence.both[:, :2].max(axis=1) < _LEAST_OTHER
    no_side = one_sided & (evidence.side[:, 2] < _NO_WARM_END) & (end.min(axis=1) < WHOLE_SIDE)
    no_side &= thermal < np.where(alone, _HALF_WARM, _NO_WARM_END)
    return np.asarray(half | ((end.mean(axis=1) < _MOST) & cold) | no_side)


def _end_unseen(evidence: Evidence, p: Parameters) -> NDArray[np.bool_]:
    """Of which of m teats each optical picture shows too little of the end, (m, 2)."""
    end, thermal = evidence.end[:, :2], evidence.end[:, 2]
    mean, sides = end.mean(axis=1), evidence.both[:, :2].min(axis=1)
    followed = evidence.followed & (sides > _BOTH_SIDES)
    close = evidence.misfit_px < _SURE_MISFIT_PX
    least = np.where(followed, p.least_end_followed, p.least_end_alone)
    least[followed & close & (evidence.both[:, 2] > _BOTH_SIDES)] = p.least_end_sure
    alone = (mean < least) & (thermal < np.where(followed, _THERMAL_END, 0.5))
    # a gap has two sides too
    warm = np.isfinite(evidence.thermal_px[:, [SIDE_A, SIDE_B]])
    cold = evidence.followed & ~warm.any(axis=1)
    gap = ~warm.all(axis=1) & (mean < np.where(cold, _LEAST_BETWEEN, _LEAST_COLD))
    by_other = (end.max(axis=1) > _END_ALONE) & (thermal > _WARM) & (sides > _SIDES_ALONE)
    little = end < np.where(followed, _LEAST_FOLLOWED, p.least_end)[:, None]
    short = (little & ~by_other[:, None]) | (alone | gap)[:, None]
    held = evidence.stops & (mean > _LEAST_STOPPING) & (evidence.misfit_px < p.good_misfit_px)
    led_to = evidence.followed & (sides > _CLEAR_SIDES) & (evidence.misfit_px < _LED_TO_PX)
    led_to &= thermal > _NO_WARM_END
    held |= led_to & (end.max(axis=1) > _LED_TO[0]) & (mean > _LED_TO[1])
    # before an arm as warm as it is, warmth shows a side of a teat, but nothing of its end
    within = np.nan_to_num(evidence.thermal_px[:, [SIDE_A, SIDE_B]], nan=-1.0).max(axis=1) < 0.0
    before_arm = within & (evidence.side[:, 2] > 0.45) & (thermal < 0.1) & ~evidence.goes_on
    before_arm &= followed & (evidence.side[:, :2].min(axis=1) > 0.95)
    before_arm &= evidence.misfit_px < _LED_TO_PX
    held |= before_arm & (end.min(axis=1) > 0.4) & (mean > 0.45)
    return np.asarray(short & ~(held | thermal_ends(evidence, p))[:, None])


def _one_sided(evidence: Evidence, p: Parameters) -> NDArray[np.bool_]:
    """Which of m teats show one side in the optical pictures, where that isn't enough."""
    sure = (evidence.misfit_px < _SURE_MISFIT_PX) & (evidence.sd_mm < _SURE_MM)
    enough = sure & (evidence.side.min(axis=1) > WHOLE_SIDE)
    whole = np.minimum(evidence.end[:, :2] - WHOLE_END, evidence.side[:, :2] - WHOLE_SIDE) > 0
    close = (evidence.misfit_px < _CLEAR_MISFIT_PX) & (evidence.sd_mm < _SURE_MM)
    warm = np.isfinite(evidence.thermal_px).any(axis=1)
    enough |= (whole.all(axis=1) & close & warm) | _warm_outline(evidence, p)
    return np.asarray((evidence.both[:, :2].max(axis=1) < p.least_side) & ~enough)


def _warm_outline(evidence: Evidence, p: Parameters) -> NDArray[np.bool_]:
    """Of which of m teats warmth shows the outline all round and not beyond the fit, and the
    optical pictures half of the end.
    """
    end, beyond = evidence.end, np.nan_to_num(evidence.thermal_px).max(axis=1)
    warm = (end[:, 2] > _WARM_ARC) & (evidence.both[:, 2] > _WARM) & (beyond < _BEYOND_PX)
    half = (end[:, :2].min(axis=1) > _HALF_ARC[0]) & (end[:, :2].mean(axis=1) > _HALF_ARC[1])
    return np.asarray(warm & half & (evidence.misfit_px < p.good_misfit_px))


def _too_little_seen(evidence: Evidence, p: Parameters) -> NDArray[np.bool_]:
    """Of which of m teats each optical picture shows one side and too little of the end, (m, 2)."""
    end = evidence.end[:, :2]
    good = (evidence.misfit_px < p.good_misfit_px)[:, None]
    least_warm = np.where(evidence.shaped, _THERMAL_END, _LEAST_WARM_END)
    partly = (evidence.end[:, 2] >= least_warm)[:, None]
    sides = (evidence.both[:, 2] > _BOTH_SIDES)[:, None]
    warm = np.isfinite(evidence.thermal_px[:, [END]])
    warm = warm | (good & (end > p.least_end_alone) & (partly | ((end > WHOLE_END) & sides)))
    least = p.least_end_one_sided * np.where(good, 1.0, 1.4)
    return np.asarray(_one_sided(evidence, p)[:, None] & ((end < least) | ~warm))


def _unsure_side(evidence: Evidence, p: Parameters) -> NDArray[np.bool_]:
    """Which of m teats show one side and not all of the end, and are unsure, (m, 2)."""
    end, thermal = evidence.end[:, :2], evidence.end[:, 2]
    both_warm = np.minimum(thermal, evidence.both[:, 2]) > _BOTH_WARM
    warm = both_warm | (np.minimum(thermal, evidence.side[:, 2]) > _WARM)
    warm &= evidence.misfit_px < _CLOSE_MISFIT_PX
    part = end.mean(axis=1) < np.where(warm, p.least_end_unsure_warm, p.least_end_unsure)
    part |= end.min(axis=1) < p.least_end_unsure_either - np.where(both_warm, _LESS, 0.0)
    unsure = _one_sided(evidence, p) & (evidence.sd_mm > p.sure_one_sided_mm) & part
    return np.repeat(unsure[:, None], 2, axis=1)


def _no_side(evidence: Evidence, p: Parameters) -> NDArray[np.bool_]:
    """Of which of m teats each optical picture shows no side, (m, 2), where thermal edges don't
    make up for it: end well seen in both, end and a side in the thermal one, less clearly where the
    other optical picture shows a side; or short, its end whole. Where no picture shows the other
    side, both optical ones show most of the end.
    """
    end, side = evidence.end[:, :2].min(axis=1), evidence.side[:, :2].max(axis=1)
    thermal = np.minimum(evidence.end[:, 2], evidence.side[:, 2])
    least = np.where(evidence.misfit_px < _CLEAR_MISFIT_PX, _THERMAL_END, 0.95)
    short = evidence.shaped & (end > 0.95) & (evidence.end[:, 2] > least)
    held = short | ((end > 0.7) & (thermal > 0.9))
    held |= (end > 0.6) & (thermal > 0.8) & (side > 0.5)
    both_warm = evidence.both[:, 2] > 0.95
    held |= both_warm & (end > 0.57) & (evidence.end[:, 2] > 0.95)
    of_end = evidence.end[:, :2].mean(axis=1)
    good = (evidence.misfit_px < p.good_misfit_px) & ~evidence.shaped
    held |= good & (of_end > 0.7) & (evidence.end[:, 2] > 0.4) & (evidence.side[:, 2] > _WARM)
    sure = (evidence.misfit_px < _SURE_MISFIT_PX) & (evidence.sd_mm < _SURE_MM)
    held |= sure & (evidence.end.min(axis=1) > WHOLE_SIDE) & (side > WHOLE_SIDE)
    held &= (evidence.both.max(axis=1) > p.least_side) | (end > _MOST)
    return np.asarray((evidence.side[:, :2] < p.least_side) & ~held[:, None])


def thermal_ends(evidence: Evidence, p: Parameters) -> NDArray[np.bool_]:
    """Which of m teats end where only the thermal picture shows it: what is behind them looks like
    them in the optical ones, which show both sides.
    """
    unseen = evidence.end[:, :2].min(axis=1) < p.least_end
    sides = evidence.both.min(axis=1) > _ALL_SIDES
    close = evidence.misfit_px < _SURE_MISFIT_PX
    return np.asarray(unseen & sides & close & (evidence.end[:, 2] > _THERMAL_END_ALONE))


def _elsewhere(evidence: Evidence, p: Parameters) -> NDArray[np.bool_]:
    """Which of m teats warmth contradicts: beyond the end or both sides. Beyond one may be a
    neighbour. And all round, if little: a teat that is nearer or wider.
    """
    off, most = np.nan_to_num(evidence.thermal_px), p.greatest_thermal_px
    sides = off[:, [SIDE_A, SIDE_B]]
    known = np.isfinite(evidence.thermal_px)
    apart = evidence.misfit_px > _CLEAR_MISFIT_PX
    of_shaped, of_apart, of_others = _ALL_ROUND_PX
    least = np.where(evidence.shaped, of_shaped, np.where(apart, of_apart, of_others))
    all_round = np.where(known, off, np.inf).min(axis=1) > least
    all_round &= (known.sum(axis=1) > 1) & (evidence.end[:, :2].mean(axis=1) < WHOLE_END)
    # what is cold and before one side hides its warmth
    within = known.all(axis=1) & (np.abs(off[:, END]) < 0.3) & (np.abs(sides.max(axis=1)) < 0.3)
    within &= (evidence.misfit_px < 0.07) & (evidence.end[:, :2].mean(axis=1) > 0.65)
    # before what is hotter a thermal outline is another
    beside = np.nan_to_num(evidence.beside, nan=-np.inf).min(axis=1)
    all_round &= beside < evidence.usual_warmth + _HOTTER_K
    return np.asarray(
        all_round
        | (np.abs(off[:, END]) > most)
        | ((sides.min(axis=1) < -most) & ~within)
        | (sides > most).all(axis=1)
    )


def _pass_through(first: Array, second: Array, share: float) -> NDArray[np.bool_]:
    """Whether solid teats (m, 8) would be in others (k, 8): (m, k)."""
    one, other = (t[:, None, :3] + _AXIS_MM[:, None] * axes(t)[:, None] for t in (first, second))
    apart = ((one[:, None, :, None] - other[None, :, None]) ** 2).sum(axis=4)
    least = share * (first[:, None, RADIUS] + second[None, :, RADIUS])
    return np.asarray(apart.min(axis=(2, 3), initial=np.inf) < least**2)
