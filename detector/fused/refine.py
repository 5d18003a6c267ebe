"""From starts to fitted teats: a rough pass for many, a fine one for the rest, and further fits
where needed.

The rough pass looks far for plain steps; the fine pass looks close with the full edge model. Then
a fit that may bridge two teats is begun again on one side; an end seen in part is slid up its
sides, a side that goes on is left out, and an unsure end is begun from beside.
"""

from __future__ import annotations

import operator
from dataclasses import replace
from functools import cache, reduce

import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.fused.parameters import Parameters
from detector.geometry import Array
from detector.outline.edges import LEAST_CLEAR
from detector.outline.fine import (
    FINE_OUTLINE,
    FINE_STEPS,
    ROUGH_OUTLINE,
    ROUGH_SCALE,
    Fitted,
    fine,
    stepped,
)
from detector.outline.fit import CameraView, OutlineEdges, look, weights
from detector.outline.model import COUNT, CX, END, HEIGHT, RADIUS, TAPER, Outline, apexes, axes
from detector.outline.prior import Prior, disparities_px

_MOST_A_BAR = 2
_ROUGH_STEPS = 2
_LEAST_SHARE, _NEAR_PX = 0.5, 1.5  # of the rough outline, near an edge
_ONE_MM = np.array([0.5, 0.5, 2.0])  # two nearly fine fits nearer than this lead to one place
# two rough fits nearer than this are one; depth is the least sure
_SAME_MM = np.array([2.5, 2.5, 8.0])


def refine(
    teats: Array, views: tuple[CameraView, ...], p: Parameters, known: Fitted | None = None
) -> Fitted | None:
    """What starts ``teats`` (m, 8) lead to beside ``known`` fits, each place once, if anything."""
    teats = _rough(teats, views, p, apexes(known.teats) if known else np.zeros((0, 3)))
    if len(teats) == 0:
        return None
    nearly = fine(teats, None, views, p.prior, steps=2)
    # in each place go on with the one with most of its outline seen
    same, kept = _near(apexes(nearly.teats), _ONE_MM), list[int]()
    for i in np.argsort(-(nearly.weight > 0).sum(axis=1), kind="stable").tolist():
        if not same[i, kept].any():
            kept.append(i)
    best = nearly.take(sorted(kept))
    return fine(best.teats, best.hidden, views, p.prior, best.seen, steps=FINE_STEPS - 2, first=2)


def _rough(teats: Array, views: tuple[CameraView, ...], p: Parameters, known_mm: Array) -> Array:
    if len(teats) == 0:
        return teats
    prior = replace(p.prior, taper_sd=0.5 * p.prior.taper_sd, height_sd=0.2 * p.prior.height_sd)
    seen = look(teats, views, ROUGH_OUTLINE, fine=False)
    for least, same in ((0.6 * _LEAST_SHARE, 0.4), (_LEAST_SHARE, 1.0)):
        for _ in range(_ROUGH_STEPS):
            weight = weights(seen, ROUGH_SCALE)
            teats = stepped(teats, seen, weight, prior, views, fine=False)
        kept = _distinct(teats, seen, least, same * _SAME_MM, p.most_fits, known_mm)
        if len(kept) == 0:
            return teats[:0]
        teats, seen = teats[kept], seen.take(kept)
    return teats


