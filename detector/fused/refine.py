"""From starts to fitted teats: first roughly and for many, then finely for those that are left, each place only once.

Strategy: the rough pass looks far, for plain steps, at few points; what then has hardly an edge where its outline is, or is where a
better one is, goes. The fine pass looks close, with the full model of an edge. What a fit can't know, that a neighbour bridges or hides
a part of it, is tried in fits that leave that part out. The module may not know temperatures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.fused.edges import Profile
from detector.fused.fit import Seen, View, look, step, weights
from detector.fused.model import CX, CZ, END, RADIUS, SIDE_A, SIDE_B, TAPER, Outline, apexes
from detector.fused.parameters import Parameters
from detector.fused.pictures import UnusableError
from detector.geometry import Array

ROUGH_OUTLINE, FINE_OUTLINE = Outline.of(55.0, 8, 12), Outline.of(72.0, 28, 24)
OPTICAL_ROUGH = Profile(7.0, 1.0, 5.0, 0.5, 1.2, limb=False, pull_px=4.0)
OPTICAL_FINE = Profile(5.0, 0.5, 2.0, 0.25, 0.8, limb=True, pull_px=1.5)
THERMAL = Profile(4.0, 0.5, 2.0, 0.25, 1.0, limb=False, pull_px=2.0)
OPTICAL_FLOOR_PX, THERMAL_FLOOR_PX = 0.05, 0.4
_ROUGH_STEPS, _FINE_STEPS = 2, 4
_ROUGH_SCALE, _FINE_SCALE = 20.0, 3.0  # floors beyond which an edge counts for less
_LEAST_SIDE, _CLOSE = 0.4, 12.0  # of a side's edges, within so many floors, or it isn't seen
_LEAST_ALONE, _MOST_OTHER = 0.7, 0.15  # seen so well in one picture, and so badly in the other, it is no teat's side
_NEARER_MM = 3.0
_ROOM_PX = (3.0, 3.0, 1.0)  # left, right, thermal: about a nearer teat, where its edge is what is found
_LEAST_SHARE, _NEAR_PX = 0.35, 1.5  # of the rough outline, near an edge
_SAME_MM = np.array([2.5, 2.5, 8.0])  # two rough fits nearer than this are one; depth is the least sure


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Teats (m, 8) in the right camera's frame, the edges about them, and the weights (m, k) of these."""

    teats: Array
    seen: Seen
    weight: Array
    hidden: NDArray[np.bool_]  # (m, k): behind another teat, or left out

    def take(self, which: NDArray[np.intp]) -> Fitted:
        """Some of them."""
        seen = Seen(**{name: getattr(self.seen, name)[which] for name in Seen.__slots__})
        return Fitted(self.teats[which], seen, self.weight[which], self.hidden[which])

    def __add__(self, other: Fitted) -> Fitted:
        """All of both."""
        seen = Seen(**{name: np.concatenate([getattr(self.seen, name), getattr(other.seen, name)]) for name in Seen.__slots__})
        teats = np.concatenate([self.teats, other.teats])
        weight, hidden = np.concatenate([self.weight, other.weight]), np.concatenate([self.hidden, other.hidden])
        return Fitted(teats, seen, weight, hidden)


def refine(teats: Array, views: tuple[View, ...], p: Parameters) -> Fitted:
    """What the starts ``teats`` (m, 8) lead to, none in the same place as a better one. Raises UnusableError where it is nothing."""
    teats = _rough(teats, views, p)
    if len(teats) == 0:
        raise UnusableError("the optical pictures show no outline where the thermal one is warm")
    return _fine(teats, np.zeros((len(teats), len(views) * len(FINE_OUTLINE.part)), dtype=bool), views, p)


def refine_again(fitted: Fitted, hidden: NDArray[np.bool_], views: tuple[View, ...], p: Parameters) -> Fitted:
    """The fitted teats, once more, now that it is known which points (m, k) of their outlines are behind another teat."""
    at, rest = np.flatnonzero(hidden.any(axis=1)), np.flatnonzero(~hidden.any(axis=1))
    return fitted.take(rest) + _fine(fitted.teats[at], hidden[at] | fitted.hidden[at], views, p)


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
    return fitted + _fine(starts, left_out, views, p)


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
    """Whether points (b, n, 2) lie within an ``outline`` (n, 2) or ``room_px`` of it."""
    polygon, flat = outline.astype(np.float32).reshape(-1, 1, 2), points.reshape(-1, 2)
    result = np.zeros(len(flat), dtype=bool)
    for i in np.flatnonzero(np.all((flat > outline.min(axis=0) - room_px) & (flat < outline.max(axis=0) + room_px), axis=1)):
        result[i] = cv2.pointPolygonTest(polygon, (float(flat[i, 0]), float(flat[i, 1])), True) > -room_px
    return result.reshape(points.shape[:2])


