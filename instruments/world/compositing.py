"""Exact coverage of pixels by solids, and partly covering surfaces laid over a background by depth.

A solid's outline is the convex hull of the outlines of its two ends in an ideal camera's plane, cut
short to follow the lens, distorted, and its area added up pixel by pixel: no samples, no sampling
error. Two pieces of one object in a pixel cover the larger share; different objects cover
independently.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments import world as package
from instruments.world.optics import CameraModel, Floats
from instruments.world.sensor import Part
from instruments.world.solids import Ints, Solids


@dataclass(frozen=True, eq=False)
class Layer:
    """One object in one camera: each pixel (n,) that it covers, with its ``share``, ``depth_mm``,
    and ``value``: light, emissivity or phasor. ``along``: 0 to 1 between its two temperatures.
    """

    row: Ints
    column: Ints
    share: Floats
    depth_mm: Floats
    value: NDArray[Any]
    along: Floats | None = None

    def __len__(self) -> int:
        return len(self.share)

    @cached_property
    def around(self) -> Part:
        """The part of an image that it covers; of one that covers a pixel."""
        return (
            slice(int(self.row.min()), int(self.row.max()) + 1),
            slice(int(self.column.min()), int(self.column.max()) + 1),
        )

    @cached_property
    def mean_depth_mm(self) -> float:
        """Of its pixels, however much it covers of each."""
        return float(self.depth_mm.mean())


def lay_over(
    image: NDArray[Any], layers: Sequence[Layer], corner: tuple[int, int] = (0, 0)
) -> None:
    """Lay objects over ``image`` (h, w) in place; its first pixel is at ``corner``."""
    flat, width = image.reshape(-1), image.shape[1]
    for group in _far_to_near(layers):
        pixels = [(one.row - corner[0]) * width + one.column - corner[1] for one in group]
        if len(group) == 1:
            (layer,), (pixel,) = group, pixels
            flat[pixel] += layer.share * (layer.value - flat[pixel])
            continue
        owner = np.repeat(np.arange(len(group)), [len(pixel) for pixel in pixels])
        share, depth, value = (
            np.concatenate([getattr(one, name) for one in group])
            for name in ("share", "depth_mm", "value")
        )
        pixel = np.concatenate(pixels)
        alone, nearest, light, behind = _stacked(pixel, share, depth, owner, value)
        at, past = pixel[alone], flat[pixel[alone]]
        flat[at] = past + share[alone] * (value[alone] - past)
        at = pixel[nearest]
        flat[at] = light + behind * flat[at]


def _far_to_near(layers: Sequence[Layer]) -> Iterator[list[Layer]]:
    """Groups of layers whose depths don't reach into each other's, the farthest first."""
    spans = [
        (float(layer.depth_mm.max()), float(layer.depth_mm.min()), i)
        for i, layer in enumerate(layers)
        if len(layer)
    ]
    group: list[Layer] = []
    nearest = np.inf
    for far, near, i in sorted(spans, reverse=True):
        if group and far < nearest:
            yield group
            group = []
        group.append(layers[i])
        nearest = min(nearest, near) if len(group) > 1 else near
    if group:
        yield group


def _stacked(
    pixel: Ints, share: Floats, depth: Floats, owner: Ints, value: NDArray[Any]
) -> tuple[Ints, Ints, NDArray[Any], Floats]:
    """Surfaces in pixels (m,): those alone there; the nearest of others, light, share seen past."""
    found = np.empty(len(pixel), dtype=np.intp)
    lone = package.kernels.by_pixel(pixel, depth, found)
    alone, order = found[:lone], found[lone:]
    kind = np.result_type(value, np.float64)  # complex as two numbers
    pair = value.astype(kind).view(np.float64).reshape(len(value), -1)
    nearest, behind = np.empty(len(order), dtype=np.intp), np.empty(len(order))
    light = np.zeros((len(order), pair.shape[1]))
    n = package.kernels.stacked(order, pixel, share, owner, pair, nearest, light, behind)
    return alone, nearest[:n], light[:n].view(kind)[:, 0], behind[:n]


def merged(layer: Layer) -> Layer:
    """One object's layer from surfaces of which several may meet in a pixel."""
    if not len(layer):
        return layer
    left, top = int(layer.column.min()), int(layer.row.min())
    pixel = (layer.row - top) * (int(layer.column.max()) - left + 1) + layer.column - left
    one, value = np.zeros(len(pixel), dtype=np.intp), layer.value
    alone, nearest, light, behind = _stacked(pixel, layer.share, layer.depth_mm, one, value)
    if not len(nearest):
        return layer
    keep, seen = np.concatenate([alone, nearest]), 1.0 - behind
    mean = np.concatenate([value[alone], light / np.maximum(seen, 1e-12)])
    return Layer(
        layer.row[keep],
        layer.column[keep],
        np.concatenate([layer.share[alone], seen]),
        layer.depth_mm[keep],
        mean.astype(value.dtype),
        None if layer.along is None else layer.along[keep],
    )


