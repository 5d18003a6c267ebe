"""What a first fit can't know, tried in further fits: that a neighbour bridges or hides a part of it, or that its end isn't the teat's.

Strategy: a fit that may bridge two teats is begun again on one side alone; one whose end is seen in part is slid along its own sides to the
last place that shows an end; and what an accepted teat hides of one behind it is left out. The module may not know temperatures.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from detector.fused.edges import LEAST_CLEAR
from detector.fused.fit import View, look
from detector.fused.model import COUNT, CX, CZ, END, HEIGHT, RADIUS, SIDE_A, SIDE_B, TAPER, Outline, axes
from detector.fused.parameters import Parameters
from detector.fused.refine import FINE_OUTLINE, FINE_STEPS, Fitted, fine
from detector.geometry import Array

_END_OUTLINE = Outline(np.array([1.0]), (np.arange(18) + 0.5) / 18)
_SLIDE_MM = np.arange(-14.0, 15.0)  # towards the end
_CLOSE_PX = 0.6
_NEARLY, _LEAST_END = 0.72, 0.5  # of the best place's share of an end, and of the whole end: so much must be seen where an end may be
_SHAPE = 0.3  # of the usual spread of heights: of an end that is seen in part, shape and place can't both be told
_UPRIGHT = 0.5  # of the usual lean: what is left of a hidden teat's outline hardly tells lean from depth
_NEARER_MM = 3.0
_ROOM_PX = (3.0, 3.0, 1.0)  # left, right, thermal: about a nearer teat, where its edge is what is found


def refine_again(fitted: Fitted, hidden: NDArray[np.bool_], views: tuple[View, ...], p: Parameters) -> Fitted:
    """The fitted teats, once more, now that it is known which points (m, k) of their outlines are behind another teat."""
    at, rest = np.flatnonzero(hidden.any(axis=1)), np.flatnonzero(~hidden.any(axis=1))
    upright = replace(p, prior=replace(p.prior, lean_sd=_UPRIGHT * p.prior.lean_sd))
    again = fine(fitted.teats[at], hidden[at] | fitted.hidden[at], views, upright, steps=FINE_STEPS - 1)
    return fitted.take(rest) + replace(again, followed=fitted.followed[at])


def one_sided(teats: Array, p: Parameters, views: int) -> tuple[Array, NDArray[np.bool_]]:
    """Two starts for each of the teats (m, 8), each on one side and the half of the end next to it alone; and what is left out.

    Where teats touch, the other side of the outline that is seen belongs to the neighbour, and a fit bridges both.
    """
    starts, masks = [], []
    for lost, sign in ((SIDE_B, -1.0), (SIDE_A, 1.0)):
        start = teats.copy()
        start[:, CX] += sign * (start[:, RADIUS] - p.prior.radius_mm)
        start[:, RADIUS], start[:, TAPER] = p.prior.radius_mm, 0.0
        starts.append(start)
        left_out = np.tile(np.isin(np.arange(len(FINE_OUTLINE.part)), _half(lost)), views)
        masks.append(np.repeat(left_out[None], len(teats), axis=0))
    return np.concatenate(starts), np.concatenate(masks)


def refine_more(fitted: Fitted, starts: Array, left_out: NDArray[np.bool_], views: tuple[View, ...], p: Parameters) -> Fitted:
    """The fitted teats, and besides them fits from ``starts`` (n, 8) without the points ``left_out`` (n, k)."""
    return fitted + fine(starts, left_out, views, p) if len(starts) else fitted


def refine_slid(fitted: Fitted, slid: Array, views: tuple[View, ...], p: Parameters) -> Fitted:
    """The fitted teats, and besides them fits from ``slid`` (n, 8), which were followed up their sides."""
    if len(slid) == 0:
        return fitted
    tight = replace(p, prior=replace(p.prior, height_sd=_SHAPE * p.prior.height_sd))
    more = fine(slid, np.zeros((len(slid), fitted.weight.shape[1]), dtype=bool), views, tight)
    return fitted + replace(more, followed=np.ones(len(slid), dtype=bool))


def slide_ends(teats: Array, views: tuple[View, ...]) -> Array:
    """The teats (m, 8) with their ends moved along their axes to where both optical pictures show the outline of a round end.

    Light paints rims on a teat that look like its end, but beyond the end itself there is no outline of its width: of places that show
    nearly as much of an end as the best does, the farthest out is taken.
    """
    m, count = len(teats), len(_SLIDE_MM)
    if m == 0:
        return teats
    slid = np.repeat(teats[:, None], count, axis=1)
    slid[..., HEIGHT] = 1.0
    slid[..., :3] -= (teats[:, RADIUS] * (teats[:, HEIGHT] - 1.0))[:, None, None] * axes(teats)[:, None]
    slid[..., :3] -= _SLIDE_MM[:, None] * axes(teats)[:, None]
    points = len(_END_OUTLINE.part)
    seen = look(slid.reshape(-1, COUNT), views[:2], _END_OUTLINE, np.zeros((m * count, 2 * points, COUNT)), fine=True)
    part = np.tile(_END_OUTLINE.part == END, 2)
    good = (np.abs(np.nan_to_num(seen.offset_px, nan=9.0)) < _CLOSE_PX) & (seen.clarity > LEAST_CLEAR)
    share = good[:, part].reshape(m, count, -1).mean(axis=2)
    peak = share >= np.maximum(_NEARLY * share.max(axis=1, keepdims=True), _LEAST_END)
    last = count - 1 - peak[:, ::-1].argmax(axis=1)
    near = np.abs(np.arange(count) - last[:, None]) <= 2
    best = np.where(near, share, 0.0).argmax(axis=1)
    return np.asarray(slid[np.arange(m), best][peak.any(axis=1)])


def _half(side: int) -> NDArray[np.intp]:
    """The points of a side and of the half of the end next to it."""
    end = np.flatnonzero(FINE_OUTLINE.part == END)
    near = end[: len(end) // 2] if side == SIDE_A else end[len(end) // 2 :]
    return np.concatenate([np.flatnonzero(FINE_OUTLINE.part == side), near])


def hidden_points(fitted: Fitted, accepted: list[int], again: list[int]) -> NDArray[np.bool_]:
    """Which points (m, k) of the outlines lie on an accepted teat that is nearer, or just beside it, where its edge would be found.

    Only the teats ``again`` are asked for.
    """
    m, n = len(fitted.teats), len(FINE_OUTLINE.part)
    pixels = fitted.seen.pixels_px.reshape(m, -1, n, 2)
    hidden = np.zeros(pixels.shape[:3], dtype=bool)
    for k in accepted:
        behind = np.array([i for i in again if fitted.teats[i, CZ] > fitted.teats[k, CZ] + _NEARER_MM], dtype=np.intp)
        for view, room in enumerate(_ROOM_PX):
            hidden[behind, view] |= _inside(pixels[behind, view], pixels[k, view], room)
    return hidden.reshape(m, -1)


def _inside(points: Array, outline: Array, room_px: float) -> NDArray[np.bool_]:
    """Whether points (b, n, 2) lie within an ``outline`` (n, 2), closed from its last point to its first, or ``room_px`` of it."""
    result = np.zeros(points.shape[:2], dtype=bool)
    near = np.all((points > outline.min(axis=0) - room_px) & (points < outline.max(axis=0) + room_px), axis=2)
    p = points[near]
    if len(p) == 0:
        return result
    start, way = outline, np.roll(outline, -1, axis=0) - outline
    from_start = p[:, None] - start
    share = np.clip(np.einsum("pnd,nd->pn", from_start, way) / np.maximum(np.einsum("nd,nd->n", way, way), 1e-12), 0, 1)
    off = from_start - share[..., None] * way
    beside = np.einsum("pnd,pnd->pn", off, off).min(axis=1) < room_px**2
    crossed = (from_start[..., 1] < 0) != (from_start[..., 1] < way[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        right = from_start[..., 0] < way[:, 0] * from_start[..., 1] / way[:, 1]
    result[near] = beside | ((crossed & right).sum(axis=1) % 2 == 1)
    return result
