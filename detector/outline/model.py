"""A round-ended teat as eight numbers, and its outline in any camera, in closed form.

A cylinder or slight cone ends in a tangent ball, or half an ellipsoid, treated as a ball after
stretching along the axis. A surface point is on the outline where its normal is at right angles to
the line of sight: a circle on the ball, two lines on the sides, as one list up one side and down
the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from detector import outline as package
from detector.geometry import Array, Camera, Motion

# the end's middle, the axis, its radius, the sides' slope, its height in radii
CX, _, CZ, LEAN_X, LEAN_Z, RADIUS, TAPER, HEIGHT = range(8)
COUNT = 8
# the parts of an outline; a camera that looks along +z with y down has side A on its left
SIDE_A, END, SIDE_B = range(3)


class Rows:
    """A dataclass of arrays, and of such dataclasses, with one row a thing in each."""

    __slots__: tuple[str, ...] = ()

    def take(self, which: NDArray[np.intp] | list[int]) -> Self:
        """Some of the things."""
        rows = np.asarray(which, dtype=np.intp)
        parts: list[Any] = [getattr(self, name) for name in self.__slots__]
        return type(self)(
            *(p.take(rows) if isinstance(p, Rows) else p.take(rows, 0) for p in parts)
        )

    def __add__(self, other: Self) -> Self:
        """All of both."""
        pairs: list[Any] = [(getattr(self, n), getattr(other, n)) for n in self.__slots__]
        return type(self)(
            *(a + b if isinstance(a, Rows) else np.concatenate([a, b]) for a, b in pairs)
        )


@dataclass(frozen=True)
class Outline:
    """Points' places: ``along_mm`` (k,) down each side, and shares (m,) in (0, 1) over the end."""

    along_mm: Array
    over_end: Array

    @classmethod
    def of(cls, length_mm: float, side_points: int, end_points: int) -> Outline:
        """``side_points`` each side to ``length_mm`` below the rim, ``end_points`` over the end."""
        along = (np.arange(side_points) + 0.5) * length_mm / side_points
        return cls(along, (np.arange(end_points) + 0.5) / end_points)

    @cached_property
    def part(self) -> Array:
        """Part (n,) of each point: SIDE_A from the foot up, END, SIDE_B downwards."""
        k, m = len(self.along_mm), len(self.over_end)
        return np.repeat([SIDE_A, END, SIDE_B], [k, m, k])


def axes(teats: Array) -> Array:
    """Unit vectors (m, 3) from end to base of teats (m, 8), towards +y."""
    down = np.empty((len(teats), 3))
    x, down[:, 1], z = teats[:, LEAN_X], 1.0, teats[:, LEAN_Z]
    down[:, 0], down[:, 2] = x, z
    return np.asarray(down / np.sqrt(x * x + 1.0 + z * z)[:, None])


def apexes(teats: Array) -> Array:
    """Teat ends (m, 3) mm: the rounded end's point on the axis, in the teats' frame."""
    return np.asarray(teats[:, :3] - (teats[:, RADIUS] * teats[:, HEIGHT])[:, None] * axes(teats))


def numbers_of(camera: Camera, camera_from_teats: Motion) -> Array:
    """A camera as the kernels take it, (22,): fx, fy, cx, cy, k1, k2, p1, p2, k3, skew; the
    motion's matrix and translation.
    """
    motion = camera_from_teats
    return np.concatenate([camera.lens, [camera.alpha_c], motion.R.ravel(), motion.T])


def outlines(
    teats: Array, cameras: Array, outline: Outline, *, slopes_too: bool = False
) -> tuple[Array, Array, Array]:
    """Outlines of teats (m, 8) in ``cameras`` (views, 22) (`numbers_of`), from side A over the end
    to side B: pixels and outward normals (m, views * n, 2), and how far they move outward
    (m, views * n, 8), px a unit of each number, zeros unless asked for. NaN with the camera inside.
    """
    k = len(cameras) * len(outline.part)
    pixels, normals = np.empty((2, len(teats), k, 2))
    jacobian = np.zeros((len(teats), k, COUNT))
    package.kernels.outlines(
        np.ascontiguousarray(teats), cameras, (outline.along_mm, outline.over_end),
        slopes_too, np.arange(len(teats)), (pixels, normals, jacobian),
    )  # fmt: skip
    return pixels, normals, jacobian
