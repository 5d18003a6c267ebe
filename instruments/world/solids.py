"""The solid of which the whole scene is made: the convex hull of two round ends; rays and
distances.

A ball or disc at each end of an axis gives spheres, capsules, cylinders, cups and teats, with one
intersection and one outline for all. Rays pass from the camera through (x, y, 1), so their
parameter is the depth; a near miss gets the limb's depth and normal, for half-covered pixels.
Vectors are rows, (3, n), for speed. Distances are exact for balls and capsules, else a little
small.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instruments import world as package
from instruments.world.optics import CameraModel, Floats

Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Hull:
    """Convex hull of two round ends: balls, or discs across the axis where ``flat_…``; a disc and a
    ball need equal radii. Raises ValueError for a radius not above zero, or an end inside the
    other.
    """

    a_mm: Point
    b_mm: Point
    radius_a_mm: float
    radius_b_mm: float
    flat_a: bool = False
    flat_b: bool = False

    def __post_init__(self) -> None:
        length = math.dist(self.a_mm, self.b_mm)
        numbers = (*self.a_mm, *self.b_mm, self.radius_a_mm, self.radius_b_mm)
        flat, steep = self.flat_a or self.flat_b, abs(self.radius_a_mm - self.radius_b_mm)
        fault = ""
        if not all(map(math.isfinite, numbers)) or min(self.radius_a_mm, self.radius_b_mm) <= 0.0:
            fault = "a solid needs finite ends and radii above zero, has"
        elif self.flat_a != self.flat_b and steep:
            fault = "a solid with one flat and one round end needs equal radii, has"
        elif flat and length == 0.0:
            fault = "a solid with a flat end needs a length above zero, has"
        elif not flat and 0.0 < length <= steep:
            fault = (
                "one round end of a solid swallows the other: move them apart or make it a sphere,"
            )
        if fault:
            raise ValueError(f"{fault} {self}")


def as_point(vector: Floats) -> Point:
    """A vector (3,) as plain numbers."""
    x, y, z = vector.tolist()
    return x, y, z


def ball(centre_mm: Point, radius_mm: float) -> Hull:
    """A sphere."""
    return Hull(centre_mm, centre_mm, radius_mm, radius_mm)


def cylinder(a_mm: Point, b_mm: Point, radius_mm: float, radius_b_mm: float | None = None) -> Hull:
    """A flat-ended cylinder, or a cone's frustum where the second radius differs."""
    end = radius_mm if radius_b_mm is None else radius_b_mm
    return Hull(a_mm, b_mm, radius_mm, end, flat_a=True, flat_b=True)


def chain(points_mm: Sequence[Point], radii_mm: Sequence[float]) -> tuple[Hull, ...]:
    """Balls at these points, each joined to the next: something round that bends and tapers."""
    ends = zip(pairwise(points_mm), pairwise(radii_mm), strict=True)
    return tuple(Hull(a, b, r, s) for (a, b), (r, s) in ends)


@dataclass(frozen=True, slots=True, eq=False)
class Solids:
    """k solids as columns in one frame, mm: ``a``, ``b``, ``axis`` (k, 3), the others (k,). The
    body is a cone round the axis from height ``low`` to ``high``, its radius ``radius_0 + slope
    h``.
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
        a, b = (
            np.array([getattr(hull, end) for hull in hulls], dtype=np.float64).reshape(-1, 3)
            for end in ("a_mm", "b_mm")
        )
        radius_a = np.array([hull.radius_a_mm for hull in hulls], dtype=np.float64)
        radius_b = np.array([hull.radius_b_mm for hull in hulls], dtype=np.float64)
        flat_a = np.array([hull.flat_a for hull in hulls], dtype=np.bool_)
        flat_b = np.array([hull.flat_b for hull in hulls], dtype=np.bool_)
        length = np.linalg.norm(b - a, axis=1)
        safe = np.where(length > 0.0, length, 1.0)
        axis = np.where(length[:, None] > 0.0, (b - a) / safe[:, None], np.array([0.0, 0.0, 1.0]))
        # A cone that touches two balls does so on circles set back from their middles by r
        # sin(beta).
        sine = np.where(flat_a | flat_b, 0.0, (radius_a - radius_b) / safe)
        cosine = np.sqrt(1.0 - sine**2)
        low = np.where(flat_a, 0.0, radius_a * sine)
        high = length + np.where(flat_b, 0.0, radius_b * sine)
        body = np.where(high > low, high - low, 1.0)
        slope = (radius_b - radius_a) * cosine / body
        radius_0 = radius_a * cosine - slope * low
        return cls(a, b, axis, radius_a, radius_b, flat_a, flat_b, low, high, radius_0, slope)

    def __len__(self) -> int:
        return len(self.radius_a)

    def in_camera(self, camera: CameraModel) -> Solids:
        """The same solids in the camera's frame."""
        a, b = camera.camera_from_world(self.a), camera.camera_from_world(self.b)
        return replace(self, a=a, b=b, axis=self.axis @ camera.R.T)

    def nearest_depth(self) -> Floats:
        """The least z of each solid, (k,): depth from a camera, or height over the table."""
        across = np.sqrt(np.clip(1.0 - self.axis[:, 2] ** 2, 0.0, 1.0))
        low_a = self.a[:, 2] - self.radius_a * np.where(self.flat_a, across, 1.0)
        low_b = self.b[:, 2] - self.radius_b * np.where(self.flat_b, across, 1.0)
        return np.asarray(np.minimum(low_a, low_b))

    def near_lines(self, ends: Floats) -> Bools:
        """Whether each of k solids may meet the line from the origin to each of n ends, (k, n)."""
        middle, half_mm = 0.5 * (self.a + self.b), 0.5 * np.linalg.norm(self.b - self.a, axis=1)
        radius_mm = half_mm + np.maximum(self.radius_a, self.radius_b) + 1.0
        along, length = middle @ ends.T, np.sum(ends * ends, axis=1)
        part = np.clip(along / length, 0.0, 1.0)
        away = np.sum(middle * middle, axis=1)[:, None] - part * (2.0 * along - part * length)
        return np.asarray(away <= radius_mm[:, None] ** 2)


