"""How wide and how clipped the edges of fitted teats are, and what that does to their ends.

An edge's width is that of its slope at half of its greatest (full width at half maximum): some 1.5
px in a sharp picture, 5 with a Gaussian blur of 2 px. A limb that darkens beside the edge, or
shade, hardly changes it. Motion along a teat widens the middle of its end alone. The factors were
measured on our own renderer's scenes, blurred and overexposed (docs/detectors.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detector.geometry import Array, or_zero
from detector.outline.edges import LEAST_CLEAR, sample
from detector.outline.fine import FINE_OUTLINE, Fitted
from detector.outline.fit import CameraView
from detector.outline.model import END, SIDE_A, SIDE_B

_X_PX = np.arange(-6.0, 6.5, 0.5)
_STEP_PX = _X_PX[2] - _X_PX[0]  # over which slopes are taken
_MIDDLE = np.flatnonzero(np.abs(_X_PX[1:-1]) <= 3.0)  # where an edge's slope is greatest
_UPWARDS = 0.7  # of a normal: the part of an end that motion along a teat smears
_LEAST_LINES = 4
_KNOWN = 0.3  # of a frame's teats and pictures, or nothing is known
_CLEAR_SLOPE = 8.0  # in noises of the mean profile
_SHARP_PX, _MOST_PX = 1.8, 4.2  # wider edges widen covariances; beyond that there are no ends
# where sides are as narrow as the first, ends may be wider than they by the second: all are shaded
_IN_FOCUS_PX, _SHADED_PX = 2.4, 3.0
# sd along the teat and across it, px: a px of width, a px that motion adds, a share clipped
_BLUR, _MOTION, _CLIPPED = (0.35, 0.06), (0.6, 0.15), (0.5, 0.17)
_CLIPPED_DISPARITY_PX = 0.09
_CLIPPED_LEVEL = 0.996  # of the greatest intensity


@dataclass(frozen=True, slots=True, eq=False)
class Sharpness:
    """Widths px, 0 if unknown: of sides the lower quartile of a frame, of ends the least; shares
    (m, 2) of each teat's lines (sides, end) that are clipped, inside or outside.
    """

    side_px: float
    end_px: float
    clipped: Array


def sharpness(fitted: Fitted, views: tuple[CameraView, ...]) -> Sharpness:
    """Of the edges that the fits found in both optical pictures."""
    n, m = len(FINE_OUTLINE.part), len(fitted.teats)
    if m == 0:
        return Sharpness(0.0, 0.0, np.zeros((0, 2)))
    seen, outer = fitted.seen, _X_PX > 1.5  # clear of the edge
    inner, of_end = outer[::-1], FINE_OUTLINE.part == END
    widths, clipped = np.full((m, 2, 2), np.nan), np.zeros((m, 2, 2))  # by picture and part
    for number, view in enumerate(views):
        at = slice(number * n, (number + 1) * n)
        offset, normals = or_zero(seen.offset_px[:, at]), seen.normals[:, at]
        middles = seen.pixels_px[:, at] + offset[..., None] * normals - view.corner_px
        lines = sample(view.field, middles.reshape(-1, 2), normals.reshape(-1, 2), _X_PX)
        lines = lines.reshape(m, n, -1)
        usable = (fitted.weight[:, at] > 0) & (seen.clarity[:, at] > LEAST_CLEAR)
        usable &= np.isfinite(lines[..., 0])
        lines[~usable] = 0.0
        white = lines >= _CLIPPED_LEVEL * float(view.field.max())
        beyond = np.stack([white[..., side].mean(axis=2) for side in (inner, outer)], axis=2)
        # a side that is darker than what is behind it, and one that is brighter, are alike
        steps = lines[..., outer].mean(axis=2) - lines[..., inner].mean(axis=2)
        for one in (SIDE_A, SIDE_B):
            of_side = FINE_OUTLINE.part == one
            lines[:, of_side] *= np.sign(steps[:, of_side].sum(axis=1))[:, None, None]
        upwards = of_end & (np.abs(normals[..., 1]) > _UPWARDS)
        for k, part in enumerate((usable & ~of_end, usable & upwards)):
            count = part.sum(axis=1)
            known = count >= _LEAST_LINES
            share = (part / np.maximum(count, 1)[:, None])[:, None]
            noise = view.noise / np.sqrt(np.maximum(count, 1))
            widths[known, number, k] = _widths((share @ lines)[:, 0], noise)[known]
            clipped[known, number, k] = (share @ beyond)[known, 0].max(axis=1)
    side, end = (_narrow(widths[..., part], share) for part, share in enumerate((25.0, 0.0)))
    return Sharpness(side, end, clipped.max(axis=1))


def _widths(profiles: Array, noise: Array) -> Array:
    """Full widths at half maximum of profiles' slopes (n, s), px; NaN without a clear one."""
    slope = (profiles[:, 2:] - profiles[:, :-2]) / _STEP_PX
    peak = _MIDDLE[np.abs(slope[:, _MIDDLE]).argmax(axis=1)]
    greatest = slope[np.arange(len(slope)), peak]
    clear = np.abs(greatest) >= _CLEAR_SLOPE * np.sqrt(2.0) * noise / _STEP_PX
    share = slope / np.where(clear, greatest, np.inf)[:, None]
    samples = _to_half(share, peak) + _to_half(share[:, ::-1], share.shape[1] - 1 - peak)
    return np.where(clear, 0.5 * _STEP_PX * samples, np.nan)


