"""Where each camera shows teat ends whose places are known, for a check of the cameras themselves.

A teat is fitted to both optical pictures from starts at the known end and a few disparities beside
it; what the fit's end is off the known one, in columns of the left picture against the right's, is
the disparity that the calibration gets wrong. Rows and the thermal picture are measured as the
detector's own witness does (detector.fused.witness), the latter about the known end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.fused import pictures
from detector.fused.detector import optical_views, thermal_picture
from detector.fused.fit import Parameters, View, look, step, weights
from detector.fused.model import COUNT, HEIGHT, LEAN_X, LEAN_Z, RADIUS, apexes
from detector.fused.refine import FINE_OUTLINE, ROUGH_OUTLINE, Fitted, fine
from detector.fused.witness import row_offsets, thermal_offsets
from detector.geometry import Array
from detector.protocol import Frames

_BESIDE_PX = np.arange(-7.5, 7.6, 2.5)  # disparities about the known one
_ROUGH_STEPS, _ROUGH_SCALE = 4, 20.0
_CLOSE_PX, _LEAST_SEEN = 0.3, 0.6  # of an outline's edges, near the fitted outline
_NEAR_MM = 8.0  # across the line of sight; farther off it is another thing
_LEAST_INFORMATION = 15.0  # of a thermal outline: sd 0.26 px; one far off counts for less anyway


@dataclass(frozen=True, slots=True)
class EndOffsets:
    """How far one end is seen off its known place; None where a picture doesn't show it.

    ``disparity_px``: left column minus right column; ``rows_px``: right row minus left row;
    ``thermal_px``: column and row, sensor pixels. A pixel of disparity moves this end by
    ``mm_a_px`` in depth, and is what the right camera shows when turned by ``deg_a_px``; a pixel of
    the thermal sensor is ``thermal_mm_a_px`` there.
    """

    disparity_px: float | None
    rows_px: float | None
    thermal_px: tuple[float | None, float | None]
    mm_a_px: float
    thermal_mm_a_px: float
    deg_a_px: float


def offsets_at(frames: Frames, calibration: Calibration, ends_mm: Array) -> list[EndOffsets]:
    """Of known ends (k, 3), world frame, mm. Raises UnusableError."""
    left = pictures.optical(frames.left, calibration.left.image_size, "left")
    right = pictures.optical(frames.right, calibration.right.image_size, "right")
    p = Parameters()
    known = calibration.world_from_right.inverse().apply(ends_mm)
    starts = _starts(known, calibration, p)
    views = tuple(optical_views(left, right, calibration, starts))
    fitted = _fitted(starts.reshape(-1, COUNT), views, p)
    best = _best(fitted, known)
    some = fitted.take(np.maximum(best, 0))
    rows, _ = row_offsets(some, p)
    # the same teats with their ends where they are known to be
    there = some.teats.copy()
    there[:, :3] += known - apexes(some.teats)
    thermal, thermal_mm = np.full((len(known), 2), np.nan), np.ones(len(known))
    if calibration.thermal.lens is not None and calibration.thermal_from_right is not None:
        warm = thermal_picture(frames, calibration)
        seen = look(there, (*views, warm.view), FINE_OUTLINE, fine=True)
        hidden = np.zeros(seen.offset_px.shape, dtype=bool)
        shift, weight = thermal_offsets(replace(some, seen=seen, hidden=hidden))
        thermal = np.where(weight > _LEAST_INFORMATION, shift, np.nan)
        depth = warm.view.camera_from_teats.apply(known)[:, 2]
        thermal_mm = depth / warm.view.camera.fc[0]
    disparity = _disparity(calibration, apexes(some.teats)) - _disparity(calibration, known)
    figures = np.column_stack([disparity, rows, thermal])
    figures[best < 0] = np.nan
    focal = calibration.right.fc[0]
    mm_a_px = known[:, 2] ** 2 / (focal * calibration.baseline_mm)
    found = []
    for values, mm, across in zip(figures, mm_a_px, thermal_mm, strict=True):
        told = [round(float(v), 4) if np.isfinite(v) else None for v in values]
        turn = float(np.degrees(1.0 / focal))
        scale = round(float(mm), 4), round(float(across), 4), turn
        found.append(EndOffsets(told[0], told[1], (told[2], told[3]), *scale))
    return found


def _starts(known: Array, calibration: Calibration, p: Parameters) -> Array:
    """Upright teats (k, d, 8), right camera's frame: ends at ``known`` and beside it in depth."""
    fb = calibration.right.fc[0] * calibration.baseline_mm
    depth = fb / (fb / known[:, 2:3] + _BESIDE_PX)
    down = calibration.world_from_right.R.T @ np.array([0.0, 0.0, -1.0])
    axis = down / np.linalg.norm(down)
    teats = np.zeros((len(known), len(_BESIDE_PX), COUNT))
    ends = known[:, None] * (depth / known[:, 2:3])[..., None]
    teats[..., :3] = ends + p.prior.radius_mm * axis
    teats[..., LEAN_X], teats[..., LEAN_Z] = axis[0] / axis[1], axis[2] / axis[1]
    teats[..., RADIUS], teats[..., HEIGHT] = p.prior.radius_mm, 1.0
    return teats


def _fitted(teats: Array, views: tuple[View, ...], p: Parameters) -> Fitted:
    tight = replace(p.prior, taper_sd=0.5 * p.prior.taper_sd, height_sd=0.2 * p.prior.height_sd)
    for _ in range(_ROUGH_STEPS):
        seen = look(teats, views, ROUGH_OUTLINE, fine=False)
        teats = step(teats, seen, weights(seen, _ROUGH_SCALE), tight)
    hidden = np.zeros((len(teats), len(views) * len(FINE_OUTLINE.part)), dtype=bool)
    return fine(teats, hidden, views, p)


def _best(fitted: Fitted, known: Array) -> NDArray[np.intp]:
    """For each known end the fit (k,) with the most of its outline seen near it; -1 for none."""
    ends = apexes(fitted.teats).reshape(len(known), -1, 3)
    # on the same line of sight of the right camera, whatever its depth
    across = ends - known[:, None] * (ends[..., 2:3] / known[:, None, 2:3])
    near = np.linalg.norm(across, axis=2) < _NEAR_MM
    off = np.abs(np.nan_to_num(fitted.seen.offset_px, nan=9.0))
    close = (fitted.weight > 0) & (off < _CLOSE_PX)
    share = np.where(near, close.mean(axis=1).reshape(near.shape), 0.0)
    at = share.argmax(axis=1)
    rows = np.arange(len(known))
    return np.where(share[rows, at] >= _LEAST_SEEN, rows * near.shape[1] + at, -1)


def _disparity(calibration: Calibration, points: Array) -> Array:
    """Left minus right columns (k,) of points (k, 3) in the right camera's frame."""
    left_px, right_px = calibration.project(calibration.world_from_right.apply(points))
    return np.asarray(left_px[:, 0] - right_px[:, 0])