def dot(u: NDArray[Any], v: NDArray[Any]) -> NDArray[Any]:
    """Scalar products of columns: (3, n) with (3, n), (3, 1) or (3,); float32 or float64."""
    return np.asarray(u[0] * v[0] + u[1] * v[1] + u[2] * v[2])


def square_to(axes: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors across each of these, (k, 3): a cross product written out, for speed."""
    x, y, z = axes.T
    steep = np.abs(x) < 0.7
    nothing = np.zeros_like(x)
    u = np.where(steep, [nothing, z, -y], [-z, nothing, x])
    u /= np.sqrt(dot(u, u))
    v = np.stack([y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0]])
    return u.T, v.T


def intersect(solids: Solids, which: Ints, x: Floats, y: Floats) -> tuple[Floats, Floats, Bools]:
    """Ray (x, y, 1) with solid ``which``, each (n,): depth (n,) mm, outward normal (3, n), truly
    hit (n,). ``solids`` are in the frame of the camera, which is outside of them.
    """
    # The body's endless cone: |p|^2 - h^2 = (r0 + k h)^2, camera at the origin; the height and qb
    # are linear in the ray: their coefficients, and qc, are one for each solid.
    a, axis, r0, k = solids.a.T, solids.axis.T, solids.radius_0, solids.slope
    h0 = -dot(a, axis)
    bend = 1.0 + k * k
    to_b = -a - (bend * h0 + k * r0) * axis
    qc = dot(a, a) - bend * h0 * h0 - 2.0 * k * r0 * h0 - r0 * r0
    ends = *-solids.b.T, solids.radius_a, solids.radius_b, solids.flat_a, solids.flat_b
    columns = np.stack([*axis, *to_b, bend, h0, qc, k, r0, solids.low, solids.high, *-a, *ends])
    depth, hit, normal = np.empty(len(x)), np.empty(len(x), dtype=np.bool_), np.empty((3, len(x)))
    package.kernels.meet(columns.T.copy(), which, x, y, depth, normal, hit)
    return depth, normal, hit


def clearance_mm(one: Hull, other: Hull) -> float:
    """Least distance of two surfaces, mm; negative: overlap. Of two tapered, one is its widest."""
    (a, b), (c, d) = ((np.array(hull.a_mm), np.array(hull.b_mm)) for hull in (one, other))
    wide, other_wide = (max(hull.radius_a_mm, hull.radius_b_mm) for hull in (one, other))
    coarse = segments_apart_mm(a, b, c, d) - wide - other_wide
    if coarse >= 0.0:
        return coarse
    if one.radius_a_mm != one.radius_b_mm:
        return _tapered_mm(one, c, d) - other_wide
    return coarse if other.radius_a_mm == other.radius_b_mm else _tapered_mm(other, a, b) - wide


def _tapered_mm(cone: Hull, start: Floats, end: Floats) -> float:
    """Least distance of a tapered solid and a segment: convex along its axis, ternary search."""
    a, b = np.array(cone.a_mm), np.array(cone.b_mm)

    def gap_mm(part: float) -> float:
        radius = part * (cone.radius_b_mm - cone.radius_a_mm)
        return _point_apart_mm(a + part * (b - a), start, end) - cone.radius_a_mm - radius

    low, high = 0.0, 1.0
    while high - low > 1e-6:
        third = (high - low) / 3.0
        if gap_mm(low + third) < gap_mm(high - third):
            high -= third
        else:
            low += third
    return gap_mm((low + high) / 2.0)


def segments_apart_mm(a: Floats, b: Floats, c: Floats, d: Floats) -> float:
    """Least distance of segments a b and c d: of nearest points within both, else of four ends."""
    u, v, w = b - a, d - c, a - c
    uu, uv, vv, uw, vw = (float(np.dot(*pair)) for pair in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    det = uu * vv - uv * uv
    if det > 1e-12 * uu * vv > 0.0:
        s, t = (uv * vw - vv * uw) / det, (uu * vw - uv * uw) / det
        if 0.0 <= s <= 1.0 and 0.0 <= t <= 1.0:
            return float(np.linalg.norm(w + s * u - t * v))
    ends = ((a, c, d), (b, c, d), (c, a, b), (d, a, b))
    return min(_point_apart_mm(point, start, end) for point, start, end in ends)


def _point_apart_mm(point: Floats, start: Floats, end: Floats) -> float:
    along = end - start
    length2 = float(np.dot(along, along))
    part = np.clip(np.dot(point - start, along) / length2, 0.0, 1.0) if length2 else 0.0
    return float(np.linalg.norm(point - start - part * along))
