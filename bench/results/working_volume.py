"""The working volume: what both optical cameras see, in front of them and not too far away. It is
the rig's, by its calibration, wherever the world's origin is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from detector.calibration import Calibration
from detector.geometry import Array

FARTHEST_MM = 10_000.0  # no cow is milked farther from the cameras
# of a picture's size: an end that a picture cuts off is placed beside it
BESIDE = 0.25
NO_LENS = (0.0, 0.0, 0.0, 0.0, 0.0)


def outside_picture(pixels_px: Array, size: tuple[int, int], margin: float) -> Array:
    """Which pixels (n, 2) are farther from a picture of this size (columns, rows) than ``margin``,
    a share of the size; those that are no numbers too.
    """
    wide = margin * np.array(size)
    return np.asarray(~((pixels_px >= -wide) & (pixels_px <= size + wide)).all(axis=1))


def outside_volume(points_mm: Array, calibration: Calibration) -> Array:
    """Which world points (n, 3) are where no end of this rig can be."""
    # far beside its picture a lens model may fold a point back into it: without distortion
    left, right = replace(calibration.left, kc=NO_LENS), replace(calibration.right, kc=NO_LENS)
    in_left, in_right = replace(calibration, left=left, right=right).project(points_mm)
    away_mm = np.linalg.norm(calibration.world_from_right.inverse().apply(points_mm), axis=1)
    beside_left = outside_picture(in_left, left.image_size, BESIDE)
    beside_right = outside_picture(in_right, right.image_size, BESIDE)
    return np.asarray(np.any([beside_left, beside_right, away_mm > FARTHEST_MM], axis=0))
