"""What a calibration is: cameras, the motions between them and the world, and the homographies from
thermal to optical.

Strategy: one frozen value, complete by the time it exists; whatever a file may leave out has been
derived. The module may not know the file format, nor any detector.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from detector.calibration.uncertainty import Pair, ParameterCovariance, covariance_of_points
from detector.geometry import Array, Camera, Motion

Polarity = Literal["hot_is_black", "hot_is_white"]
POLARITIES: tuple[str, ...] = get_args(Polarity)


@dataclass(frozen=True, slots=True)
class ThermalCamera:
    """The thermal camera: how its picture is delivered, and its lens where that is calibrated.

    image_size (columns, rows) px of the delivered picture, sensor_size of the sensor; `lens` is for
    the un-mirrored picture at image_size.
    """

    image_size: tuple[int, int]
    sensor_size: tuple[int, int]
    mirrored: bool
    polarity: Polarity
    lens: Camera | None


@dataclass(frozen=True, slots=True, eq=False)
class Homographies:
    """Un-mirrored thermal pixel -> left and right pixel, (3, 3) each, right on one plane only.

    plane_depth_mm: where that plane, parallel to the right camera's image plane, lies in the right
    camera's frame; None where nobody knows.
    """

    left: Array
    right: Array
    plane_depth_mm: float | None

    def __post_init__(self) -> None:
        """Kept from being written to, as motions are: one calibration serves all detectors."""
        for name in ("left", "right"):
            matrix = np.array(getattr(self, name), dtype=np.float64)
            matrix.setflags(write=False)
            object.__setattr__(self, name, matrix)


@dataclass(frozen=True, slots=True)
class Record:
    """Who calibrated, when (an ISO date), with what, on which cameras (identity by name), from
    which files (SHA-256 by name).
    """

    made: str
    by: str
    with_what: str
    cameras: Mapping[str, str]
    inputs: Mapping[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """What one step of a calibration found: any of the parts of a
    `Calibration`, the others None.
    """

    left: Camera | None = None
    right: Camera | None = None
    right_from_left: Motion | None = None
    thermal: ThermalCamera | None = None
    thermal_from_left: Motion | None = None
    homographies: Homographies | None = None
    world_from_right: Motion | None = None
    covariance: ParameterCovariance | None = None
    record: Record | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A calibrated rig. Lengths mm; motions take points from the frame named last to the one named
    first.

    `thermal.lens` and `thermal_from_left` are both there or both None: a rig may have nothing but
    homographies. `covariance` is that of all fitted parameters; None where the file doesn't say.
    """

    left: Camera
    right: Camera
    thermal: ThermalCamera
    right_from_left: Motion
    thermal_from_left: Motion | None
    world_from_right: Motion
    homographies: Homographies
    covariance: ParameterCovariance | None = None
    record: Record | None = None

    @property
    def thermal_from_right(self) -> Motion | None:
        """Right camera -> thermal camera, None where the thermal camera has no pose."""
        return (
            None
            if self.thermal_from_left is None
            else self.thermal_from_left @ self.right_from_left.inverse()
        )

    @property
    def world_from_left(self) -> Motion:
        """Left camera -> world."""
        return self.world_from_right @ self.right_from_left

    @property
    def baseline_mm(self) -> float:
        """Distance between the optical centres of the stereo pair."""
        return float(np.linalg.norm(self.right_from_left.T))

    @property
    def pair(self) -> Pair:
        """What triangulation needs of it."""
        return Pair(self.left, self.right, self.right_from_left, self.world_from_right)

    def covariance_of(self, world_mm: ArrayLike, pixel_sd_px: float = 0.0) -> Array:
        """Covariance (n, 3, 3) mm^2, world axes, of triangulated points (n, 3): the calibration's
        own, and the pixels' of `pixel_sd_px`.

        NaN for a point that a camera can't see. Zero where the file gives no covariance and no
        pixel noise is asked for.
        """
        return covariance_of_points(self.pair, self.covariance, world_mm, pixel_sd_px)

    @property
    def part(self) -> Part:
        """The same as a part that lacks nothing."""
        return Part(**{field.name: getattr(self, field.name) for field in fields(Part)})

    def project(self, world_mm: ArrayLike) -> tuple[Array, Array]:
        """Left and right pixels (n, 2) of world points (n, 3); NaN behind a camera."""
        in_right = self.world_from_right.inverse().apply(world_mm)
        return self.left.project(
            self.right_from_left.inverse().apply(in_right)
        ), self.right.project(in_right)

    def depth_per_disparity_px_mm(self, world_mm: ArrayLike) -> Array:
        """How far (n,) one pixel of disparity error moves world points (n, 3) along the viewing
        axis: Z^2 / (f B).

        f is the mean of both cameras' horizontal focal lengths. No stereo method on this rig does
        better a pixel.
        """
        depth = self.world_from_right.inverse().apply(
            np.atleast_2d(np.asarray(world_mm, dtype=np.float64))
        )[:, 2]
        return np.asarray(
            depth**2 / (0.5 * (self.left.fc[0] + self.right.fc[0]) * self.baseline_mm)
        )
