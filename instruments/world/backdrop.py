"""What never moves: table, its front, the board behind with posters, the dark room; and shadows on
the table.

Flat patches with textures fixed to them, drawn once a camera. Soft shadows are computed on a coarse
grid on the table and looked up by each pixel; only the table receives them, and hoses cast none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments import world as package
from instruments.world.boards import Weave, woven
from instruments.world.compositing import cover_outlines
from instruments.world.optics import CameraModel, Floats
from instruments.world.sensor import Image
from instruments.world.shading import Lighting, Rows, irradiance
from instruments.world.solids import Ints, Point, Solids

TEXEL_MM = 2.0
# rows and columns between pixels at which the light of a plane is worked out: the table lies
# nearly along the rays, so that a few rows are half a metre
COARSE_PX = (2, 32)
PATCHES_KEPT = 64  # places in pictures of patches: three by camera stay, posters come and go
FAR_MM = 2400.0  # the room's walls


@dataclass(frozen=True, slots=True)
class Poster:
    """A rectangle on the board: ``x_mm``, ``z_mm`` of its lower left corner, size, albedo."""

    x_mm: float
    z_mm: float
    width_mm: float
    height_mm: float
    albedo: float


BOARD_X_MM, BOARD_TOP_MM = (-1040.0, 1100.0), 760.0
TABLE_FRONT_Y_MM, TABLE_REACH_MM, TABLE_DROP_MM = -235.0, 1400.0, 220.0


@dataclass(frozen=True, slots=True)
class Backdrop:
    """Table at z = 0 with its front edge, and an upright board behind. ``…_texture``: share that an
    albedo varies by; later ``posters`` lie over earlier ones; ``board_k``, ``table_k``: above the
    room.
    """

    board_albedo: float = 0.55
    board_texture: float = 0.08
    board_weave: Weave = "cloud"
    table_albedo: float = 0.45
    table_texture: float = 0.12
    table_weave: Weave = "cloud"
    front_albedo: float = 0.16
    room_albedo: float = 0.10
    texture_seed: int = 0
    posters: tuple[Poster, ...] = ()
    board_k: float = 0.0
    table_k: float = 0.0
    board_y_mm: float = 1000.0

    def shaped(self) -> Backdrop:
        """Without the posters that lie on the board, whole: they are as far and as warm as it."""
        (left, right), top = BOARD_X_MM, BOARD_TOP_MM
        off = tuple(
            p
            for p in self.posters
            if not (left <= p.x_mm and p.x_mm + p.width_mm <= right)
            or not 0.0 <= p.z_mm <= top - p.height_mm
        )
        return replace(self, posters=off)


class Place(NamedTuple):
    """A rectangle: a corner and two edges, mm; across x along points to the visible side."""

    corner_mm: Point
    across_mm: Point
    along_mm: Point
    normal: Point

    @property
    def texels(self) -> tuple[int, int]:
        """Its size across and along in texels of a weave."""
        across, along = (round(math.hypot(*edge) / TEXEL_MM) for edge in self[1:3])
        return across, along


@dataclass(frozen=True, slots=True)
class Patch:
    """What is painted and warm at a place."""

    place: Place
    albedo: float
    texture: float = 0.0
    weave: Weave = "cloud"
    seed: int = 0
    warmer_k: float = 0.0

    def woven(self) -> Image:
        """The weave fixed to it, in texels, about -1 to 1."""
        return woven(self.weave, self.seed, *self.place.texels)


def patches(backdrop: Backdrop) -> tuple[Patch, ...]:
    """Far to near: board, posters, table, the table's front."""
    b, seed = backdrop, 2 * backdrop.texture_seed
    wide, deep = BOARD_X_MM[1] - BOARD_X_MM[0], b.board_y_mm - TABLE_FRONT_Y_MM
    reach = (2.0 * TABLE_REACH_MM, 0.0, 0.0)
    edge = (-TABLE_REACH_MM - 190.0, TABLE_FRONT_Y_MM, 0.0)
    back = (0.0, -1.0, 0.0)

    def upright(x: float, z: float, width: float, height: float) -> Place:
        return Place((x, b.board_y_mm, z), (width, 0.0, 0.0), (0.0, 0.0, height), back)

    board = upright(BOARD_X_MM[0], 0.0, wide, BOARD_TOP_MM)
    table = Place(edge, reach, (0.0, deep, 0.0), (0.0, 0.0, 1.0))
    front = Place(edge, reach, (0.0, 0.0, -TABLE_DROP_MM), back)
    return (
        Patch(board, b.board_albedo, b.board_texture, b.board_weave, seed, b.board_k),
        *(
            Patch(upright(p.x_mm, p.z_mm, p.width_mm, p.height_mm), p.albedo, warmer_k=b.board_k)
            for p in b.posters
        ),
        Patch(table, b.table_albedo, b.table_texture, b.table_weave, seed + 1, b.table_k),
        Patch(front, b.front_albedo, warmer_k=b.table_k),
    )


