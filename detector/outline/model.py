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
        parts: list[Any] = [getattr(self, name) for name in self.__slots__]
        return type(self)(*(p.take(which) if isinstance(p, Rows) else p[which] for p in parts))

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

    @cached_property
    def slices(self) -> tuple[slice, slice, slice]:
        """Where each part is."""
        k, m = len(self.along_mm), len(self.over_end)
        return slice(0, k), slice(k, k + m), slice(k + m, 2 * k + m)


def axes(teats: Array) -> Array:
    """Unit vectors (m, 3) from end to base of teats (m, 8), towards +y."""
    down = np.empty((len(teats), 3))
    x, down[:, 1], z = teats[:, LEAN_X], 1.0, teats[:, LEAN_Z]
    down[:, 0], down[:, 2] = x, z
    return np.asarray(down / np.sqrt(x * x + 1.0 + z * z)[:, None])


def apexes(teats: Array) -> Array:
    """Teat ends (m, 3) mm: the rounded end's point on the axis, in the teats' frame."""
    return np.asarray(teats[:, :3] - (teats[:, RADIUS] * teats[:, HEIGHT])[:, None] * axes(teats))


@dataclass(frozen=True, slots=True, eq=False)
class Contour:
    """Outlines of m teats, camera's frame: points (m, n, 3), normals, points from the middle."""

    points: Array
    normals: Array
    from_centre: Array


def contours(teats: Array, camera_from_teats: Motion, outline: Outline) -> Contour:
    """Outlines of teats (m, 8), side A over the end to side B; NaN with the camera inside."""
    return _contours(teats, [camera_from_teats], outline)


def _contours(teats: Array, motions: list[Motion], outline: Outline) -> Contour:
    """The same in one camera after the other, (views * m, n, 3)."""
    axis = axes(teats)
    centre = np.concatenate([motion.apply(teats[:, :3]) for motion in motions])
    axis = np.concatenate([axis @ motion.R.T for motion in motions])
    radius, taper, height = np.tile(teats[:, RADIUS:].T, len(motions))
    round_centre = centre + ((1 / height - 1) * _dot(centre, axis))[:, None] * axis
    points, normals = _surface(round_centre, axis, radius, taper, outline)

    def along(vectors: Array, factor: Array) -> Array:
        """Their components along the axes, times a factor (m,)."""
        share = np.einsum("mnd,md->mn", vectors, axis) * factor[:, None]
        return np.asarray(share[..., None] * axis[:, None])

    from_centre = points + along(points, height - 1)
    normals = normals + along(normals, 1 / height - 1)
    normals /= np.sqrt(np.einsum("mnd,mnd->mn", normals, normals))[..., None]
    return Contour(centre[:, None] + from_centre, normals, from_centre)


def pixels_of(points: Array, camera: Camera) -> Array:
    """Pixels (m, n, 2) of points (m, n, 3) in a camera's frame; NaN behind it."""
    return camera.project(points.reshape(-1, 3)).reshape(*points.shape[:2], 2)


STEP_MM = 0.1  # outward, to see how far the outline moves


def outlines(
    teats: Array, cameras: list[tuple[Camera, Motion]], outline: Outline, *, slopes_too: bool
) -> tuple[Array, Array, Array]:
    """Outlines of teats (m, 8) in several cameras, each with its motion from the teats' frame:
    pixels (views, m, n, 2), outward normals, and how far they move outward (views, m, n, 8), px a
    unit of each number; zeros unless asked for.
    """
    contour = _contours(teats, [motion for _, motion in cameras], outline)
    views, m, n = len(cameras), len(teats), contour.points.shape[1]
    parts = [slice(i * m, (i + 1) * m) for i in range(views)]
    pixels = np.concatenate(
        [
            pixels_of(contour.points[at], camera)
            for at, (camera, _) in zip(parts, cameras, strict=True)
        ]
    )
    normals = normals_of(pixels)
    jacobian = np.zeros((views, m, n, COUNT))
    for i, (at, (camera, motion)) in enumerate(zip(parts, cameras, strict=True)):
        if slopes_too:
            one = Contour(contour.points[at], contour.normals[at], contour.from_centre[at])
            outward = pixels_of(one.points + STEP_MM * one.normals, camera) - pixels[at]
            px_a_mm = np.einsum("mnd,mnd->mn", outward, normals[at]) / STEP_MM
            jacobian[i] = slopes(teats, one, px_a_mm, motion)
    return pixels.reshape(views, m, n, 2), normals.reshape(views, m, n, 2), jacobian


