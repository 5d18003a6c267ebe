"""From thermal nominations to places in space: the depths along a line of sight that both optical
pictures support.

The nomination's ball and axis are tried at every depth, a step of disparity apart, against squeezed
gradients. A bar without an end gets its depth from its sides; its end is then searched up its axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.fused.parameters import Parameters
from detector.fused.thermal import Field, Nominations, bar_ways, strengths
from detector.geometry import Array, Camera, Motion
from detector.outline import kernels
from detector.outline.fit import CameraView
from detector.outline.model import COUNT, HEIGHT, LEAN_X, RADIUS, Rows, apexes, axes

_DISPARITY_STEP_PX = 2.5
_CROSS_PX = np.array(
    [(0.0, 0.0), (-2.0, 0.0), (2.0, 0.0), (0.0, -2.0), (0.0, 2.0)], dtype=np.float32
)
_GRID = (-2.4, -1.2, 0.0, 1.2, 2.4)
_GRID_PX = np.array([(x, y) for x in _GRID for y in _GRID], dtype=np.float32)
_SWELLS = (0.85, 0.95, 1.05, 1.16)
_ARC = np.radians([-70.0, -42.0, -14.0, 14.0, 42.0, 70.0])
_BELOW = np.array([0.4, 1.2, 2.0, 2.8, 3.6])  # of the half width, below the ball's middle
_APART_STEPS = 2
_LEAST = 0.1
# what a nomination's next best place is worth of the one before, so that none is crowded out
_NEXT = 0.8
_NEAR_MM, _NEAR = 20.0, 0.4  # and what a start so near a better one is worth
_SLIDE_MM = np.arange(0.0, 111.0, 3.0)


@dataclass(frozen=True, slots=True, eq=False)
class Starts(Rows):
    """Teats (m, 8) for the fit, their scores (m,), and their nominations'."""

    teats: Array
    score: Array
    nominated: Array


@dataclass(frozen=True, slots=True, eq=False)
class Map:
    """Squeezed gradients of one view, blurred by a start's error, with a border of zeros."""

    gradients: Field
    view: CameraView

    @classmethod
    def of(cls, view: CameraView, blur_px: float) -> Map:
        """The map of a view."""
        return cls(strengths(view.field, blur_px, noises=3.0, border=1), view)


def depths_mm(calibration: Calibration, seen_mm: tuple[float, float]) -> Array:
    """Depths (d,) from the nearest to the farthest that are seen, evenly in disparity."""
    fb, (nearest, farthest) = calibration.right.fc[0] * calibration.baseline_mm, seen_mm
    count = max(2, round((fb / nearest - fb / farthest) / _DISPARITY_STEP_PX) + 1)
    return np.asarray(fb / np.linspace(fb / nearest, fb / farthest, count))


def hypotheses(
    found: Nominations,
    lens: Camera,
    px_a_sensor_px: float,
    teats_from_thermal: Motion,
    depth_mm: Array,
    down: tuple[float, float],
) -> Array:
    """Teats (n, d, 8), the fits' frame: each nomination at each depth, with its width, leaning
    neither towards the camera nor away. ``down``: of a bar without lean, in the picture.
    """
    centre = (found.centre_px + 0.5) * px_a_sensor_px - 0.5
    normal = lens.normalize(centre)
    rays = np.column_stack([normal, np.ones(len(normal))])
    teats = np.zeros((len(found), len(depth_mm), COUNT))
    points = (rays[:, None] * depth_mm[:, None]).reshape(-1, 3)
    teats[..., :3] = teats_from_thermal.apply(points).reshape(*teats.shape[:2], 3)
    flat = np.column_stack([bar_ways(found.lean, down)[0], np.zeros(len(found))])
    way, sight = flat @ teats_from_thermal.R.T, rays @ teats_from_thermal.R.T
    way -= (way[:, 2] / sight[:, 2])[:, None] * sight  # of the plane through the eye, what is level
    teats[..., LEAN_X] = (way[:, 0] / way[:, 1])[:, None]
    teats[..., HEIGHT] = 1.0
    teats[..., RADIUS] = (found.radius_px * px_a_sensor_px / lens.fc[0])[:, None] * depth_mm
    return teats


def sweep_ends(teats: Array, nominated: Array, maps: tuple[Map, ...], p: Parameters) -> Starts:
    """Best starts among teats (n, d, 8) with thermal end scores ``nominated`` (n,)."""
    best = _by_depth(teats, maps, p, end=True)
    rows, columns, rank = _peaks(best, p.starts_per_nomination)
    return Starts(teats[rows, columns], best[rows, columns], nominated[rows] * _NEXT**rank)


def sweep_bars(
    teats: Array, nominated: Array, maps: tuple[Map, ...], thermal: Map, p: Parameters
) -> Starts:
    """Best starts among teats (n, d, 8) known by their sides: depth first, then the end."""
    rows, columns, rank = _peaks(_by_depth(teats, maps, p, end=False), p.starts_per_nomination)
    deep, nominated = teats[rows, columns], nominated[rows] * _NEXT**rank
    slid = np.repeat(deep[:, None], len(_SLIDE_MM), axis=1)
    slid[..., :3] -= _SLIDE_MM[:, None] * axes(deep)[:, None]
    flat = slid.reshape(-1, COUNT)
    # by optical and thermal pictures: one kind may take an arm for an end
    optical = _joint(flat, maps, _CROSS_PX).max(axis=0)
    score = optical + 0.5 * _scores(flat, thermal, _CROSS_PX[:1])[0]
    score = score.reshape(slid.shape[:2])
    rows, columns, rank = _peaks(score, 2)
    return Starts(slid[rows, columns], score[rows, columns] / 1.5, nominated[rows] * _NEXT**rank)