def draw(
    backdrop: Backdrop, lighting: Lighting, camera: CameraModel
) -> tuple[Image, Image, tuple[float, float]]:
    """Light of the backdrop and depth in mm, (height, width) each, depth read-only; then the least
    and the greatest depth.
    """
    room = backdrop.room_albedo * lighting.ambient * lighting.brightness
    image = np.full((camera.height_px, camera.width_px), room, dtype=np.float32)
    for patch, seen in patches_seen(backdrop, camera):
        seen.lay_over(image, patch, lighting)
    places = tuple(patch.place for patch in patches(backdrop.shaped()))
    return image, *_depths(places, camera)


@lru_cache(maxsize=16)
def _depths(places: tuple[Place, ...], camera: CameraModel) -> tuple[Image, tuple[float, float]]:
    """Depth in mm, (height, width), of places, far to near; the least and the greatest."""
    depth = np.full((camera.height_px, camera.width_px), FAR_MM, dtype=np.float32)
    for place in places:
        if seen := _seen(place, camera):
            depth[seen.part] += seen.share * (seen.depth_mm - depth[seen.part])
    depth.flags.writeable = False
    return depth, (float(depth.min()), float(depth.max()))


@lru_cache(maxsize=3)
def warmer(backdrop: Backdrop, camera: CameraModel) -> Image:
    """How much warmer than the room the backdrop is at each pixel, K, (height, width); kept."""
    warmth = np.zeros((camera.height_px, camera.width_px), dtype=np.float32)
    for patch, seen in patches_seen(backdrop.shaped(), camera):
        warmth[seen.part] += seen.share * (np.float32(patch.warmer_k) - warmth[seen.part])
    warmth.flags.writeable = False
    return warmth


def patches_seen(backdrop: Backdrop, camera: CameraModel) -> Iterator[tuple[Patch, VisiblePart]]:
    """Far to near, those that the camera sees."""
    for patch in patches(backdrop):
        if seen := _seen(patch.place, camera):
            yield patch, seen


