"""How wide and how clipped the edges of fitted teats are, and what that does to their ends.

An edge's width is its contrast over its greatest slope: some 1.6 px in a sharp picture, 5 with a
Gaussian blur of 2 px, L after a motion of L px. Motion along a teat widens its end alone. The
factors were measured on our own renderer's scenes, blurred and overexposed (docs/detectors.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detector.fused.edges import CLEAR, sample
from detector.fused.fit import View
from detector.fused.model import END, apexes, axes
from detector.fused.refine import FINE_OUTLINE, Fitted
from detector.geometry import Array

_X_PX = np.arange(-6.0, 6.5, 0.5)
_LEVEL_PX, _SLOPE_PX = 4.0, 3.0  # levels are beyond, the greatest slope within
_OUTER, _INNER = np.flatnonzero(_X_PX >= _LEVEL_PX), np.flatnonzero(_X_PX <= -_LEVEL_PX)
_MIDDLE = np.flatnonzero(np.abs(_X_PX[1:-1]) <= _SLOPE_PX)
_LEAST_LINES = 4
_KNOWN = 0.3  # of a frame's teats and pictures, or nothing is known
# contrast, in noises and as a share of the profile's range: or it is paint, texture or a limb
_CLEAR_STEP, _MONOTONOUS = 15.0, 0.7
_SHARP_PX, _MOST_PX = 2.0, 4.2  # wider edges widen covariances; beyond that there are no ends
_MOST_UNLIKE_PX = 1.6  # an end's edges over its sides': the whole end is smeared
# sd along the teat and across it, px: a px of width, a px that motion adds, a share clipped
_BLUR, _MOTION, _CLIPPED = (0.35, 0.06), (2.0, 0.4), (0.5, 0.17)
_CLIPPED_DISPARITY_PX = 0.09
_CLIPPED_LEVEL = 0.996  # of the greatest intensity


@dataclass(frozen=True, slots=True, eq=False)
class Sharpness:
    """Widths px of sides and ends, lower quartiles of a frame, 0 if unknown; shares (m, 2) of each
    teat's lines (sides, end) that are clipped, inside or outside.
    """

    side_px: float
    end_px: float
    clipped: Array


def sharpness(fitted: Fitted, views: tuple[View, View]) -> Sharpness:
    """Of the edges that the fits found in both optical pictures."""
    n, m = len(FINE_OUTLINE.part), len(fitted.teats)
    parts = (FINE_OUTLINE.part != END, FINE_OUTLINE.part == END)
    if m == 0:
        return Sharpness(0.0, 0.0, np.zeros((0, 2)))
    seen, outer = fitted.seen, _X_PX > 1.5  # clear of the edge
    inner = outer[::-1]
    widths, clipped = np.full((m, 2, 2), np.nan), np.zeros((m, 2, 2))
    for number, view in enumerate(views):
        at = slice(number * n, (number + 1) * n)
        offset, normals = np.nan_to_num(seen.offset_px[:, at]), seen.normals[:, at]
        middles = seen.pixels_px[:, at] + offset[..., None] * normals - view.corner_px
        lines = sample(view.field, middles.reshape(-1, 2), normals.reshape(-1, 2), _X_PX)
        lines = lines.reshape(m, n, -1)
        usable = (fitted.weight[:, at] > 0) & (seen.clarity[:, at] > CLEAR)
        usable &= np.isfinite(lines[..., 0])
        white = lines >= _CLIPPED_LEVEL * float(view.field.max())
        for k, part in enumerate(parts):
            for i in range(m):
                which = usable[i] & part
                if which.sum() >= _LEAST_LINES:
                    widths[i, number, k] = _width(lines[i, which].mean(axis=0), view.noise)
                    if white[i, which].any():
                        shares = [white[i, which][:, beyond].mean() for beyond in (inner, outer)]
                        clipped[i, number, k] = max(shares)
    side, end = (_lower_quartile(widths[..., part]) for part in range(2))
    return Sharpness(side, end, clipped.max(axis=1))


def _width(profile: NDArray[np.float32], noise: float) -> float:
    """Contrast over greatest slope, px; NaN where it is no clear step from level to level."""
    high, low = profile[_OUTER].mean(), profile[_INNER].mean()
    slope = np.abs(profile[2:] - profile[:-2]) / (_X_PX[2] - _X_PX[0])
    contrast = float(abs(high - low))
    width = contrast / max(float(slope[_MIDDLE].max()), 1e-6)
    step = contrast > max(_CLEAR_STEP * noise, _MONOTONOUS * float(np.ptp(profile)))
    return width if step and width > 1.0 else np.nan


def _lower_quartile(widths_px: Array) -> float:
    """Of a part's widths (m, 2), NaN where unknown: blur widens all of them, a shaded end its own.
    0 where hardly one is known.
    """
    known = widths_px[np.isfinite(widths_px)]
    return float(np.percentile(known, 25)) if len(known) >= _KNOWN * widths_px.size else 0.0


def too_blurred(found: Sharpness) -> str | None:
    """Why no end can be given, or None."""
    width = max(found.side_px, found.end_px)
    smeared = found.side_px > 0 and found.end_px - found.side_px > _MOST_UNLIKE_PX
    if width <= _MOST_PX and not smeared:
        return None
    way = (
        "by motion along the rows"
        if found.side_px > 1.5 * found.end_px
        else "by motion along the columns"
        if found.end_px > 1.5 * found.side_px
        else "out of focus"
    )
    return f"the optical pictures are blurred ({way}): edges are {width:.1f} px wide"


def blur_covariances(found: Sharpness, teats: Array, px_a_mm: Array, baseline_mm: float) -> Array:
    """(m, 3, 3) mm^2 of the ends of teats (m, 8), right camera's frame: what width and clipping of
    edges add. ``px_a_mm`` (m,): at the ends.
    """
    known = [width for width in (found.side_px, found.end_px) if width]
    wide = max(min(known, default=0.0) - _SHARP_PX, 0.0)
    motion = max(found.end_px - max(found.side_px, _SHARP_PX), 0.0)  # or sides are unknown
    along, across = (
        np.hypot(blur * wide, by_motion * motion) ** 2 + (clip * share) ** 2
        for blur, by_motion, clip, share in zip(
            _BLUR, _MOTION, _CLIPPED, found.clipped.T[::-1], strict=True
        )
    )
    axis, ends = axes(teats), apexes(teats)
    down = axis[:, :, None] * axis[:, None]
    sight = ends / ends[:, 2:]
    deep = _CLIPPED_DISPARITY_PX * found.clipped.max(axis=1) * ends[:, 2] / baseline_mm
    spread = down * along[:, None, None] + (np.eye(3) - down) * across[:, None, None]
    spread += (deep**2)[:, None, None] * (sight[:, :, None] * sight[:, None])
    return np.asarray(spread / (px_a_mm**2)[:, None, None])