def _distinct(
    teats: Array, seen: OutlineEdges, least: float, same_mm: Array, most: int, known_mm: Array
) -> list[int]:
    """At most ``most`` of teats (m, 8), none within ``same_mm`` of a better or a known end."""
    near = np.abs(seen.offset_px) < _NEAR_PX
    near &= weights(seen, ROUGH_SCALE) > 0
    optical = near[:, : 2 * near.shape[1] // 3]
    share, ends = np.maximum(near.mean(axis=1), optical.mean(axis=1)), apexes(teats)
    same, one_bar = _near(ends, same_mm), on_one_bar(teats)
    open_ = (share > least) & ~_near(ends, same_mm, known_mm).any(axis=1)
    on_bar, kept = np.zeros(len(teats), dtype=int), list[int]()
    for i in np.argsort(-share, kind="stable").tolist():
        if open_[i] and len(kept) < most:
            kept.append(i)
            on_bar += one_bar[:, i]
            open_ &= ~same[i] & (on_bar < _MOST_A_BAR)
    return kept


def _near(ends: Array, same_mm: Array, others: Array | None = None) -> NDArray[np.bool_]:
    """Which of ends (m, 3) are the same as others (k, 3), or each other: (m, k)."""
    away = ends[:, None] - (ends if others is None else others)
    return np.asarray((np.abs(away / same_mm) <= 1).all(axis=2))


def on_one_bar(teats: Array) -> NDArray[np.bool_]:
    """Whether fits (m, 8) in rows and columns are of one teat: a middle near the other's axis."""
    way, axis = teats[:, None, :3] - teats[:, :3], axes(teats)
    along = np.einsum("ikd,kd->ik", way, axis)
    return np.asarray(np.einsum("ikd,ikd->ik", way, way) - along**2 < (0.4 * teats[:, RADIUS]) ** 2)


_END_OUTLINE = Outline(np.array([1.0]), (np.arange(18) + 0.5) / 18)
_SLIDE_MM = np.arange(-14.0, 15.0)  # towards the end
# of the best place's share of an end, and of the whole end: so much must be seen where an end may
# be
_NEARLY, _LEAST_END = 0.72, 0.5
_CLOSE_PX = 0.6
# sides are followed from below an end's middle to beyond it; more than this share of their edges is
# seen where they go on
_FROM_FOOT_MM, _FARTHEST_MM, _GOES_ON = 12.0, 60.0, 0.6
ROUND_MM = 3.0  # beyond its middle a round end looks straight
# of the usual spread of heights: an end that is seen in part doesn't give both shape and place
_SHAPE = 0.3
_BESIDE = ((1.5, 0.0), (-1.5, 0.0), (0.0, 0.3), (0.0, -0.3))  # mm across, px of disparity
_SHORT_MM = 26.0  # of the sides of a teat that stands 35 mm out of an udder


def from_beside(
    fitted: Fitted, views: tuple[CameraView, ...], p: Parameters, calibration: Calibration
) -> Fitted:
    """The teats fitted again from either side of where they are, and from in front and behind:
    edges that are weak or another thing's hold a fit near to where it began.
    """
    n, teats = len(fitted.teats), fitted.teats
    starts = np.repeat(teats[None], 4, axis=0)
    px = disparities_px(teats[:, :3], calibration)
    for start, (aside_mm, nearer_px) in zip(starts, _BESIDE, strict=True):
        start[:, :3] *= (px / (px + nearer_px))[:, None]
        start[:, CX] += aside_mm
    again = replace(fitted.take(np.tile(np.arange(n), 4)), teats=starts.reshape(-1, COUNT))
    found = list[Fitted]()
    for shaped, prior in ((False, p.prior), (True, any_shape(p.prior))):
        at = np.flatnonzero(again.shaped == shaped)
        if len(at):
            some = again.take(at)
            fits = fine(some.teats, some.hidden, views, prior, steps=FINE_STEPS - 1)
            found.append(replace(fits, followed=some.followed, shaped=some.shaped))
    return reduce(operator.add, found)


@cache
def any_shape(prior: Prior) -> Prior:
    """That of short teats: tapered, and flat to pointed."""
    return replace(prior, lean_sd=0.12, radius_sd_mm=2.5, taper_sd=0.07, height_sd=0.35)


def shaped_again(fitted: Fitted, views: tuple[CameraView, ...], p: Parameters) -> Fitted:
    """The same, and fitted again as short ones of any shape: sides no farther than such a teat
    stands out of an udder. The first fits of these are as unsure as the second.
    """
    count, part = len(fitted.teats), FINE_OUTLINE.part
    along, every = np.zeros(len(part)), np.ones(len(fitted.teats), dtype=bool)
    along[part != END] = np.concatenate([FINE_OUTLINE.along_mm[::-1], FINE_OUTLINE.along_mm])
    hidden = np.tile(along > _SHORT_MM, (count, len(views)))
    found = fine(fitted.teats, hidden, views, any_shape(p.prior), steps=FINE_STEPS + 1)
    return replace(fitted, shaped=every) + replace(found, shaped=every)


def one_sided(teats: Array, views: tuple[CameraView, ...], p: Parameters) -> Fitted:
    """Two fits for each teat (m, 8), each of one side and half the end: where teats touch, the
    other side is the neighbour's.
    """
    starts = np.repeat(teats[None], 2, axis=0)
    starts[..., CX] += np.array([[-1.0], [1.0]]) * (starts[..., RADIUS] - p.prior.radius_mm)
    starts[..., RADIUS], starts[..., TAPER] = p.prior.radius_mm, 0.0
    lost = np.repeat([[False, True], [True, False]], len(teats), axis=0)
    left_out = _points(np.repeat(lost[:, None], len(views), axis=1))
    return fine(starts.reshape(-1, COUNT), left_out, views, p.prior)


def _points(sides: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Points (m, views * n) of ``sides`` (m, views, 2), each with the half of the end beside it."""
    return np.repeat(sides.reshape(len(sides), -1), len(FINE_OUTLINE.part) // 2, axis=1)


def without_lines(
    fitted: Fitted, lines: NDArray[np.bool_], views: tuple[CameraView, ...], prior: Prior
) -> Fitted:
    """The teats fitted again without sides that are other things' ``lines`` (m, 2 pictures, 2)."""
    left_out, points = fitted.hidden.copy(), _points(lines)
    left_out[:, : points.shape[1]] |= points
    return fine(fitted.teats, left_out, views, prior)


def along_sides(teats: Array, views: tuple[CameraView, ...], p: Parameters) -> Fitted:
    """Fits of teats (m, 8), their ends followed up their sides in two ways."""
    slid = np.concatenate([slide_to_round(teats, views), slide_to_stop(teats, views)])
    tight = replace(p.prior, height_sd=_SHAPE * p.prior.height_sd)
    more = fine(slid, None, views, tight)
    return replace(more, followed=np.ones(len(slid), dtype=bool))


def side_stops(
    teats: Array, views: tuple[CameraView, ...], beyond_mm: float
) -> tuple[Array, Array]:
    """Where the straight sides of teats (m, 8) stop being seen, mm beyond the middle of the end, at
    most ``beyond_mm``: each side in both optical pictures (m, 4), and all together (m,).
    """
    along = np.arange(-beyond_mm, _FROM_FOOT_MM + 1.0)
    outline = Outline(along, np.array([0.5]))
    seen = look(teats, views[:2], outline, fine=True, slopes_too=False)
    near = (np.abs(seen.offset_px) < _CLOSE_PX) & (seen.clarity > LEAST_CLEAR)
    near, count = near.reshape(len(teats), 2, -1), len(along)
    from_foot = np.concatenate([near[..., :count], near[..., : -count - 1 : -1]], axis=1)

    def stops_mm(share: Array) -> Array:
        gain = np.cumsum(share - _GOES_ON, axis=-1)
        last = -along[::-1][gain.argmax(axis=-1)]
        return np.where(gain.max(axis=-1) > 0, last, -_FROM_FOOT_MM)

    return stops_mm(from_foot), stops_mm(from_foot.mean(axis=1))


def slide_to_stop(teats: Array, views: tuple[CameraView, ...]) -> Array:
    """Teats (m, 8) with ends moved along their axes to where the straight sides stop in the optical
    pictures: light paints rims on a teat, but its sides go on until its end.
    """
    _, stop = side_stops(teats, views, _FARTHEST_MM)
    slid = teats.copy()
    slid[:, HEIGHT] = 1.0
    slid[:, :3] -= (stop - ROUND_MM)[:, None] * axes(teats)
    return slid


def slide_to_round(teats: Array, views: tuple[CameraView, ...]) -> Array:
    """Teats (m, 8) with ends moved along their axes by some mm, to where both optical pictures show
    a round end.

    Light paints rims on a teat, but nothing as wide beyond its end: of places nearly as good as the
    best, the farthest out.
    """
    m, count = len(teats), len(_SLIDE_MM)
    slid = np.repeat(teats[:, None], count, axis=1)
    slid[..., HEIGHT] = 1.0
    axis = axes(teats)[:, None]
    slid[..., :3] -= (teats[:, RADIUS] * (teats[:, HEIGHT] - 1.0))[:, None, None] * axis
    slid[..., :3] -= _SLIDE_MM[:, None] * axis
    seen = look(slid.reshape(-1, COUNT), views[:2], _END_OUTLINE, fine=True, slopes_too=False)
    part = np.tile(_END_OUTLINE.part == END, 2)
    good = np.abs(seen.offset_px) < _CLOSE_PX
    good &= seen.clarity > LEAST_CLEAR
    share = good[:, part].reshape(m, count, -1).mean(axis=2)
    peak = share >= np.maximum(_NEARLY * share.max(axis=1, keepdims=True), _LEAST_END)
    last = count - 1 - peak[:, ::-1].argmax(axis=1)
    near = np.abs(np.arange(count) - last[:, None]) <= 2
    best = np.where(near, share, 0.0).argmax(axis=1)
    return np.asarray(slid[np.arange(m), best][peak.any(axis=1)])