@dataclass(frozen=True, eq=False)
class VisiblePart:
    """A place in a camera's picture: its ``part`` (h, w), which share of each pixel, how deep.

    Light is smooth on a plane: it is worked out at ``points`` (3, n), a ``grid`` (rows, columns) of
    them, and interpolated; relative errors stay below 1e-4 (the lamps are 1 m and more away, a step
    on the board is 25 mm).
    """

    place: Place
    camera: CameraModel
    part: tuple[slice, slice]
    share: Image
    depth_mm: Image
    points: NDArray[np.float32]
    grid: tuple[int, int]

    def lay_over(self, image: Image, patch: Patch, lighting: Lighting) -> None:
        """Lay the light of what is painted there over a picture, in place."""
        normal = np.asarray(self.place.normal, dtype=np.float32)[:, None]
        coarse = irradiance(lighting, self.points, normal) * np.float32(patch.albedo)
        # the grid is of middles of parts of `COARSE_PX`, one beyond each side
        size = COARSE_PX[1] * self.grid[1], COARSE_PX[0] * self.grid[0]
        fine = cv2.resize(coarse.astype(np.float32).reshape(self.grid), size)
        varies = self.texture(patch) if patch.texture > 0.0 else self.share  # which counts nothing
        rows, (down, across) = self.part[0], COARSE_PX
        light = np.asarray(fine[down : down + len(self.share)], dtype=np.float32)
        seen = light, across, self.share, varies, patch.texture
        package.kernels.paint(image[rows], self.part[1].start, *seen)

    def texture(self, patch: Patch) -> Image:
        """The weave fixed to the patch, about -1 to 1, (h, w)."""
        values = cv2.remap(
            patch.woven(), *self._texels, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(values, dtype=np.float32)

    @cached_property
    def _texels(self) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
        """Where each pixel lies on the weave, as OpenCV's maps."""
        x, y = (ray[self.part].reshape(-1) for ray in self.camera.rays())
        points, _ = _met(self.place, self.camera, np.stack([x, y]))
        off = points - np.asarray(self.place.corner_mm, dtype=np.float32)[:, None]
        places: list[NDArray[np.float32]] = []
        edges = self.place.across_mm, self.place.along_mm
        for edge, size in zip(edges, self.place.texels, strict=True):
            length = float(np.linalg.norm(edge))
            unit = np.asarray(edge, dtype=np.float32) / np.float32(length * TEXEL_MM)
            # maps are of 16 bits: what lies that far outside has no share
            places.append(np.clip(unit @ off, -16.0, size + 16.0).reshape(self.share.shape))
        fixed, part = cv2.convertMaps(places[0], places[1], cv2.CV_16SC2)
        return np.asarray(fixed, np.int16), np.asarray(part, np.uint16)


@lru_cache(PATCHES_KEPT)
def _seen(place: Place, camera: CameraModel) -> VisiblePart | None:
    """None for a place that the camera doesn't see."""
    corner, across, along = (np.asarray(edge) for edge in place[:3])
    square = np.array([corner, corner + across, corner + across + along, corner + along])
    outline = cover_outlines([camera.camera_from_world(square)], camera)
    if not len(outline.row):
        return None
    top, bottom = int(outline.row.min()), int(outline.row.max()) + 1
    left, right = int(outline.column.min()), int(outline.column.max()) + 1
    part = slice(top, bottom), slice(left, right)
    share = np.zeros((bottom - top, right - left), dtype=np.float32)
    share[outline.row - top, outline.column - left] = outline.share
    (tall, wide), (down, over) = share.shape, COARSE_PX
    grid = -(-tall // down) + 2, -(-wide // over) + 2
    v, u = np.mgrid[: grid[0], : grid[1]].astype(np.float64)
    v, u = down * v - 0.5 * (down + 1), over * u - 0.5 * (over + 1)
    pixels = np.column_stack([u.ravel() + left, v.ravel() + top])
    points, _ = _met(place, camera, camera.plane_from_pixels(pixels).T)
    x, y = (ray[part].reshape(-1) for ray in camera.rays())
    _, depth = _met(place, camera, np.stack([x, y]))
    return VisiblePart(place, camera, part, share, depth.reshape(share.shape), points, grid)


def _met(
    place: Place, camera: CameraModel, plane: Floats
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where rays (2, n) meet the patch's plane: points (3, n), depths (n,). A pixel that looks past
    the horizon gets a far point.
    """
    x, y = plane.astype(np.float32)
    turn, eye = camera.R.astype(np.float32), camera.centre_mm.astype(np.float32)
    ray = np.stack([turn[0, i] * x + turn[1, i] * y + turn[2, i] for i in range(3)])
    corner, normal = (np.asarray(at, dtype=np.float32) for at in (place.corner_mm, place.normal))
    towards = normal @ ray
    ahead = np.where(np.abs(towards) > 1e-6, towards, np.float32(-1e-6))
    depth = np.clip(normal @ (corner - eye) / ahead, 0.0, 1e4).astype(np.float32)
    return eye[:, None] + depth * ray, depth


SHADOW_TEXEL_MM = 8.0
REACH_MM = 150.0  # how far around a thing its shadow is looked for
LAMP_RADIUS_MM = 130.0
STANDING_MM = 12.0  # what starts lower than this stands on the table
LEAST_CASTER_MM = 6.0  # thinner things (hoses) cast no shadow


@dataclass(frozen=True, slots=True, eq=False)
class ShadowMap:
    """The table's remaining light: ``share[i, j]`` at x_mm + j TEXEL_MM, y_mm + i TEXEL_MM."""

    x_mm: float
    y_mm: float
    share: Image

    def high_mm(self) -> Floats:
        """The grid's far corner, (2,) mm."""
        return np.array([self.x_mm, self.y_mm]) + SHADOW_TEXEL_MM * np.array(
            [self.share.shape[1] - 1, self.share.shape[0] - 1]
        )


def shadow_map(lighting: Lighting, solids: Solids) -> ShadowMap | None:
    """The shadows of ``solids`` (world frame) on the table; None without shadows or light."""
    casters = np.flatnonzero(np.maximum(solids.radius_a, solids.radius_b) >= LEAST_CASTER_MM)
    if len(casters) == 0 or lighting.brightness <= 0.0:
        return None
    ends = np.concatenate([solids.a[casters], solids.b[casters]])[:, :2]
    low, high = ends.min(axis=0) - REACH_MM, ends.max(axis=0) + REACH_MM
    x, y = (
        np.arange(least, most + SHADOW_TEXEL_MM, SHADOW_TEXEL_MM, dtype=np.float32)
        for least, most in zip(low, high, strict=True)
    )
    u, v = (grid.ravel() for grid in np.meshgrid(x, y))
    points = np.stack([u, v, np.zeros_like(u)])
    up = np.array([[0.0], [0.0], [1.0]], dtype=np.float32)
    sky = irradiance(Lighting(1.0, (), lighting.ambient), points, up)
    total, lit = sky, sky * _sky_left(solids, casters, points)
    a, b = solids.a[casters].astype(np.float32), solids.b[casters].astype(np.float32)
    wider = (solids.radius_b - solids.radius_a)[casters]
    hulls = np.column_stack([a, b - a, solids.radius_a[casters], wider]).astype(np.float32)
    for lamp in lighting.lamps:
        light = irradiance(Lighting(1.0, (lamp,), 0.0), points, up)
        at, left = np.array(lamp.at_mm, dtype=np.float32), np.ones_like(light)
        package.kernels.lamp_left(hulls, points, at, LAMP_RADIUS_MM, left)
        total, lit = total + light, lit + light * left
    share = (lit / np.maximum(total, 1e-9)).reshape(len(y), len(x))
    return ShadowMap(float(low[0]), float(low[1]), share.astype(np.float32))


def _sky_left(solids: Solids, casters: Ints, points: Rows) -> Rows:
    """Share of the room's light left at table points beside standing things. A post of height h and
    radius r at distance d hides asin(r / d) / pi of the horizon, up to a cosine-weighted h^2 / (h^2
    + d^2).
    """
    left = np.ones_like(points[0])
    lowest = solids.nearest_depth()
    for i in casters[lowest[casters] < STANDING_MM]:
        height = np.float32(max(solids.a[i, 2], solids.b[i, 2]))
        radius = np.float32(max(solids.radius_a[i], solids.radius_b[i]))
        x, y = solids.a[i, :2].astype(np.float32)
        d2 = np.maximum((points[0] - x) ** 2 + (points[1] - y) ** 2, radius**2)
        left *= 1.0 - np.arcsin(radius / np.sqrt(d2)) / np.float32(np.pi) * height**2 / (
            height**2 + d2
        )
    return np.asarray(left)


def shade(
    shadows: ShadowMap, backdrop: Backdrop, camera: CameraModel
) -> tuple[tuple[slice, slice], Image] | None:
    """The light that shadows leave in a part of a camera's picture, and which part, if any."""
    low = np.array([shadows.x_mm, max(shadows.y_mm, TABLE_FRONT_Y_MM)])
    high = np.minimum(shadows.high_mm(), [np.inf, backdrop.board_y_mm])
    u, v = np.meshgrid(np.linspace(low[0], high[0], 5), np.linspace(low[1], high[1], 5))
    pixels = camera.project(np.column_stack([u.ravel(), v.ravel(), np.zeros(u.size)]))
    size = [camera.width_px, camera.height_px]
    left, top = np.clip(np.floor(pixels.min(axis=0)), 0, size).astype(int)
    right, bottom = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, size).astype(int)
    if right <= left or bottom <= top:
        return None
    part = slice(int(top), int(bottom)), slice(int(left), int(right))
    x, y = (ray[part] for ray in camera.rays())
    to_x, to_y, to_z = (camera.R[0, i] * x + camera.R[1, i] * y + camera.R[2, i] for i in range(3))
    depth = -camera.centre_mm[2] / np.minimum(to_z, -1e-6)
    table_x, table_y = camera.centre_mm[0] + depth * to_x, camera.centre_mm[1] + depth * to_y
    on_x = ((table_x - shadows.x_mm) / SHADOW_TEXEL_MM).astype(np.float32)
    on_y = ((table_y - shadows.y_mm) / SHADOW_TEXEL_MM).astype(np.float32)
    looked_up = cv2.remap(
        shadows.share, on_x, on_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0
    )
    share = np.asarray(looked_up, dtype=np.float32)
    share[(table_y > high[1]) | (table_y < low[1]) | (to_z > -1e-6)] = 1.0
    return part, share