def _to_half(share: Array, peak: NDArray[np.intp]) -> Array:
    """How many samples (n,) after its peak, where it is 1, ``share`` (n, s) falls to a half."""
    below = (share < 0.5) & (np.arange(share.shape[1]) > peak[:, None])
    at, row = np.maximum(below.argmax(axis=1), 1), np.arange(len(share))
    fall = share[row, at - 1] - share[row, at]
    part = (0.5 - share[row, at]) / np.where(fall > 0, fall, 1.0)
    last = share.shape[1] - 1.0
    return np.asarray(np.where(below.any(axis=1), at - part, last) - peak)


def _narrow(widths_px: Array, percent: float) -> float:
    """Of a part's widths (m, 2), NaN where unknown, so many of which are narrower: blur widens all
    of them, shade its own. 0 where hardly one is known.
    """
    known = widths_px[np.isfinite(widths_px)]
    enough = len(known) >= max(_KNOWN * widths_px.size, 2)
    return float(np.percentile(known, percent)) if enough else 0.0


def too_blurred(found: Sharpness) -> str | None:
    """Why no end can be given, or None."""
    width = max(found.side_px, found.end_px)
    in_focus = 0 < found.side_px <= _IN_FOCUS_PX
    if width <= (found.side_px + _SHADED_PX if in_focus else _MOST_PX):
        return None
    way = (
        "by motion along the rows"
        if found.side_px > 1.5 * found.end_px
        else "by motion along the columns"
        if found.end_px > 1.5 * found.side_px
        else "out of focus"
    )
    return f"the optical pictures are blurred ({way}): edges are {width:.1f} px wide"


def blur_covariances(
    found: Sharpness, axis: Array, ends: Array, px_a_mm: Array, baseline_mm: float
) -> Array:
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
    down = axis[:, :, None] * axis[:, None]
    sight = ends / ends[:, 2:]
    deep = _CLIPPED_DISPARITY_PX * found.clipped.max(axis=1) * ends[:, 2] / baseline_mm
    spread = down * along[:, None, None] + (np.eye(3) - down) * across[:, None, None]
    spread += (deep**2)[:, None, None] * (sight[:, :, None] * sight[:, None])
    return np.asarray(spread / (px_a_mm**2)[:, None, None])
