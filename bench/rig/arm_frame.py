"""The table frame: where the arm stands, from three touches; how well that is known, from the
touches beyond three.

Strategy: the 3-2-1 rule. The first touch is the origin, the second lies on the x axis, the third in
the plane z = 0 on the side of positive y. Nothing is averaged, so every further touch is an
independent check and gives a residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from math import sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from detector.geometry import Motion

DEFINING = ("origin", "x axis", "plane")
# nearer together, an arm of 0.23 mm turns the frame by more than 3 mrad: 1.5 mm at half a metre
APART_MM = 100.0
_STEP_MM = 1e-3

Floats = NDArray[np.float64]
Triple = tuple[float, float, float]


class FrameError(ValueError):
    """The touches give no frame. The sentence says which of them, and what to do."""


@dataclass(frozen=True, slots=True)
class TouchedPoint:
    """One touch: ``arm_mm`` in the arm's frame, ``spread_mm`` of its reading. ``world_mm`` where
    its place is known; a check point without it lies in the plane z = 0.
    """

    name: str
    arm_mm: Triple
    spread_mm: float = 0.0
    world_mm: Triple | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TableFrame:
    """``world_from_arm`` of one arm at one place. The first three ``points`` define it, the others
    check it.
    """

    made: datetime
    serial_number: str
    points: tuple[TouchedPoint, ...]
    world_from_arm: Motion

    @classmethod
    def from_touches(
        cls, made: datetime, serial_number: str, points: Sequence[TouchedPoint]
    ) -> TableFrame:
        """The frame of at least three touches, in the order of `DEFINING`, then check points.
        Raises FrameError.
        """
        if len(points) < len(DEFINING):
            raise FrameError(
                f"a table frame needs three touches (origin, on x, in the plane), not {len(points)}"
            )
        names = [point.name for point in points]
        if len(set(names)) < len(names):
            raise FrameError(f"two touches have the same name: {', '.join(names)}")
        return cls(
            made,
            serial_number,
            tuple(points),
            world_from_arm([point.arm_mm for point in points[:3]]),
        )

    @property
    def residuals_mm(self) -> dict[str, float]:
        """By check point: the distance from where it should be, or from the plane where only that
        is known.
        """
        return {point.name: self._off_mm(point) for point in self.points[3:]}

    @property
    def residual_mm(self) -> float | None:
        """The largest residual; None without a check point."""
        return max(self.residuals_mm.values(), default=None)

    @property
    def hangs(self) -> bool:
        """Whether the arm's own z axis points down in this frame: it hangs, or the third touch was
        on the wrong side.
        """
        return bool(self.world_from_arm.R[2, 2] < 0.0)

    def u_registration_mm(self, world_mm: ArrayLike, u_mm: float) -> float:
        """Standard uncertainty along an axis (root mean square of the three) that the frame adds at
        ``world_mm`` (3,).

        Each coordinate of the three touches has ``u_mm``, uncorrelated; propagated by the law of
        JCGM 100:2008, 5.1.2, with derivatives taken numerically.
        """
        touched = np.array([point.arm_mm for point in self.points[:3]])
        seen = self.world_from_arm.inverse().apply(world_mm)
        moved = [_slope(touched, seen, row, column) for row in range(3) for column in range(3)]
        return u_mm * sqrt(float(np.sum(np.square(moved))) / 3.0)

    def _off_mm(self, point: TouchedPoint) -> float:
        found = self.world_from_arm.apply(point.arm_mm)
        return (
            abs(float(found[2]))
            if point.world_mm is None
            else float(np.linalg.norm(found - np.array(point.world_mm)))
        )


def world_from_arm(touched_mm: ArrayLike) -> Motion:
    """The motion for touches (3, 3) mm, rows origin, on x, in the plane. Raises FrameError where
    they are near or in a line.
    """
    touched = np.asarray(touched_mm, dtype=np.float64)
    if touched.shape != (3, 3) or not np.isfinite(touched).all():
        raise FrameError(
            f"a table frame is made of three points in space, not of {touched.tolist()}"
        )
    origin, on_x, in_plane = touched
    _apart(float(np.linalg.norm(on_x - origin)), "the touch on the x axis is {} from the origin")
    x = (on_x - origin) / np.linalg.norm(on_x - origin)
    across = (in_plane - origin) - ((in_plane - origin) @ x) * x
    _apart(
        float(np.linalg.norm(across)),
        "the third touch is {} from the x axis, so the three are nearly in a line",
    )
    y = across / np.linalg.norm(across)
    R = np.stack([x, y, np.cross(x, y)])
    return Motion(R, -R @ origin)


def _apart(distance_mm: float, sentence: str) -> None:
    if distance_mm < APART_MM:
        raise FrameError(
            f"{sentence.format(f'{distance_mm:.1f} mm')}; {APART_MM:g} mm are needed. Touch a point"
            " further away"
        )


def _slope(touched: Floats, seen: Floats, row: int, column: int) -> Floats:
    """How the world point (3,) of ``seen`` moves when one coordinate of one touch moves, mm/mm."""
    ends = []
    for step in (_STEP_MM, -_STEP_MM):
        other = touched.copy()
        other[row, column] += step
        ends.append(world_from_arm(other).apply(seen))
    return np.asarray((ends[0] - ends[1]) / (2.0 * _STEP_MM))
