"""How far inside each camera's picture a round thing lies, by the calibration alone: what a dry run asks before anything is moved.

May not know of frames, scenes or instruments. Pixel centres at whole numbers from 0; the thermal picture is the un-mirrored one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.geometry import Camera, Motion

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One camera: its name, its lens, and where it stands."""

    name: str
    camera: Camera
    camera_from_world: Motion

    def room_px(self, points_mm: Floats, radii_mm: Floats) -> Floats:
        """(n,) px from the rim of balls at ``points_mm`` (n, 3), world frame, to the picture's nearest edge.

        Negative where a rim is beyond it, not-a-number behind the camera.
        """
        seen = self.camera_from_world.apply(points_mm)
        pixels = self.camera.project(seen)
        rim = radii_mm * max(self.camera.fc) / seen[:, 2]
        width, height = self.camera.image_size
        sides = np.column_stack([pixels + 0.5, np.array([width, height]) - 0.5 - pixels])
        return np.asarray(sides.min(axis=1) - rim)


def views_of(calibration: Calibration) -> tuple[View, ...]:
    """Left, right, and thermal where its lens and its place are calibrated."""
    right_from_world = calibration.world_from_right.inverse()
    left_from_world = calibration.right_from_left.inverse() @ right_from_world
    pair = (View("left", calibration.left, left_from_world), View("right", calibration.right, right_from_world))
    thermal, thermal_from_left = calibration.thermal.lens, calibration.thermal_from_left
    if thermal is None or thermal_from_left is None:
        return pair
    return (*pair, View("thermal", thermal, thermal_from_left @ left_from_world))
