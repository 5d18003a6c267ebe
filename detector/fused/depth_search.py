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
from detector.fused.thermal import Field, Nominations, joined, strengths
from detector.geometry import Array, Camera, Motion
from detector.outline import fast
from detector.outline.fit import View
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
    """Teats (m, 8) for the fit, right camera's frame, their scores (m,), and their nominations'."""

    teats: Array
    score: Array
    nominated: Array


@dataclass(frozen=True, slots=True, eq=False)
class Map:
    """Squeezed gradients of one view, blurred by a start's error, with a border of zeros."""

    gx: Field
    gy: Field
    view: View

    @classmethod
    def of(cls, view: View, blur_px: float) -> Map:
        """The map of a view."""
        return cls(*strengths(view.field, blur_px, noises=3.0, border=1), view)


def depths_mm(calibration: Calibration, p: Parameters) -> Array:
    """Depths (d,) from the nearest to the farthest, evenly in disparity."""
    fb = calibration.right.fc[0] * calibration.baseline_mm
    count = max(2, round((fb / p.nearest_mm - fb / p.farthest_mm) / _DISPARITY_STEP_PX) + 1)
    return np.asarray(fb / np.linspace(fb / p.nearest_mm, fb / p.farthest_mm, count))


def hypotheses(
    found: Nominations,
    lens: Camera,
    px_a_sensor_px: float,
    right_from_thermal: Motion,
    depth_mm: Array,
) -> Array:
    """Teats (n, d, 8), right camera's frame: each nomination at each depth, with its width."""
    centre = (found.centre_px + 0.5) * px_a_sensor_px - 0.5
    normal = lens.normalize(centre)
    rays = np.column_stack([normal, np.ones(len(normal))])
    teats = np.zeros((len(found), len(depth_mm), COUNT))
    points = (rays[:, None] * depth_mm[:, None]).reshape(-1, 3)
    teats[..., :3] = right_from_thermal.apply(points).reshape(*teats.shape[:2], 3)
    lean = np.column_stack([found.lean, np.ones(len(found)), np.zeros(len(found))])
    down = lean @ right_from_thermal.R.T
    teats[..., LEAN_X] = (down[:, 0] / down[:, 1])[:, None]
    teats[..., HEIGHT] = 1.0
    teats[..., RADIUS] = (found.radius_px * px_a_sensor_px / lens.fc[0])[:, None] * depth_mm
    return teats


def sweep_ends(teats: Array, nominated: Array, maps: tuple[Map, ...], p: Parameters) -> Starts:
    """Best starts among teats (n, d, 8) with thermal end scores ``nominated`` (n,)."""
    best = _by_depth(teats, maps, p, end=True)
    rows, columns = _peaks(best, p.starts_per_nomination)
    return Starts(teats[rows, columns], best[rows, columns], nominated[rows] * _NEXT ** _rank(rows))


def sweep_bars(
    teats: Array, nominated: Array, maps: tuple[Map, ...], thermal: Map, p: Parameters
) -> Starts:
    """Best starts among teats (n, d, 8) known by their sides: depth first, then the end."""
    rows, columns = _peaks(_by_depth(teats, maps, p, end=False), p.starts_per_nomination)
    deep, nominated = teats[rows, columns], nominated[rows] * _NEXT ** _rank(rows)
    slid = np.repeat(deep[:, None], len(_SLIDE_MM), axis=1)
    slid[..., :3] -= _SLIDE_MM[:, None] * axes(deep)[:, None]
    flat = slid.reshape(-1, COUNT)
    # by optical and thermal pictures: one kind may take an arm for an end
    optical = _joint(flat, maps, _CROSS_PX).max(axis=0)
    score = optical + 0.5 * _scores(flat, thermal, _CROSS_PX[:1])[0]
    score = score.reshape(slid.shape[:2])
    rows, columns = _peaks(score, 2)
    return Starts(
        slid[rows, columns], score[rows, columns] / 1.5, nominated[rows] * _NEXT ** _rank(rows)
    )


