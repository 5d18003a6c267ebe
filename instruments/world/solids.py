"""The one solid of which everything in the scene is made: the convex hull of two round ends.

A ball or a disc at each end of an axis gives spheres, capsules, tapered capsules (arms), cylinders, cups, and teats
(disc below, ball above). One kind of solid means one intersection and one outline, which then run over all
the scene's solids at once. `Solids` is the same data as columns, in a frame of reference.
May not know what a solid stands for, nor its colour or temperature, nor how it is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instruments.world.optics import CameraModel, Floats

Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Hull:
    """Convex hull of two round ends, world frame, mm. An end is a ball, or a disc across the axis where ``flat_…``.

    A disc and a ball together must have equal radii. Two balls at one place are a sphere. Raises ValueError
    for a radius that isn't above zero, and where one end would swallow the other.
    """

    a_mm: Point
    b_mm: Point
    radius_a_mm: float
    radius_b_mm: float
    flat_a: bool = False
    flat_b: bool = False

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(np.subtract(self.b_mm, self.a_mm)))
        numbers = (*self.a_mm, *self.b_mm, self.radius_a_mm, self.radius_b_mm)
        if not np.all(np.isfinite(numbers)) or min(self.radius_a_mm, self.radius_b_mm) <= 0.0:
            raise ValueError(f"a solid needs finite ends and radii above zero, has {self}")
        if self.flat_a != self.flat_b and self.radius_a_mm != self.radius_b_mm:
            raise ValueError(f"a solid with one flat and one round end needs equal radii, has {self}")
        if (self.flat_a or self.flat_b) and length == 0.0:
            raise ValueError(f"a solid with a flat end needs a length above zero, has {self}")
        if not (self.flat_a or self.flat_b) and length > 0.0 and abs(self.radius_a_mm - self.radius_b_mm) >= length:
            raise ValueError(f"one round end of a solid swallows the other: move them apart or make it a sphere, {self}")


def ball(centre_mm: Point, radius_mm: float) -> Hull:
    """A sphere."""
    return Hull(centre_mm, centre_mm, radius_mm, radius_mm)


def cylinder(a_mm: Point, b_mm: Point, radius_mm: float, radius_b_mm: float | None = None) -> Hull:
    """A flat-ended cylinder, or a cone's frustum where the second radius differs."""
    return Hull(a_mm, b_mm, radius_mm, radius_mm if radius_b_mm is None else radius_b_mm, flat_a=True, flat_b=True)


@dataclass(frozen=True, slots=True, eq=False)
class Solids:
    """Solids as columns: k of them, in one frame of reference; lengths in mm.

    ``a``, ``b``, ``axis`` (k, 3); ``radius_a``, ``radius_b``; ``flat_a``, ``flat_b`` (k,). The body between the ends
    is a cone around the axis: it runs from height ``low`` to ``high`` (measured from a), its radius at height h is
    ``radius_0 + slope h``.
    """

    a: Floats
    b: Floats
    axis: Floats
    radius_a: Floats
    radius_b: Floats
    flat_a: Bools
    flat_b: Bools
    low: Floats
    high: Floats
    radius_0: Floats
    slope: Floats

    @classmethod
    def from_hulls(cls, hulls: Sequence[Hull]) -> Solids:
        """Columns, in the world frame, in the order given; an empty sequence gives k = 0."""
        a = np.array([hull.a_mm for hull in hulls], dtype=np.float64).reshape(-1, 3)
        b = np.array([hull.b_mm for hull in hulls], dtype=np.float64).reshape(-1, 3)
        radius_a = np.array([hull.radius_a_mm for hull in hulls], dtype=np.float64)
        radius_b = np.array([hull.radius_b_mm for hull in hulls], dtype=np.float64)
        flat_a = np.array([hull.flat_a for hull in hulls], dtype=np.bool_)
        flat_b = np.array([hull.flat_b for hull in hulls], dtype=np.bool_)
        length = np.linalg.norm(b - a, axis=1)
        safe = np.where(length > 0.0, length, 1.0)
        axis = np.where(length[:, None] > 0.0, (b - a) / safe[:, None], np.array([0.0, 0.0, 1.0]))
        # A cone that touches two balls does so on circles set back from their middles by r sin(beta).
        sine = np.where(flat_a | flat_b, 0.0, (radius_a - radius_b) / safe)
        cosine = np.sqrt(1.0 - sine**2)
        low = np.where(flat_a, 0.0, radius_a * sine)
        high = length + np.where(flat_b, 0.0, radius_b * sine)
        body = np.where(high > low, high - low, 1.0)
        slope = (radius_b - radius_a) * cosine / body
        return cls(a, b, axis, radius_a, radius_b, flat_a, flat_b, low, high, radius_a * cosine - slope * low, slope)

    def __len__(self) -> int:
        return len(self.radius_a)

    def in_camera(self, camera: CameraModel) -> Solids:
        """The same solids in the camera's frame."""
        a, b = camera.camera_from_world(self.a), camera.camera_from_world(self.b)
        return Solids(
            a, b, self.axis @ camera.R.T, self.radius_a, self.radius_b, self.flat_a, self.flat_b,
            self.low, self.high, self.radius_0, self.slope,
        )  # fmt: skip

    def nearest_depth(self) -> Floats:
        """The least z of each solid, (k,): in a camera's frame, its depth; in the world, its height over the table."""
        across = np.sqrt(np.clip(1.0 - self.axis[:, 2] ** 2, 0.0, 1.0))
        low_a = self.a[:, 2] - self.radius_a * np.where(self.flat_a, across, 1.0)
        low_b = self.b[:, 2] - self.radius_b * np.where(self.flat_b, across, 1.0)
        return np.asarray(np.minimum(low_a, low_b))