# round an end whose radius in px is above, up to
RING_POINTS = ((64, 0.0, 7.0), (128, 7.0, 20.0), (512, 20.0, np.inf))
MARGIN_PX = 16.0  # beyond the image, where outlines are cut off; more than a piece's length
NEAREST_MM = 50.0


@dataclass(frozen=True, slots=True, eq=False)
class Cover:
    """n pairs of a solid and a pixel that it covers, sorted by solid: solid, pixel, share."""

    solid: Ints
    row: Ints
    column: Ints
    share: Floats


def cover(solids: Solids, camera: CameraModel) -> Cover:
    """Every pixel and share of it that each solid covers, hidden or not. Raises ValueError for a
    solid nearer than 50 mm.
    """
    if len(solids) == 0:
        nothing = np.zeros(0, dtype=np.intp)
        return Cover(nothing, nothing, nothing, np.zeros(0))
    _refuse_near(float(solids.nearest_depth().min()), camera)
    depth = np.minimum(solids.a[:, 2], solids.b[:, 2])
    size_px = np.maximum(solids.radius_a, solids.radius_b) / depth * float(camera.fc.max())
    ends = solids.radius_a, solids.radius_b, solids.flat_a, solids.flat_b
    table, corners = np.column_stack([solids.a, solids.b, solids.axis, *ends]), dict[int, Floats]()
    for points, above, up_to in RING_POINTS:
        which = np.flatnonzero((size_px > above) & (size_px <= up_to))
        if len(which) == 0:
            continue
        clouds = np.empty((len(which), 2 * points, 2))
        package.kernels.rims(table[which], *_circle(points), clouds)
        coarse = clouds.astype(np.float32, order="C")
        for number, cloud, rough in zip(which.tolist(), clouds, coarse, strict=True):
            corners[number] = cloud[cv2.convexHull(rough, returnPoints=False)[:, 0]]
    return _of_corners([corners[number] for number in range(len(solids))], camera)


def cover_outlines(outlines: Sequence[Floats], camera: CameraModel) -> Cover:
    """The same for flat polygons, each (m, 3) mm in the camera's frame, before the camera."""
    for outline in outlines:
        _refuse_near(float(outline[:, 2].min()), camera)
    return _of_corners([outline[:, :2] / outline[:, 2:] for outline in outlines], camera)


def _refuse_near(nearest_mm: float, camera: CameraModel) -> None:
    if not nearest_mm >= NEAREST_MM:
        raise ValueError(
            f"something in the scene comes within {nearest_mm:.0f} mm of the {camera.name} camera's"
            f" plane; it must stay {NEAREST_MM:.0f} mm in front of it: move it away from the"
            " cameras"
        )


def _of_corners(corners: Sequence[Floats], camera: CameraModel) -> Cover:
    """Each solid's polygon (m, 2) in the ideal plane."""
    counts, window = np.array([len(outline) for outline in corners]), _plane_window(camera)
    joined = np.concatenate(corners)
    after, parts = np.empty((2, len(joined)), dtype=np.intp)
    plane = np.empty((package.kernels.parted(counts, joined, camera.fc, after, parts), 2))
    package.kernels.pieces(joined, after, parts, window, plane)
    counts = np.add.reduceat(parts, np.cumsum(counts) - counts)
    # From here a pixel reaches from its number to the next one.
    pixels, size = camera.pixels_from_plane(plane) + 0.5, (camera.width_px, camera.height_px)
    points = np.minimum(np.maximum(pixels, -MARGIN_PX), np.add(size, MARGIN_PX))
    runs = np.cumsum(counts) - counts
    left, top = np.floor(np.minimum.reduceat(points, runs)).astype(np.intp).T
    right, bottom = np.floor(np.maximum.reduceat(points, runs)).astype(np.intp).T
    windows = np.column_stack([left, right + 2, top, bottom + 1])
    cells = int(((right + 2 - left) * (bottom + 1 - top)).sum())
    places, share = np.empty((3, cells), dtype=np.intp), np.empty(cells)
    seen = package.kernels.areas(counts, windows, points, *size, places, share)
    solid, row, column = places[:, :seen].copy()
    return Cover(solid, row, column, share[:seen].copy())


@lru_cache
def _circle(points: int) -> tuple[Floats, float]:
    """Points of the unit circle, (m, 2), and by how much their polygon, which is inscribed and a
    little small, is stretched to have the circle's area.
    """
    step = 2.0 * np.pi / points
    angle = np.arange(points) * step
    stretch = float(np.sqrt(step / np.sin(step)))
    return np.column_stack([np.cos(angle), np.sin(angle)]), stretch


@lru_cache(maxsize=16)  # cameras are few and never change
def _plane_window(camera: CameraModel) -> Floats:
    """A part of the ideal plane with the image and its margin, its corners (2, 2): a lens model may
    fold beyond it.
    """
    w, h = camera.width_px + MARGIN_PX, camera.height_px + MARGIN_PX
    u, v = np.meshgrid(np.linspace(-MARGIN_PX, w, 9), np.linspace(-MARGIN_PX, h, 9))
    plane = camera.plane_from_pixels(np.column_stack([u.ravel(), v.ravel()]))
    return np.stack([plane.min(axis=0), plane.max(axis=0)])