def _by_depth(teats: Array, maps: tuple[Map, ...], p: Parameters, *, end: bool) -> Array:
    """Scores (n, d) of teats (n, d, 8); 0 for a size that no teat has."""
    score = _joint(teats.reshape(-1, COUNT), maps, _CROSS_PX, end=end).max(axis=0)
    radius = teats[..., RADIUS]
    possible = (radius > 0.75 * p.least_radius_mm) & (radius < 1.3 * p.greatest_radius_mm)
    return np.where(possible, score.reshape(radius.shape), 0.0)


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
    moved[:, :2] += _GRID_PX[shift] * moved[:, 2:3] / np.array(maps[1].view.camera.fc)
    moved[:, RADIUS] = np.clip(
        moved[:, RADIUS] * np.array(_SWELLS)[swell], p.least_radius_mm, p.greatest_radius_mm
    )
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
    camera, motion, m = each.view.camera, each.view.camera_from_teats, len(teats)
    arc = np.column_stack([-np.cos(_ARC), np.sin(_ARC)])
    if loops := fast.compiled():
        swells = np.array(np.broadcast_to(swell, m), dtype=float)
        found = loops.across(
            each.gx, each.gy, shifts, np.ascontiguousarray(teats), swells, each.view.numbers,
            each.view.corner_px, arc, _BELOW, end,
        )  # fmt: skip
        return np.asarray(found)
    down_mm = np.column_stack([teats[:, LEAN_X], np.ones(m), np.zeros(m)])
    points = motion.apply(np.concatenate([teats[:, :3], teats[:, :3] + 20.0 * down_mm]))
    pixels = camera.project(points)
    seen = np.isfinite(pixels[:m] + pixels[m:]).all(axis=1, keepdims=True)
    middle = np.where(seen, pixels[:m], -1e4)  # nowhere, and so without a score
    down = np.where(seen, pixels[m:] - pixels[:m], [0.0, 1.0])
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    right = np.column_stack([down[:, 1], -down[:, 0]])
    half = (swell * teats[:, RADIUS] * camera.fc[0] / np.maximum(points[:m, 2], 1.0))[:, None]
    at = middle - each.view.corner_px
    arc = arc[:, :1, None] * down + arc[:, 1:, None] * right
    below = _BELOW[:, None, None] * down
    left, other = (
        _across(each, shifts, at + half * (below + s * right), s * right[None]) for s in (-1.0, 1.0)
    )
    top = _across(each, shifts, at + half * arc, arc) if end else np.ones_like(left)
    return joined(top, left, other)


def _across(each: Map, shifts: Field, at: Array, normals: Array) -> Array:
    """Mean strength (shifts, m) across an outline ``at`` (k, m, 2) along ``normals``; 0 outside."""
    index, columns = np.zeros((1, 1, 1), dtype=np.int32), each.gx.shape[1]
    for axis, step in ((0, 1), (1, columns)):
        place = at[:, None, :, axis].astype(np.float32) + (shifts[:, axis, None] + np.float32(1.5))
        # the border holds nothing
        np.maximum(place, 0, out=place)
        np.minimum(place, each.gx.shape[1 - axis] - 1, out=place)
        index = index + place.astype(np.int32) * step
    n = normals.astype(np.float32)[:, None]
    across = each.gx.ravel()[index] * n[..., 0]
    across += each.gy.ravel()[index] * n[..., 1]
    return np.asarray(np.abs(across, out=across).mean(axis=0))


def _rank(rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """How many times (m,) each of ``rows`` (m,) came before."""
    return np.array(
        [np.count_nonzero(rows[:i] == row) for i, row in enumerate(rows)], dtype=np.intp
    )


def _peaks(score: Array, most: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the ``most`` highest local maxima of each row (n, d)."""
    left = np.array(score)
    rows, columns = [], []
    every = np.arange(len(left))
    for _ in range(most):
        at = left.argmax(axis=1)
        good = left[every, at] > _LEAST
        rows.append(every[good])
        columns.append(at[good])
        beside = at[:, None] + np.arange(-_APART_STEPS, _APART_STEPS + 1)
        left[every[:, None], np.minimum(np.maximum(beside, 0), left.shape[1] - 1)] = 0.0
    return np.concatenate(rows), np.concatenate(columns)
