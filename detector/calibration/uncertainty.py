"""Uncertainty of triangulated points from the calibration's covariance and the pixels' noise. First
order (JCGM 100:2008, 5.1.2; 102:2011), with central differences of the detectors' triangulation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from detector.calibration.bundle import LENS, POSE
from detector.geometry import Array, Camera, Motion, triangulate

# of a parameter's standard deviation: far above rounding, far below where the geometry bends
STEP = 0.1
PIXEL_STEP_PX = 0.01
LENSES = ("left", "right", "thermal")
# right_from_left, thermal_from_left, world_from_right
MOTIONS = ("stereo", "thermal pose", "world")


@dataclass(frozen=True, slots=True, eq=False)
class ParameterCovariance:
    """``matrix`` (k, k) of ``names``: (of `LENSES`, of `bundle.LENS`) or (of `MOTIONS`, of
    `bundle.POSE`); px, rad, mm. Other parameters were fixed. Raises ValueError where it is no
    covariance.
    """

    names: tuple[tuple[str, str], ...]
    matrix: Array

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, dtype=np.float64)
        known = {
            *((lens, name) for lens in LENSES for name in LENS),
            *((motion, name) for motion in MOTIONS for name in POSE),
        }
        if strange := [
            f"{owner} {name}" for owner, name in self.names if (owner, name) not in known
        ]:
            raise ValueError(f"no such parameter: {', '.join(strange)}")
        if len(set(self.names)) < len(self.names):
            raise ValueError("a parameter is named twice")
        if matrix.shape != (len(self.names), len(self.names)) or not np.isfinite(matrix).all():
            wanted = (
                f"{len(self.names)} x {len(self.names)} finite numbers, a row and a column for each"
                " name"
            )
            raise ValueError(f"the covariance must be {wanted}; it has the shape {matrix.shape}")
        scale = np.sqrt(np.clip(np.diag(matrix), np.finfo(float).tiny, None))
        scaled = matrix / np.outer(scale, scale)
        if (
            not np.allclose(scaled, scaled.T, atol=1e-6)
            or (np.diag(matrix) < 0).any()
            or np.linalg.eigvalsh(scaled).min(initial=0.0) < -1e-6
        ):
            raise ValueError(
                "not a covariance: it must be symmetric, without a negative variance in any"
                " direction"
            )
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    def sd(self, owner: str, name: str) -> float | None:
        """Standard deviation of one parameter; None where it was held fixed."""
        if (owner, name) not in self.names:
            return None
        at = self.names.index((owner, name))
        return float(np.sqrt(self.matrix[at, at]))

    @property
    def sds(self) -> Mapping[tuple[str, str], float]:
        """Standard deviations by parameter."""
        return dict(zip(self.names, np.sqrt(np.diag(self.matrix)).tolist(), strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """What triangulation needs: both lenses, right_from_left, world_from_right."""

    left: Camera
    right: Camera
    right_from_left: Motion
    world_from_right: Motion

    def see(self, world_mm: Array) -> tuple[Array, Array]:
        """Left and right pixels (n, 2) of world points (n, 3)."""
        in_right = self.world_from_right.inverse().apply(world_mm)
        return self.left.project(
            self.right_from_left.inverse().apply(in_right)
        ), self.right.project(in_right)

    def place(self, left_px: Array, right_px: Array) -> Array:
        """World points (n, 3) of pixel pairs."""
        return self.world_from_right.apply(
            triangulate(left_px, right_px, self.left, self.right, self.right_from_left)[0]
        )

    def moved(self, owner: str, name: str, step: float) -> Pair:
        """The pair with one parameter changed; the thermal camera's move nothing."""
        if owner == "left":
            return replace(self, left=_with(self.left, name, step))
        if owner == "right":
            return replace(self, right=_with(self.right, name, step))
        if owner == "stereo":
            return replace(self, right_from_left=_turned(self.right_from_left, name, step))
        return (
            replace(self, world_from_right=_turned(self.world_from_right, name, step))
            if owner == "world"
            else self
        )


def covariance_of_points(
    pair: Pair, covariance: ParameterCovariance | None, world_mm: ArrayLike, pixel_sd_px: float
) -> Array:
    """(n, 3, 3) mm^2 of triangulated world points (n, 3); NaN for one that a camera can't see.
    ``pixel_sd_px``: of each pixel coordinate; alone where there is no covariance.
    """
    points = np.atleast_2d(np.asarray(world_mm, dtype=np.float64))
    left_px, right_px = pair.see(points)
    total = _from_pixels(pair, left_px, right_px) * pixel_sd_px**2
    if covariance is None or not covariance.names:
        return total
    columns = []
    for (owner, name), sd in covariance.sds.items():

        def place(h: float, owner: str = owner, name: str = name) -> Array:
            return pair.moved(owner, name, h).place(left_px, right_px)

        columns.append(_slope(place, STEP * sd) if sd else np.zeros_like(points))
    jacobian = np.stack(columns, axis=2)
    return np.asarray(total + jacobian @ covariance.matrix @ jacobian.transpose(0, 2, 1))


def _from_pixels(pair: Pair, left_px: Array, right_px: Array) -> Array:
    total = np.zeros((len(left_px), 3, 3))
    for side in range(2):
        for axis in np.eye(2):

            def place(h: float, side: int = side, axis: Array = axis) -> Array:
                return pair.place(
                    left_px + h * axis * (side == 0), right_px + h * axis * (side == 1)
                )

            slope = _slope(place, PIXEL_STEP_PX)
            total += slope[:, :, None] * slope[:, None, :]
    return total


def _slope(place: Callable[[float], Array], step: float) -> Array:
    return (place(step) - place(-step)) / (2.0 * step)


def _with(camera: Camera, name: str, step: float) -> Camera:
    values = [*camera.fc, *camera.cc, *camera.kc]
    values[LENS.index(name)] += step
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = values
    return replace(camera, fc=(fx, fy), cc=(cx, cy), kc=(k1, k2, p1, p2, k3))


def _turned(motion: Motion, name: str, step: float) -> Motion:
    change = np.zeros(6)
    change[POSE.index(name)] = step
    return Motion.from_vectors(motion.om + change[:3], motion.T + change[3:])