def _by_depth(teats: Array, maps: tuple[Map, ...], p: Parameters, *, end: bool) -> Array:
    """Scores (n, d) of teats (n, d, 8); 0 for a size that no teat has."""
    score, possible = np.zeros(teats.shape[:2]), of_teats(teats, p)
    score[possible] = _joint(teats[possible], maps, _CROSS_PX, end=end).max(axis=0)
    return score


def of_teats(teats: Array, p: Parameters) -> NDArray[np.bool_]:
    """Which of teats (..., 8) may have such a radius."""
    least, most = p.prior.radii_mm
    radius = teats[..., RADIUS]
    return np.asarray((radius > 0.75 * least) & (radius < 1.3 * most))


def best_starts(ends: Starts, sides: Starts, maps: tuple[Map, ...], p: Parameters) -> Array:
    """The most promising teats (m, 8) of both kinds, and more of those known by their ``sides``,
    with the best shift and swell.
    """
    starts = ends + sides
    best = np.argsort(-starts.score * starts.nominated, kind="stable")[: p.most_starts].tolist()
    teats = starts.take(best + _apart(starts, best, len(ends.score), p)).teats
    if len(teats) == 0:
        return teats
    m, swells = len(teats), len(_SWELLS)
    joint = _joint(np.tile(teats, (swells, 1)), maps, _GRID_PX, np.repeat(_SWELLS, m))
    joint = joint.reshape(-1, swells, m).swapaxes(0, 1)  # (swells, shifts, m)
    swell, shift = np.unravel_index(joint.reshape(-1, m).argmax(axis=0), joint.shape[:2])
    moved = teats.copy()
    right = maps[1].view
    depth_mm = right.camera_from_teats.apply(moved[:, :3])[:, 2:]
    aside_mm = _GRID_PX[shift] * depth_mm / np.array(right.camera.fc)
    moved[:, :3] += aside_mm @ right.camera_from_teats.R[:2]
    moved[:, RADIUS] = np.clip(moved[:, RADIUS] * np.array(_SWELLS)[swell], *p.prior.radii_mm)
    return moved


def _apart(starts: Starts, chosen: list[int], first: int, p: Parameters) -> list[int]:
    """The best from ``first`` on beside those ``chosen``; one near a better one counts for less."""
    places, more = apexes(starts.teats), list[int]()
    squares = (places**2).sum(axis=1)
    near = squares[chosen, None] + squares - 2 * places[chosen] @ places.T < _NEAR_MM**2
    left = starts.score * starts.nominated * _NEAR ** near.sum(axis=0)
    left[[*range(first), *chosen]] = 0.0
    while len(more) < p.more_bar_starts and left.max(initial=0.0) > 0.0:
        more.append(int(left.argmax()))
        beside = ((places - places[more[-1]]) ** 2).sum(axis=1) < _NEAR_MM**2
        left = np.where(beside, _NEAR * left, left)
        left[more[-1]] = 0.0
    return more


def _joint(
    teats: Array,
    maps: tuple[Map, ...],
    shifts: Field,
    swell: Array | float = 1.0,
    *,
    end: bool = True,
) -> Array:
    """Scores (shifts, m) of teats (m, 8) in both pictures; ``end``: with the round end."""
    left, right = (_scores(teats, each, shifts, swell, end=end) for each in maps)
    return np.asarray(np.sqrt(left * right))


def _scores(
    teats: Array, each: Map, shifts: Field, swell: Array | float = 1.0, *, end: bool = True
) -> Array:
    """Scores (shifts, m) of teats (m, 8) in one picture."""
    m = len(teats)
    arc = np.column_stack([-np.cos(_ARC), np.sin(_ARC)])
    swells = np.array(np.broadcast_to(swell, m), dtype=float)
    found = np.empty((len(shifts), m), dtype=np.float32)
    kernels.across(
        each.gradients, shifts, np.ascontiguousarray(teats), swells,
        each.view.numbers, (arc, _BELOW), end, found,
    )  # fmt: skip
    return np.asarray(found)


def _peaks(score: Array, most: int) -> NDArray[np.intp]:
    """Rows, columns and ranks from 0 on (3, k) of the ``most`` highest local maxima of each row of
    scores (n, d).
    """
    left = np.array(score)
    found = []
    every = np.arange(len(left))
    for rank in range(most):
        at = left.argmax(axis=1)
        good = left[every, at] > _LEAST
        found.append([every[good], at[good], np.full(good.sum(), rank)])
        beside = at[:, None] + np.arange(-_APART_STEPS, _APART_STEPS + 1)
        left[every[:, None], np.minimum(np.maximum(beside, 0), left.shape[1] - 1)] = 0.0
    return np.concatenate(found, axis=1)
