"""A calibration as one complete, frozen value, and the uncertainty of points that it triangulates:
first order (JCGM 100:2008, 5.1.2; 102:2011), by central differences.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike

from detector.calibration.bundle import LENS, POSE
from detector.calibration.gate import pair_faults
from detector.geometry import Array, Camera, Motion, triangulate

Polarity = Literal["hot_is_black", "hot_is_white"]
POLARITIES: tuple[str, ...] = get_args(Polarity)
# of a parameter's standard deviation: far above rounding, far below where the geometry bends
STEP = 0.1
PIXEL_STEP_PX = 0.01
LENSES = ("left", "right", "thermal")
# right_from_left, thermal_from_left, world_from_right
MOTIONS = ("stereo", "thermal pose", "world")


@dataclass(frozen=True, slots=True, eq=False)
class ParameterCovariance:
    """``matrix`` (k, k) of ``names``: (`LENSES`, `bundle.LENS`) or (`MOTIONS`, `bundle.POSE`); px,
    rad, mm. Others were fixed. Raises ValueError for no covariance.
    """

    names: tuple[tuple[str, str], ...]
    matrix: Array

    def __post_init__(self) -> None:
        matrix, k = np.array(self.matrix, dtype=np.float64), len(self.names)
        known = {(owner, name) for owner in LENSES for name in LENS}
        known |= {(owner, name) for owner in MOTIONS for name in POSE}
        if strange := [" ".join(name) for name in self.names if name not in known]:
            raise ValueError(f"no such parameter: {', '.join(strange)}")
        if len(set(self.names)) < k:
            raise ValueError("a parameter is named twice")
        if matrix.shape != (k, k) or not np.isfinite(matrix).all():
            wanted = f"{k} x {k} finite numbers, a row and a column for each name"
            raise ValueError(f"the covariance must be {wanted}; it has the shape {matrix.shape}")
        scale = np.sqrt(np.clip(np.diag(matrix), np.finfo(float).tiny, None))
        scaled = matrix / np.outer(scale, scale)
        sound = np.allclose(scaled, scaled.T, atol=1e-6) and (np.diag(matrix) >= 0).all()
        if not sound or np.linalg.eigvalsh(scaled).min(initial=0.0) < -1e-6:
            wanted = "symmetric, without a negative variance in any direction"
            raise ValueError(f"not a covariance: it must be {wanted}")
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    def sd(self, owner: str, name: str) -> float | None:
        """Standard deviation of one parameter; None where it was held fixed."""
        return self.sds.get((owner, name))

    @property
    def sds(self) -> Mapping[tuple[str, str], float]:
        return dict(zip(self.names, np.sqrt(np.diag(self.matrix)).tolist(), strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """What triangulation needs: both lenses, right_from_left, world_from_right."""

    left: Camera
    right: Camera
    right_from_left: Motion
    world_from_right: Motion

    def project(self, world_mm: ArrayLike) -> tuple[Array, Array]:
        """Left and right pixels (n, 2) of world points (n, 3); NaN behind a camera."""
        in_right = self.world_from_right.inverse().apply(world_mm)
        in_left = self.right_from_left.inverse().apply(in_right)
        return self.left.project(in_left), self.right.project(in_right)

    def in_right_mm(self, left_px: ArrayLike, right_px: ArrayLike) -> Array:
        """Points (n, 3) of pixel pairs, right camera's frame."""
        return triangulate(left_px, right_px, self.left, self.right, self.right_from_left)[0]

    def place(self, left_px: ArrayLike, right_px: ArrayLike) -> Array:
        """World points (n, 3) of pixel pairs."""
        return self.world_from_right.apply(self.in_right_mm(left_px, right_px))

    def moved(self, owner: str, name: str, step: float) -> Self:
        """The pair with one parameter changed; the thermal camera's move nothing."""
        at = {"stereo": "right_from_left", "world": "world_from_right"}.get(owner, owner)
        part, moved = getattr(self, at, None), dict[str, Camera | Motion]()
        if isinstance(part, Camera):
            moved = {at: part.with_lens(part.lens + step * np.equal(LENS, name))}
        if isinstance(part, Motion):
            moved = {at: part.shifted(step * np.equal(POSE, name))}
        return replace(self, **moved)  # type: ignore[arg-type]