def _fine(teats: Array, hidden: NDArray[np.bool_], views: tuple[View, ...], p: Parameters) -> Fitted:
    seen = look(teats, views, FINE_OUTLINE, fine=True)
    for number in range(_FINE_STEPS):
        moved = step(teats, seen, _trusted(seen, hidden, number), p.prior)
        seen = _look_again(seen, moved, moved - teats, views, fine=True)
        teats = moved
    return Fitted(teats, seen, _trusted(seen, hidden, _FINE_STEPS), hidden)


def _look_again(seen: Seen, teats: Array, change: Array, views: tuple[View, ...], *, fine: bool) -> Seen:
    """What is seen after a small ``change`` (m, 8): the optical pictures are looked at anew, coarse thermal edges stay where they are."""
    outline = FINE_OUTLINE if fine else ROUGH_OUTLINE
    k = 2 * len(outline.part)
    optical = look(teats, views[:2], outline, seen.jacobian[:, :k], fine=fine)
    old = {name: getattr(seen, name)[:, k:] for name in Seen.__slots__}
    old["offset_px"] = old["offset_px"] - np.einsum("mki,mi->mk", old["jacobian"], change)
    return Seen(**{name: np.concatenate([getattr(optical, name), values], axis=1) for name, values in old.items()})


def _trusted(seen: Seen, hidden: NDArray[np.bool_], number: int) -> Array:
    """Weights (m, k) in the fine pass; after its first step only sides that both optical pictures show, where nothing hides them, count.

    What is a teat's side is so in both pictures. What only one shows is likely the outline of something behind or before it.
    """
    weight = np.where(hidden, 0.0, weights(seen, _FINE_SCALE))
    if number == 0:
        return weight
    m, part = len(weight), FINE_OUTLINE.part
    close = (weight > 0) & (np.abs(np.nan_to_num(seen.offset_px, nan=9.0)) < np.minimum(_CLOSE * seen.floor_px, 1.0))
    close, each, open_ = close.reshape(m, -1, len(part)), weight.reshape(m, -1, len(part)), ~hidden.reshape(m, -1, len(part))
    for side in (SIDE_A, SIDE_B):
        at = part == side
        share = close[:, :, at].sum(axis=2) / np.maximum(open_[:, :, at].sum(axis=2), 0.3 * at.sum())
        covered = open_[:, :2, at].mean(axis=2) < 0.5
        doubtful = (np.where(covered, 1.0, share[:, :2]).min(axis=1) < _MOST_OTHER) & (share[:, :2].max(axis=1) > _LEAST_ALONE)
        unseen = share < _LEAST_SIDE
        unseen[:, :2] |= doubtful[:, None]
        each[:, :, at] *= ~unseen[..., None]
        each[:, :2, _next_to(side)] *= ~doubtful[:, None, None]
    return each.reshape(m, -1)


def _next_to(side: int) -> NDArray[np.intp]:
    """The points of the end in the third next to a side."""
    end = np.flatnonzero(FINE_OUTLINE.part == END)
    third = len(end) // 3
    return end[:third] if side == SIDE_A else end[-third:]


def _rough(teats: Array, views: tuple[View, ...], p: Parameters) -> Array:
    prior = replace(p.prior, taper_sd=0.5 * p.prior.taper_sd, height_sd=0.2 * p.prior.height_sd)
    for least, same in ((0.6 * _LEAST_SHARE, 0.4), (_LEAST_SHARE, 1.0)):
        if len(teats) == 0:
            break
        seen = look(teats, views, ROUGH_OUTLINE, fine=False)
        for _ in range(_ROUGH_STEPS):
            moved = step(teats, seen, weights(seen, _ROUGH_SCALE), prior)
            seen = _look_again(seen, moved, moved - teats, views, fine=False)
            teats = moved
        teats = teats[_distinct(teats, seen, least, same * _SAME_MM, p.most_fits)]
    return teats


def _distinct(teats: Array, seen: Seen, least: float, same_mm: Array, most: int) -> list[int]:
    """At most ``most`` of the teats (m, 8), by the share of their outlines near an edge, none within ``same_mm`` of a better one."""
    near = (weights(seen, _ROUGH_SCALE) > 0) & (np.abs(np.nan_to_num(seen.offset_px, nan=9.0)) < _NEAR_PX)
    share, ends = near.mean(axis=1), apexes(teats)
    kept: list[int] = []
    for i in np.argsort(-share, kind="stable"):
        if share[i] > least and len(kept) < most and all(np.abs((ends[i] - ends[k]) / same_mm).max() > 1 for k in kept):
            kept.append(int(i))
    return kept
