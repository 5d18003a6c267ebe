"""Where each camera shows teat ends whose places are known, for a check of the cameras themselves.

A teat is fitted to both optical pictures from starts at the known end and a few disparities beside
it; what the fit's end is off the known one, in columns of the left picture against the right's, is
the disparity that the calibration gets wrong. Rows and the thermal picture are measured as the
detector's own witness does (detector.outline.offsets), the latter about the known end.

An outline is found within some pixels of where it is looked for. So it is looked for again where
the pictures put it until it stays, and, where few ends are found or they contradict each other, at
other shifts of the right picture, the same for all ends of a frame. What is farther off than
`REACH_PX` and `THERMAL_REACH_PX` isn't measured.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.geometry import Array
from detector.outline import pictures
from detector.outline.fine import FINE_OUTLINE, ROUGH_OUTLINE, Fitted, fine
from detector.outline.fit import look, step, upright, weights
from detector.outline.model import COUNT, END, apexes
from detector.outline.offsets import (
    LEAST_END,
    LEAST_SEEN,
    STAYS_PX,
    row_offsets,
    thermal_offsets_far,
)
from detector.outline.prior import OutOfDomainError, Prior, disparities_px, world_from_teats
from detector.outline.views import optical_views, thermal_view
from detector.protocol import Frames

_BESIDE_PX = np.arange(-7.5, 7.6, 2.5)  # disparities about the known one
_ROUGH_STEPS, _ROUGH_SCALE = 4, 20.0
_CLOSE_PX = 0.3  # of an edge to the fitted outline
_NEAR_MM = 8.0  # across the line of sight; farther off it is another thing
REACH_PX = (25.0, 10.0)  # of the right picture, columns and rows
NO_THERMAL_MM = 1.0  # `EndOffsets.thermal_mm_a_px` where no thermal picture was looked at
# (left columns, right columns, right rows) tried, px
_ROW_SHIFTS = tuple((0.0, 0.0, y) for y in (-4.0, 4.0, -8.0, 8.0))
_COLUMN_SHIFTS = tuple(
    (*at, 0.0) for x in (-12.5, 12.5, -25.0, 25.0) for at in ((x, 0.0), (0.0, x))
)
_AGREE_PX = 2.0  # ends of one frame: a camera that is off is off alike for all of them
_AGAIN, _AGAIN_SHIFTED = 5, 3


@dataclass(frozen=True, slots=True)
class EndOffsets:
    """How far one end is seen off its known place; None where a picture doesn't show it.

    ``disparity_px``: left column minus right column; ``rows_px``: right row minus left row;
    ``thermal_px``: column and row, sensor pixels. A pixel of disparity moves this end by
    ``mm_a_px`` in depth, and is what the right camera shows when turned by ``deg_a_px``; a pixel of
    the thermal sensor is ``thermal_mm_a_px`` there, `NO_THERMAL_MM` where there is none.
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
    known = world_from_teats(calibration).inverse().apply(ends_mm)
    seen = _seen(left, right, calibration, known, (0.0, 0.0, 0.0))
    for shifts in (_ROW_SHIFTS, _COLUMN_SHIFTS):
        if not seen.good:
            tried = [_seen(left, right, calibration, known, shift) for shift in shifts]
            seen = max((seen, *(one for one in tried if one.good)), key=lambda one: one.ends)
    thermal, thermal_mm = np.full((len(known), 2), np.nan), np.full(len(known), NO_THERMAL_MM)
    with suppress(pictures.UnusableError, OutOfDomainError):  # no thermal picture, no lens
        warm = thermal_view(frames, calibration)
        there = seen.fitted.teats[seen.measured]
        there[:, :3] += known[seen.measured] - apexes(there)
        thermal[seen.measured] = thermal_offsets_far(there, warm)
        depth = warm.camera_from_teats.apply(known)[:, 2]
        thermal_mm = depth / warm.camera.fc[0]
    figures = np.column_stack([seen.disparity_px, seen.rows_px, thermal])
    figures[~seen.measured] = np.nan
    focal = calibration.right.fc[0]
    mm_a_px = focal * calibration.baseline_mm / disparities_px(known, calibration) ** 2
    found = []
    for values, mm, across in zip(figures, mm_a_px, thermal_mm, strict=True):
        rounded = [round(float(v), 4) if np.isfinite(v) else None for v in values]
        turn = float(np.degrees(1.0 / focal))
        scale = round(float(mm), 4), round(float(across), 4), turn
        found.append(EndOffsets(rounded[0], rounded[1], (rounded[2], rounded[3]), *scale))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _EndFits:
    """What both optical pictures show of k ends: the best fit to each, which ends were measured
    (k,), and their offsets (k,), px.
    """

    fitted: Fitted
    measured: NDArray[np.bool_]
    disparity_px: Array
    rows_px: Array

    @property
    def ends(self) -> int:
        """How many ends were measured."""
        return int(self.measured.sum())

    @property
    def good(self) -> bool:
        """At least half of the ends were measured."""
        return 0 < len(self.measured) <= 2 * self.ends