def slopes(teats: Array, contour: Contour, px_a_mm: Array, camera_from_teats: Motion) -> Array:
    """Outward motion of outlines (m, n, 8), px a unit of each number; ``px_a_mm`` (m, n) along the
    normal. Sliding along the surface moves no outline.
    """
    R = camera_from_teats.R
    n, q = contour.normals @ R, contour.from_centre @ R  # in the teats' own frame
    axis, height = axes(teats), teats[:, HEIGHT]
    length = np.sqrt(1 + teats[:, LEAN_X] ** 2 + teats[:, LEAN_Z] ** 2)
    along_q, along_n = np.einsum("mnd,md->mn", q, axis), np.einsum("mnd,md->mn", n, axis)
    result = np.empty((*n.shape[:2], COUNT))
    result[..., :3] = n
    for column, which in ((LEAN_X, 0), (LEAN_Z, 2)):
        turned = (np.eye(3)[which] - axis * axis[:, [which]]) / length[:, None]
        by_turn, towards = np.einsum("mnd,md->mn", n, turned), np.einsum("mnd,md->mn", q, turned)
        result[..., column] = along_q * by_turn - towards * along_n
    round_q = np.einsum("mnd,mnd->mn", n, q) / teats[:, RADIUS, None]
    below = np.clip(along_q, 0, None)
    result[..., RADIUS] = np.where(below > 0, 1.0, round_q)
    result[..., TAPER] = below / height[:, None]  # taper is known where all is stretched back
    result[..., HEIGHT] = np.where(below > 0, 0.0, along_n * along_q / height[:, None])
    return np.asarray(result * px_a_mm[..., None])


def normals_of(pixels_px: Array) -> Array:
    """Outward unit normals (m, n, 2) of outlines (m, n, 2), from each point's neighbours."""
    along = np.empty_like(pixels_px)
    along[:, 1:-1] = pixels_px[:, 2:] - pixels_px[:, :-2]
    along[:, [0, -1]] = pixels_px[:, [1, -1]] - pixels_px[:, [0, -2]]
    length = np.sqrt(along[..., 0] ** 2 + along[..., 1] ** 2)
    return np.stack([along[..., 1] / length, -along[..., 0] / length], axis=-1)


def _surface(
    centre: Array, axis: Array, radius: Array, taper: Array, outline: Outline
) -> tuple[Array, Array]:
    """Outline points (m, n, 3) about the ball's centre, camera's frame, and their normals.

    Every normal n has n . centre = -radius; on the sides also n . axis = -taper: two, one a side.
    """
    depth_along = _dot(centre, axis)
    across = centre - depth_along[:, None] * axis
    distance = np.linalg.norm(across, axis=1)
    # from the axis to the camera, at right angles to the axis
    towards = -across / distance[:, None]
    sideways = _cross(axis, towards)
    x = (radius - taper * depth_along) / distance
    y2 = 1 - taper**2 - x**2
    y = np.sqrt(np.where(y2 > 0, y2, np.nan))
    level = [towards * x[:, None] + sign * sideways * y[:, None] for sign in (1.0, -1.0)]
    rims = [one - taper[:, None] * axis for one in level]
    cosine = np.sqrt(1 - taper**2)[:, None]
    generators = [cosine * axis + (taper[:, None] / cosine) * one for one in level]
    start, stop = rims
    far = np.linalg.norm(centre, axis=1)
    # from rim to rim over the end: on the circle n . centre = -radius
    middle = -(radius / far**2)[:, None] * centre
    first, last = start - middle, stop - middle
    reach = np.linalg.norm(first, axis=1)
    e1 = first / reach[:, None]
    # turns clockwise as the camera sees it: up from side A and over
    e2 = _cross(centre / far[:, None], e1)
    angle = np.arctan2(_dot(last, e2), _dot(last, e1)) % (2 * np.pi)
    phi = (angle[:, None] * outline.over_end[None, :])[..., None]
    turned = np.cos(phi) * e1[:, None] + np.sin(phi) * e2[:, None]
    over = middle[:, None] + reach[:, None, None] * turned
    k, along = len(outline.along_mm), outline.along_mm[:, None]
    rows = [np.repeat(start[:, None], k, axis=1), over, np.repeat(stop[:, None], k, axis=1)]
    normals = np.concatenate(rows, axis=1)
    up, down = (generator[:, None] for generator in generators)
    sides = np.concatenate([along[::-1] * up, np.zeros_like(over), along * down], axis=1)
    return radius[:, None, None] * normals + sides, normals


def _cross(a: Array, b: Array) -> Array:
    """As numpy's, for rows of three: a fifth of its time."""
    after, last = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[:, after] * b[:, last] - a[:, last] * b[:, after])


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ij,ij->i", a, b))
