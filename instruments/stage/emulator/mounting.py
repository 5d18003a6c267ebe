"""Where the phantom's plate stands on the table when the carriage is somewhere: how the stage is mounted, and its errors of geometry.

The carriage's place is in the controller's own millimetres; scale, squareness and the stage's yaw on the table decide what
they are worth there. What the motors and screws do wrong (lost steps, play) is in the carriage's place already. It may not know
time, the protocol, or what stands on the plate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from instruments.world.phantom import PlatePose


@dataclass(frozen=True, slots=True)
class Mounting:
    """A stage of ``axes`` (as "XYZA") that carries the plate; at ``reference`` (X Y Z in mm, A in degrees) the pose is zero.

    ``scale_errors`` by axis X Y Z A: 0.001 moves a thousandth too far. ``squareness_rad``: by how much the angle from the
    X axis to the Y axis exceeds a right one. ``yaw_rad``: by how much the X axis is turned from the world's, x towards y.
    A turns the plate from x towards y; the turntable stands on X and Y.
    """

    axes: str
    reference: tuple[float, float, float, float]
    scale_errors: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    squareness_rad: float = 0.0
    yaw_rad: float = 0.0

    def pose(self, place: Sequence[float]) -> PlatePose:
        """The plate's pose for a place of the carriage, X Y Z in mm and A in degrees where there is one.

        Driven below its reference, the plate rests on the table.
        """
        x, y, z, a = (self._way(axis, at) for axis, at in zip("XYZA", (*place, self.reference[3])[:4], strict=True))
        lean = math.pi / 2 + self.squareness_rad + self.yaw_rad
        return PlatePose(
            x_mm=x * math.cos(self.yaw_rad) + y * math.cos(lean),
            y_mm=x * math.sin(self.yaw_rad) + y * math.sin(lean),
            z_mm=max(0.0, z),
            yaw_rad=math.radians(a),
        )

    def _way(self, axis: str, at: float) -> float:
        """How far the plate has gone along ``axis`` from the reference; 0 on an axis that carries nothing."""
        index = "XYZA".index(axis)
        return (1.0 + self.scale_errors[index]) * (at - self.reference[index]) if axis in self.axes else 0.0
