"""What the pictures show of fitted teats: how much of each outline, how close it is, and warmth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from detector.fused.refine import ROUND_MM, side_stops
from detector.fused.thermal import Field
from detector.geometry import Array, Camera, Motion, or_zero
from detector.outline.edges import CLEAR
from detector.outline.fine import FINE_OUTLINE, FINE_STEPS, Fitted, trusted
from detector.outline.fit import CameraView
from detector.outline.model import END, RADIUS, SIDE_A, SIDE_B, Rows, axes
from detector.outline.offsets import row_offsets
from detector.outline.prior import Prior

_CLOSE_PX, _MOST_SD_PX, _LEAST_RANGE_K = 0.6, 1.2, 0.5
WHOLE_END = 0.9
_ALONG_MM = np.arange(0.0, 44.0, 4.0)  # where a teat must be warm: from the ball's middle down
_ACROSS = (-0.6, 0.0, 0.6)  # of the radius
# an end with both sides: how many of its points are next to a side, and the share of them that is
# seen where it bends; how far from a round end's its sides may stop, and are looked for beyond it
_LEAST_BOTH, _BEND, _BENDS = 0.6, 5, 0.75
_STOP_MM, _BEYOND_MM = 2.0, 24.0


@dataclass(frozen=True, slots=True, eq=False)
class Evidence(Rows):
    """For m fitted teats: seen shares of the outline (m, 3 views: left, right, thermal); misfits px
    (m,); warmth (m, 3 lines), or NaN; largest standard deviation mm (m,).
    """

    end: Array
    side: Array  # the better side
    both: Array  # the other
    misfit_px: Array
    end_misfit_px: Array  # of the rounded end
    warmth: Array
    in_range: Array  # of the middle line, 0: as the picture's surroundings, 1: as its warmest (m,)
    sd_mm: Array
    # whether both sides were followed up to where the last of an end is seen
    followed: NDArray[np.bool_]
    shaped: NDArray[np.bool_]  # fitted as a short teat of any shape
    # the median distance (m, 3 parts) of the thermal outline, NaN where it shows none
    thermal_px: Array
    # whether both sides stop at the end and bend, and how far straight sides go on beyond it, mm
    stops: NDArray[np.bool_]
    goes_on_mm: Array
    # the same of each side in each optical picture (m, 2 pictures, 2), mm; 0 of what is left out
    lines_mm: Array
    # how much wider one optical picture shows it than the other, and how far the right one's edges
    # are off in rows, px
    width_px: Array
    rows_px: Array


def weigh(
    fitted: Fitted,
    covariances: Array,
    warmth: Array,
    levels: Array,
    views: tuple[CameraView, ...],
    prior: Prior,
) -> Evidence:
    """Evidence from edges about m teats in views, covariances (m, 3, 3), and warmth (m, 3), by what
    is cold and warm in the picture, ``levels`` (2,).
    """
    seen, part = fitted.seen, FINE_OUTLINE.part
    # a half that all pictures leave out, as a neighbour may be there, is looked at all the same
    half = fitted.hidden[:, 2 * len(part) :].any(axis=1) & ~fitted.shaped
    if half.any():
        hidden = fitted.hidden & ~half[:, None]
        fitted = replace(fitted, hidden=hidden, weight=trusted(seen, hidden, FINE_STEPS))
    m, n = len(fitted.weight), len(part)
    offset, weight, sd = (
        np.where(np.isnan(a), 9.0, a).reshape(m, -1, n)
        for a in (seen.offset_px, fitted.weight, seen.sd_px)
    )
    good = (weight > 0) & (np.abs(offset) < _CLOSE_PX) & (sd < _MOST_SD_PX)
    open_ = ~fitted.hidden.reshape(m, -1, n)
    shares = list[Array]()  # of good points of those not hidden; mostly hidden: missing
    for p in (SIDE_A, END, SIDE_B):
        shown = open_[:, :, part == p]
        least = np.maximum(shown.sum(axis=2), 0.4 * shown.shape[2])
        shares.append((good[:, :, part == p] & shown).sum(axis=2) / least)
    misfit = _misfit(offset[:, :2], weight[:, :2])
    end_misfit = _misfit(offset[:, :2, part == END], weight[:, :2, part == END])
    sides = np.stack([shares[SIDE_A], shares[SIDE_B]])
    largest = np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])
    better, other = sides.max(axis=0), sides.min(axis=0)
    medians = _offsets(fitted)
    thermal, wide = medians[:, 2], medians[:, :2, [SIDE_A, SIDE_B]].sum(axis=2)
    width = or_zero(np.abs(wide[:, 0] - wide[:, 1]))
    (rows, _), (low, high) = row_offsets(fitted, prior), levels
    in_range = (np.sort(warmth, axis=1)[:, 1] - low) / max(high - low, _LEAST_RANGE_K)
    both, end = other[:, :2].min(axis=1) > _LEAST_BOTH, good[:, :2, part == END]
    bends = np.minimum(end[..., :_BEND].mean(axis=2), end[..., -_BEND:].mean(axis=2)) > _BENDS
    each, together = (mm - ROUND_MM for mm in side_stops(fitted.teats, views, _BEYOND_MM))
    stops = both & bends.all(axis=1) & (np.abs(each) <= _STOP_MM).all(axis=1)
    goes_on = np.where(both, np.clip(together, 0.0, _BEYOND_MM), 0.0)
    lines = np.clip(each.reshape(m, 2, 2).swapaxes(1, 2), 0.0, _BEYOND_MM)
    lines *= np.stack([open_[:, :2, part == p].any(axis=2) for p in (SIDE_A, SIDE_B)], axis=2)
    return Evidence(
        shares[END], better, other, misfit, end_misfit, warmth, in_range, largest,
        fitted.followed, fitted.shaped, thermal, stops, goes_on, lines, width, rows,
    )  # fmt: skip


def _misfit(offset_px: Array, weight: Array) -> Array:
    """Root mean square (m,) of edges (m, views, k), weighted."""
    squares = (offset_px**2 * weight).sum(axis=(1, 2))
    return np.asarray(np.sqrt(squares / np.maximum(weight.sum(axis=(1, 2)), 1e-9)))


def _offsets(fitted: Fitted) -> Array:
    """Median offsets (m, 3 views, 3 parts) of the edges, px; NaN where few are clear."""
    part, shape = FINE_OUTLINE.part, (len(fitted.weight), -1, len(FINE_OUTLINE.part))
    seen, open_ = fitted.seen, ~fitted.hidden.reshape(shape)
    clear = (
        open_ & (seen.clarity > CLEAR).reshape(shape) & np.isfinite(seen.offset_px).reshape(shape)
    )
    values = np.where(clear, seen.offset_px.reshape(shape), np.inf)
    medians = np.full((*clear.shape[:2], 3), np.nan)
    for p in (SIDE_A, END, SIDE_B):
        at = part == p
        count = clear[..., at].sum(axis=2)
        enough = count > 0.5 * np.maximum(open_[..., at].sum(axis=2), 0.3 * at.sum())
        ranked, middle = np.sort(values[..., at], axis=2)[enough], count[enough]
        rows = np.arange(len(middle))
        medians[enough, p] = 0.5 * (ranked[rows, (middle - 1) // 2] + ranked[rows, middle // 2])
    return medians


def warmth_across(
    teats: Array, warm: Field, lens: Camera, thermal_from_right: Motion, px_a_sensor_px: float
) -> Array:
    """Medians (m, 3) of the thermal picture along lines down teats (m, 8); NaN outside."""
    axis = axes(teats)
    line = teats[:, None, None, :3] + _ALONG_MM[:, None] * axis[:, None, None]
    across = (axis[:, [1, 0, 2]] * [-1.0, 1.0, 0.0])[:, None, None]  # at right angles to depth too
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