def covariance_of_points(
    pair: Pair, covariance: ParameterCovariance | None, world_mm: ArrayLike, pixel_sd_px: float
) -> Array:
    """(n, 3, 3) mm^2 of world points (n, 3), NaN unseen; ``pixel_sd_px`` of each coordinate."""
    points = np.atleast_2d(np.asarray(world_mm, dtype=np.float64))
    left_px, right_px = pair.project(points)
    total = np.zeros((len(points), 3, 3))
    total[~np.isfinite(left_px + right_px).all(axis=1)] = np.nan
    for move in PIXEL_STEP_PX * np.eye(4) if pixel_sd_px else ():
        near, far = (pair.place(left_px + s * move[:2], right_px + s * move[2:]) for s in (-1, 1))
        slope = (far - near) / (2.0 * PIXEL_STEP_PX)
        total += slope[:, :, None] * slope[:, None, :]
    total *= pixel_sd_px**2
    if covariance is None or not covariance.names:
        return total
    columns = [np.zeros_like(points) for _ in covariance.names]
    for column, ((owner, name), sd) in zip(columns, covariance.sds.items(), strict=True):
        if h := STEP * sd:
            near, far = (pair.moved(owner, name, s).place(left_px, right_px) for s in (-h, h))
            column += (far - near) / (2.0 * h)
    jacobian = np.stack(columns, axis=2)
    return np.asarray(total + jacobian @ covariance.matrix @ jacobian.transpose(0, 2, 1))


@dataclass(frozen=True, slots=True)
class ThermalCamera:
    """The thermal picture's form; ``lens`` is for the un-mirrored picture at image_size."""

    image_size: tuple[int, int]
    sensor_size: tuple[int, int]
    mirrored: bool
    polarity: Polarity
    lens: Camera | None


@dataclass(frozen=True, slots=True, eq=False)
class Homographies:
    """Un-mirrored thermal to left and right pixels, (3, 3) each, on the plane at Z =
    ``plane_depth_mm`` (right camera's frame; None if unknown).
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
    """Who, when (ISO date), with what, cameras (identity by name), files (SHA-256 by name)."""

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
    depth: Camera | None = None
    depth_from_left: Motion | None = None
    world_from_right: Motion | None = None
    covariance: ParameterCovariance | None = None
    record: Record | None = None
    hanging: bool = False

    @property
    def pair_faults(self) -> tuple[str, ...]:
        """Why no pair of cameras stands so, such as a distance in metres; () where one may."""
        return tuple(pair_faults(self.right_from_left)) if self.right_from_left else ()


@dataclass(frozen=True, slots=True, eq=False)
class Calibration(Pair):
    """A calibrated rig, mm. ``thermal.lens`` and ``thermal_from_left`` are both given or both None,
    and so are ``depth``, the depth camera's lens, and ``depth_from_left``;
    ``covariance`` is of all fitted parameters. ``hanging``: teats point along the world's -z, as a
    cow's; else along +z, as on the phantom.
    """

    thermal: ThermalCamera
    thermal_from_left: Motion | None
    homographies: Homographies
    covariance: ParameterCovariance | None = None
    record: Record | None = None
    depth: Camera | None = None
    depth_from_left: Motion | None = None
    hanging: bool = False

    @property
    def thermal_from_right(self) -> Motion | None:
        """Right camera -> thermal camera, None where the thermal camera has no pose."""
        pose = self.thermal_from_left
        return None if pose is None else pose @ self.right_from_left.inverse()

    @property
    def depth_from_world(self) -> Motion | None:
        """World -> depth camera, None where there is none."""
        pose = self.depth_from_left
        return pose and pose @ (self.world_from_right @ self.right_from_left).inverse()

    @property
    def baseline_mm(self) -> float:
        """Distance between the optical centres of the stereo pair."""
        return float(np.linalg.norm(self.right_from_left.T))

    def covariance_of(self, world_mm: ArrayLike, pixel_sd_px: float = 0.0) -> Array:
        """(n, 3, 3) mm^2 of points (n, 3); NaN unseen; zero without covariance or noise."""
        return covariance_of_points(self, self.covariance, world_mm, pixel_sd_px)

    @property
    def part(self) -> Part:
        """The same as a part that lacks nothing."""
        return Part(**{field.name: getattr(self, field.name) for field in fields(Part)})

    def depth_per_disparity_px_mm(self, world_mm: ArrayLike) -> Array:
        """Depth (n,) mm of world points (n, 3) that 1 px of disparity is: Z^2 / (f B)."""
        depth = self.world_from_right.inverse().apply(np.atleast_2d(world_mm))[:, 2]
        focal_px = 0.5 * (self.left.fc[0] + self.right.fc[0])
        return np.asarray(depth**2 / (focal_px * self.baseline_mm))
