"""From starts to fitted teats: first roughly and for many, then finely for those that are left, each place only once.

Strategy: the rough pass looks far, for plain steps, at few points; what then has hardly an edge where its outline is, or is where a better one is,
goes. The fine pass looks close, with the full model of an edge. The module may not know temperatures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.fused.edges import Profile
from detector.fused.fit import Seen, View, look, step, weights
from detector.fused.model import CZ, SIDE_A, SIDE_B, Outline, apexes
from detector.fused.parameters import Parameters
from detector.fused.sweep import Starts
from detector.geometry import Array

ROUGH_OUTLINE, FINE_OUTLINE = Outline.of(55.0, 8, 12), Outline.of(60.0, 24, 24)
OPTICAL_ROUGH = Profile(7.0, 1.0, 5.0, 0.5, 1.2, limb=False, pull_px=4.0)
OPTICAL_FINE = Profile(5.0, 0.5, 2.0, 0.25, 0.8, limb=True, pull_px=1.5)
THERMAL = Profile(4.0, 0.5, 2.0, 0.25, 1.0, limb=False, pull_px=2.0)
OPTICAL_FLOOR_PX, THERMAL_FLOOR_PX = 0.05, 0.4
_ROUGH_STEPS, _FINE_STEPS = 4, 4
_ROUGH_SCALE, _FINE_SCALE = 20.0, 3.0  # floors beyond which an edge counts for less
_LEAST_SIDE, _CLOSE = 0.4, 12.0  # of a side's edges, within so many floors, or the side is hidden
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
    hidden: NDArray[np.bool_]  # (m, k): behind another teat


def refine(starts: Starts, views: tuple[View, ...], p: Parameters) -> Fitted:
    """The teats that the starts lead to, none in the same place as a better one."""
    order = np.argsort(-starts.score * starts.nominated, kind="stable")[: p.most_starts]
    teats = _rough(starts.teats[order], views, p)
    return _fine(teats, np.zeros((len(teats), len(views) * len(FINE_OUTLINE.part)), dtype=bool), views, p)


def refine_again(fitted: Fitted, hidden: NDArray[np.bool_], views: tuple[View, ...], p: Parameters) -> Fitted:
    """The fitted teats, once more, now that it is known which points (m, k) of their outlines are behind another teat."""
    return _fine(fitted.teats, hidden, views, p)


def hidden_points(fitted: Fitted, accepted: list[int]) -> NDArray[np.bool_]:
    """Which points (m, k) of the outlines lie on an accepted teat that is nearer, or so close to it that its edge would be taken for theirs."""
    m, n = len(fitted.teats), len(FINE_OUTLINE.part)
    pixels = fitted.seen.pixels_px.reshape(m, -1, n, 2)
    hidden = np.zeros(pixels.shape[:3], dtype=bool)
    for k in accepted:
        behind = np.flatnonzero(fitted.teats[:, CZ] > fitted.teats[k, CZ] + _NEARER_MM)
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
        teats = step(teats, seen, np.where(hidden, 0.0, _trusted(seen, hidden, number)), p.prior)
        seen = look(teats, views, FINE_OUTLINE, seen.jacobian, fine=True)
    return Fitted(teats, seen, np.where(hidden, 0.0, _trusted(seen, hidden, _FINE_STEPS)), hidden)


def _trusted(seen: Seen, hidden: NDArray[np.bool_], number: int) -> Array:
    """Weights (m, k) in the fine pass; after two steps a side that has too few edges where they should be has none at all."""
    weight = weights(seen, _FINE_SCALE)
    if number < 2:
        return weight
    m, part = len(weight), FINE_OUTLINE.part
    close = (weight > 0) & (np.abs(np.nan_to_num(seen.offset_px, nan=9.0)) < np.minimum(_CLOSE * seen.floor_px, 1.0)) & ~hidden
    close, each, open_ = close.reshape(m, -1, len(part)), weight.reshape(m, -1, len(part)).copy(), ~hidden.reshape(m, -1, len(part))
    for side in (SIDE_A, SIDE_B):
        at = part == side
        unseen = close[:, :, at].sum(axis=2) < _LEAST_SIDE * np.maximum(open_[:, :, at].sum(axis=2), 0.3 * at.sum())
        each[:, :, at] *= ~unseen[..., None]
    return each.reshape(m, -1)


def _rough(teats: Array, views: tuple[View, ...], p: Parameters) -> Array:
    prior = replace(p.prior, taper_sd=0.5 * p.prior.taper_sd, height_sd=0.2 * p.prior.height_sd)
    seen = look(teats, views, ROUGH_OUTLINE, fine=False)
    for _ in range(_ROUGH_STEPS):
        teats = step(teats, seen, weights(seen, _ROUGH_SCALE), prior)
        seen = look(teats, views, ROUGH_OUTLINE, seen.jacobian, fine=False)
    near = (weights(seen, _ROUGH_SCALE) > 0) & (np.abs(np.nan_to_num(seen.offset_px, nan=9.0)) < _NEAR_PX)
    share, ends = near.mean(axis=1), apexes(teats)
    kept: list[int] = []
    for i in np.argsort(-share, kind="stable"):
        if share[i] > _LEAST_SHARE and len(kept) < p.most_fits and all(np.abs((ends[i] - ends[k]) / _SAME_MM).max() > 1 for k in kept):
            kept.append(int(i))
    return teats[kept]
