"""A calibration as one complete, frozen value: cameras, motions between them and the world,
homographies.
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
    """The thermal picture's form, and a lens where calibrated.

    image_size (columns, rows) px as delivered, sensor_size of the sensor; `lens` is for the
    un-mirrored picture at image_size.
    """

    image_size: tuple[int, int]
    sensor_size: tuple[int, int]
    mirrored: bool
    polarity: Polarity
    lens: Camera | None


@dataclass(frozen=True, slots=True, eq=False)
class Homographies:
    """Un-mirrored thermal to left and right pixels, (3, 3) each, on one plane.

    plane_depth_mm: its Z in the right camera's frame; None if unknown.
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
    """Who, when (ISO date), with what, which cameras (identity by name), which files (SHA-256 by
    name).
    """

    made: str
    by: str
    with_what: str
    cameras: Mapping[str, str]
    inputs: Mapping[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """What one step found: parts of a `Calibration`, the others None."""

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
    """A calibrated rig. Lengths mm; motions take points from the frame named last to the first.

    `thermal.lens` and `thermal_from_left` are both given or both None. `covariance` is of all
    fitted parameters; None where the file has none.
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
        """(n, 3, 3) mm^2, world axes, of triangulated points (n, 3): calibration and `pixel_sd_px`.
        NaN for a point that a camera can't see; zero without covariance and pixel noise.
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
        """Motion (n,) of world points (n, 3) along the viewing axis for 1 px of disparity: Z^2 / (f
        B), f the mean horizontal focal length. No stereo method here is better per pixel.
        """
        depth = self.world_from_right.inverse().apply(
            np.atleast_2d(np.asarray(world_mm, dtype=np.float64))
        )[:, 2]
        return np.asarray(
            depth**2 / (0.5 * (self.left.fc[0] + self.right.fc[0]) * self.baseline_mm)
        )