def _seen(
    left: NDArray[Any],
    right: NDArray[Any],
    stated: Calibration,
    known: Array,
    shift: tuple[float, float, float],
) -> _EndFits:
    """Of ends (k, 3), the fits' frame, looked for where the pictures are shifted by so many
    columns of the left and right one and rows of the right one; rows follow what is found.
    """
    x_left, x_right, y = shift
    stated = stated.moved("left", "cx", x_left).moved("right", "cx", x_right)
    prior = Prior()
    tight = replace(prior, taper_sd=0.5 * prior.taper_sd, height_sd=0.2 * prior.height_sd)
    for _ in range(_AGAIN if shift == (0.0, 0.0, 0.0) else _AGAIN_SHIFTED):
        calibration = stated.moved("right", "cy", y)
        starts = upright(known, calibration, _BESIDE_PX, prior)
        teats = starts.reshape(-1, COUNT)
        views = tuple(optical_views(left, right, calibration, teats))
        for _ in range(_ROUGH_STEPS):
            rough = look(teats, views, ROUGH_OUTLINE, fine=False)
            teats = step(teats, rough, weights(rough, _ROUGH_SCALE), tight)
        fitted = fine(teats, None, views, prior)
        best = _best(fitted, known)
        some = fitted.take(np.maximum(best, 0))
        rows, _ = row_offsets(some, prior)
        down = float(np.median(rows[best >= 0])) if (best >= 0).any() else np.nan
        stays = abs(down) < STAYS_PX
        if stays or not abs(y + down) < REACH_PX[1]:
            break
        y += down
    off = _disparity(calibration, apexes(some.teats)) - _disparity(calibration, known)
    # sides run on where the rows are wrong, the end can't be at two places
    ends = _close(some).reshape(len(best), -1, len(FINE_OUTLINE.part))[
        ..., FINE_OUTLINE.part == END
    ]
    measured = (best >= 0) & (ends.mean(axis=2).min(axis=1) >= LEAST_END) & stays
    if measured.any():
        measured &= np.abs(off - np.median(off[measured])) < _AGREE_PX
    return _EndFits(some, measured, off + x_left - x_right, rows + y)


def _best(fitted: Fitted, known: Array) -> NDArray[np.intp]:
    """For each known end the fit (k,) with the most of its outline seen near it; -1 for none."""
    ends = apexes(fitted.teats).reshape(len(known), -1, 3)
    # on the same line of sight of the right camera, whatever its depth
    across = ends - known[:, None] * (ends[..., 2:3] / known[:, None, 2:3])
    near = np.linalg.norm(across, axis=2) < _NEAR_MM
    share = np.where(near, _close(fitted).mean(axis=1).reshape(near.shape), 0.0)
    at = share.argmax(axis=1)
    rows = np.arange(len(known))
    return np.where(share[rows, at] >= LEAST_SEEN, rows * near.shape[1] + at, -1)


def _close(fitted: Fitted) -> NDArray[np.bool_]:
    """Which of the outlines' points (m, views * n) have an edge near them."""
    off = np.abs(fitted.seen.offset_px)
    return np.asarray((fitted.weight > 0) & (off < _CLOSE_PX))


def _disparity(calibration: Calibration, points: Array) -> Array:
    """Left minus right columns (k,) of points (k, 3), the fits' frame."""
    left_px, right_px = calibration.project(world_from_teats(calibration).apply(points))
    return np.asarray(left_px[:, 0] - right_px[:, 0])
