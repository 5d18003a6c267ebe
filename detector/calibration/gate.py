"""The gate that every calibration passes, from any source: lenses that no camera has, and pairs
that see no depth. What can't be is refused where it enters; no detector can be blamed for it.

A distortion is one-to-one as long as the determinant of its Jacobian stays above zero on the way
from the centre to each place of the picture.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from detector.geometry import Array, Camera, Motion, distort, distort_slopes

FOCAL_RATIO = 1.2  # fx over fy: square pixels but for the oldest video cards, with 12 / 11
FOCAL_OVER_SIDE = (0.1, 100.0)  # of the picture's longer side: 157 degrees to half a degree
NEAR = 0.25  # of the picture's size, by which a centre may lie outside
MOST_SKEW = 0.1
MOST_TURN_DEG = 90.0  # between two cameras that see the same
BASELINE_MM = (3.0, 5000.0)
UNITS = {1000.0: "metres", 10.0: "centimetres", 25.4: "inches", 304.8: "feet", 0.001: "micrometres"}
_DIRECTIONS = 13  # a side
_STEPS = 400  # from the axis outwards
_FARTHEST = 10.0  # tangent of the angle from the axis


def lens_faults(camera: Camera) -> Iterator[tuple[str, str]]:
    """What no camera has, as (key, sentence)."""
    (fx, fy), (cx, cy), size = camera.fc, camera.cc, camera.image_size
    side, shape = max(size), "{} x {} px".format(*size)
    low, high = (ratio * side for ratio in FOCAL_OVER_SIDE)
    if not (low <= min(fx, fy) and max(fx, fy) <= high):
        unit = " Is it in millimetres? Pixels are wanted" if max(fx, fy) < low else ""
        yield "fc", f"{fx:g} and {fy:g} px are no focal lengths for a picture of {shape}.{unit}"
    elif not 1.0 / FOCAL_RATIO <= fx / fy <= FOCAL_RATIO:
        yield "fc", f"{fx:g} and {fy:g} px differ by more than any camera's: no pixel is so oblong"
    if any(not -NEAR * n <= c <= (1.0 + NEAR) * n for c, n in zip((cx, cy), size, strict=True)):
        what = f"the centre ({cx:g}, {cy:g}) lies far outside of a picture of {shape}"
        yield "cc", f"{what}: is it of another picture size, or of a part of the sensor?"
    if abs(camera.alpha_c) > MOST_SKEW:
        yield "alpha_c", f"a skew of {camera.alpha_c:g} is none that a camera has"
    if folds(camera):
        what = "this distortion folds the picture: a place on it has no direction of view, or two."
        yield "kc", f"{what} Is {list(camera.kc)} in the order k1 k2 p1 p2 k3, of this lens model?"


def folds(camera: Camera) -> bool:
    """Whether the distortion stops being one-to-one within the picture."""
    (fx, fy), (cx, cy), (width, height) = camera.fc, camera.cc, camera.image_size
    if not any(camera.kc):
        return False
    # from the centre to places of the rim, its corners among them
    along, zero = np.linspace(0.0, 1.0, _DIRECTIONS), np.zeros(_DIRECTIONS)
    rim = np.hstack([[along, zero], [along, zero + 1], [zero, along], [zero + 1, along]])
    # fine near the axis, where narrow lenses have all of their picture
    radius = np.geomspace(1e-4, _FARTHEST, _STEPS)[None]
    with np.errstate(over="ignore", invalid="ignore"):
        angle = np.arctan2((height * rim[1] - cy) / fy, (width * rim[0] - cx) / fx)[:, None]
        u, v = radius * np.cos(angle), radius * np.sin(angle)
        x, y = distort(u, v, camera.kc)
        a, b, d = distort_slopes(u, v, camera.kc)
        determinant = a * d - b * b
        column, row = fx * (x + camera.alpha_c * y) + cx, fy * y + cy
        inside = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
    entered = np.logical_or.accumulate(inside, axis=1)
    left = np.logical_or.accumulate(entered & ~inside, axis=1)
    return bool((inside & ~left & ~(determinant > 0.0)).any())


def pair_faults(right_from_left: Motion) -> Iterator[str]:
    """What keeps a stereo pair from seeing depth: the unit, side and turn of its right camera."""
    baseline_mm = float(np.linalg.norm(right_from_left.T))
    low, high = BASELINE_MM
    if not low <= baseline_mm <= high:
        yield f"a baseline of {baseline_mm:.4g} mm {unit_text(baseline_mm)}"
    elif side_mm(right_from_left) < -0.5 * baseline_mm:
        yield (
            f"the right camera stands {-side_mm(right_from_left):.0f} mm to the left of the left"
            " one: left and right are exchanged, or T is of the other direction (X_right = R X_left"
            " + T)"
        )
    turn = float(np.degrees(np.arccos(np.clip(right_from_left.R[2, 2], -1.0, 1.0))))
    if turn > MOST_TURN_DEG:
        yield f"the two cameras look {turn:.0f} degrees apart: they see nothing in common"


def unit_text(baseline_mm: float) -> str:
    """What a baseline that can't be looks like."""
    low, high = BASELINE_MM
    if 0.0 < baseline_mm < low and baseline_mm * 1000.0 <= high:
        return f"looks like metres: {1000.0 * baseline_mm:.4g} mm are meant"
    if baseline_mm > high and baseline_mm / 1000.0 >= low:
        return f"looks like micrometres: {baseline_mm / 1000.0:.4g} mm are meant"
    return "is none that a stereo pair has"


def side_mm(right_from_left: Motion) -> float:
    """How far the right camera stands to the right of the left one, in the left one's frame."""
    at: Array = right_from_left.inverse().T
    return float(at[0])
