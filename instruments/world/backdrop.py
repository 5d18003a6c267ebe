"""What never moves: table, its front, the board behind with posters, the dark room; and shadows on
the table.

Flat patches with textures fixed to them, drawn once a camera. Soft shadows are computed on a coarse
grid on the table and looked up by each pixel; only the table receives them, and hoses cast none.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.world.boards import Weave, woven
from instruments.world.compositing import Cover, cover_outlines
from instruments.world.optics import CameraModel, Floats
from instruments.world.sensor import Image
from instruments.world.shading import Lamp, Lighting, Rows, irradiance
from instruments.world.solids import Ints, Point, Solids, dot

TEXEL_MM = 2.0
# what is worked out on the way stays in the processor's cache; OpenCV's remap takes at most 32767
# rows
PIXELS_AT_ONCE = 16384
KEPT = 2  # drawn backdrops: those of a rig's two cameras, for a rig that is opened again
FAR_MM = 2400.0  # the room's walls


@dataclass(frozen=True, slots=True)
class Poster:
    """A rectangle on the board: ``x_mm``, ``z_mm`` of its lower left corner, size, albedo."""

    x_mm: float
    z_mm: float
    width_mm: float
    height_mm: float
    albedo: float

    def __post_init__(self) -> None:
        if not (self.width_mm > 0.0 and self.height_mm > 0.0 and 0.0 <= self.albedo <= 1.0):
            raise ValueError(
                f"a poster needs a size above zero and an albedo from 0 to 1, is {self}"
            )


@dataclass(frozen=True, slots=True)
class Backdrop:
    """Table at z = 0 with its front edge, and an upright board behind; world frame, mm.

    ``…_texture``: the share that an albedo varies by; ``…_weave``: how. Later ``posters`` lie over
    earlier ones. ``board_k``, ``table_k``: kelvin above the room.
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
    board_x_mm: tuple[float, float] = (-1040.0, 1100.0)
    board_top_mm: float = 760.0
    table_front_y_mm: float = -235.0
    table_reach_mm: float = 1400.0
    table_drop_mm: float = 220.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name.endswith(("_albedo", "_texture")) and not 0.0 <= value <= 1.0:
                raise ValueError(f"{field.name} must be from 0 to 1, is {value}")
        if not (
            self.board_y_mm > self.table_front_y_mm
            and self.board_x_mm[1] > self.board_x_mm[0]
            and self.board_top_mm > 0.0
        ):
            raise ValueError(
                f"the board must stand behind the table's front edge and have a size, is {self}"
            )


Corners = tuple[Point, Point, Point, Point]  # the first fields of a patch


@dataclass(frozen=True, slots=True)
class Patch:
    """A rectangle: a corner and two edges, mm; across x along points to the visible side."""

    corner_mm: Point
    across_mm: Point
    along_mm: Point
    normal: Point
    albedo: float
    texture: float = 0.0
    weave: Weave = "cloud"
    seed: int = 0
    warmer_k: float = 0.0


def patches(backdrop: Backdrop) -> tuple[Patch, ...]:
    """Far to near: board, posters, table, the table's front."""
    b, seed = backdrop, 2 * backdrop.texture_seed
    wide, deep = b.board_x_mm[1] - b.board_x_mm[0], b.board_y_mm - b.table_front_y_mm
    reach = (2.0 * b.table_reach_mm, 0.0, 0.0)
    edge = (-b.table_reach_mm - 190.0, b.table_front_y_mm, 0.0)
    back = (0.0, -1.0, 0.0)

    def upright(x: float, z: float, width: float, height: float) -> Corners:
        return (x, b.board_y_mm, z), (width, 0.0, 0.0), (0.0, 0.0, height), back

    board = upright(b.board_x_mm[0], 0.0, wide, b.board_top_mm)
    table: Corners = (edge, reach, (0.0, deep, 0.0), (0.0, 0.0, 1.0))
    return (
        Patch(*board, b.board_albedo, b.board_texture, b.board_weave, seed, b.board_k),
        *(
            Patch(*upright(p.x_mm, p.z_mm, p.width_mm, p.height_mm), p.albedo, warmer_k=b.board_k)
            for p in b.posters
        ),
        Patch(*table, b.table_albedo, b.table_texture, b.table_weave, seed + 1, b.table_k),
        Patch(edge, reach, (0.0, 0.0, -b.table_drop_mm), back, b.front_albedo, warmer_k=b.table_k),
    )


@lru_cache(KEPT)
def draw(backdrop: Backdrop, lighting: Lighting, camera: CameraModel) -> tuple[Image, Image]:
    """Light of the backdrop before lens and sensor, and depth in mm, (height, width) each; both
    read-only, for the latest answers are kept.
    """
    rays = camera.rays()
    room = backdrop.room_albedo * lighting.ambient * lighting.brightness
    image = np.full(camera.height_px * camera.width_px, room, dtype=np.float32)
    depth = np.full_like(image, FAR_MM)
    for patch in patches(backdrop):
        seen = _outline(patch, camera)
        pixels, shares = seen.row * camera.width_px + seen.column, seen.share.astype(np.float32)
        for start in range(0, len(pixels), PIXELS_AT_ONCE):
            part = slice(start, start + PIXELS_AT_ONCE)
            pixel, share = pixels[part], shares[part]
            light, far = _light(patch, lighting, camera, rays, pixel)
            image[pixel] += share * (light - image[pixel])
            depth[pixel] += share * (far - depth[pixel])
    image.flags.writeable = depth.flags.writeable = False
    shape = (camera.height_px, camera.width_px)
    return image.reshape(shape), depth.reshape(shape)


def warmer(backdrop: Backdrop, camera: CameraModel) -> Image:
    """How much warmer than the room the backdrop is at each pixel, K, (height, width)."""
    warmth = np.zeros((camera.height_px, camera.width_px), dtype=np.float32)
    for patch in patches(backdrop):
        seen = _outline(patch, camera)
        at = (seen.row, seen.column)
        warmth[at] += seen.share.astype(np.float32) * (np.float32(patch.warmer_k) - warmth[at])
    return warmth


def _outline(patch: Patch, camera: CameraModel) -> Cover:
    edges = patch.corner_mm, patch.across_mm, patch.along_mm
    corner, across, along = (np.asarray(edge) for edge in edges)
    square = np.array([corner, corner + across, corner + across + along, corner + along])
    return cover_outlines([camera.camera_from_world(square)], camera)


def _light(
    patch: Patch, lighting: Lighting, camera: CameraModel, rays: tuple[Floats, Floats], pixel: Ints
) -> tuple[Image, Image]:
    """Light from a patch at these pixels (n,), and its depth there."""
    x, y = (ray.reshape(-1)[pixel].astype(np.float32) for ray in rays)
    turn, eye = camera.R.astype(np.float32), camera.centre_mm.astype(np.float32)
    ray = np.stack([turn[0, i] * x + turn[1, i] * y + turn[2, i] for i in range(3)])
    normal = np.asarray(patch.normal, dtype=np.float32)
    corner = np.asarray(patch.corner_mm, dtype=np.float32)
    towards = normal @ ray
    # A pixel on the patch's edge may look past it, and past the horizon: its light is that of a far
    # point.
    ahead = np.where(np.abs(towards) > 1e-6, towards, np.float32(-1e-6))
    depth = np.clip(normal @ (corner - eye) / ahead, 0.0, 1e4).astype(np.float32)
    points = eye[:, None] + depth * ray
    light = irradiance(lighting, points, normal[:, None]) * np.float32(patch.albedo)
    if patch.texture > 0.0:
        light *= 1.0 + np.float32(patch.texture) * _texture(patch, points)
    return light.astype(np.float32, copy=False), depth


def _texture(patch: Patch, points_mm: NDArray[np.float32]) -> Image:
    """The weave fixed to the patch, about -1 to 1, at surface points (3, n)."""
    off = points_mm - np.asarray(patch.corner_mm, dtype=np.float32)[:, None]
    places, sizes = [], []
    for edge in (patch.across_mm, patch.along_mm):
        length = float(np.linalg.norm(edge))
        unit = np.asarray(edge, dtype=np.float32) / np.float32(length * TEXEL_MM)
        places.append((unit @ off)[:, None])
        sizes.append(round(length / TEXEL_MM))
    (u, v), cloth = places, woven(patch.weave, patch.seed, *sizes)
    values = cv2.remap(cloth, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values.reshape(-1), dtype=np.float32)


Grey = NDArray[np.float32]

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
    share: Grey

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
    for lamp in lighting.lamps:
        light = irradiance(Lighting(1.0, (lamp,), 0.0), points, up)
        total, lit = total + light, lit + light * _lamp_left(solids, casters, points, lamp)
    share = (lit / np.maximum(total, 1e-9)).reshape(len(y), len(x))
    return ShadowMap(float(low[0]), float(low[1]), share.astype(np.float32))


def _lamp_left(solids: Solids, casters: Ints, points: Rows, lamp: Lamp) -> Rows:
    """Share of a round lamp seen from table points (3, n): rays' gaps to solids by penumbra."""
    way = np.asarray(lamp.at_mm, dtype=np.float32)[:, None] - points
    far = np.sqrt(dot(way, way))
    way /= far
    left = np.ones_like(far)
    for i in casters:
        a, b = solids.a[i].astype(np.float32), solids.b[i].astype(np.float32)
        # the ray's and the segment's nearest points: least distance, place on ray and segment
        span, off = b - a, points - a[:, None]
        cross, d_way, d_span = dot(way, span), dot(off, way), dot(off, span)
        under = np.maximum(dot(span, span) - cross * cross, np.float32(1e-3))
        part = np.clip((d_span - d_way * cross) / under, 0.0, 1.0)
        along = np.maximum(part * cross - d_way, 0.0)
        off += along * way
        off -= part * span[:, None]
        gap = np.sqrt(dot(off, off))
        wider = np.float32(solids.radius_b[i] - solids.radius_a[i])
        radius = np.float32(solids.radius_a[i]) + part * wider
        half_shade = np.maximum(along, 2.0) * (LAMP_RADIUS_MM / far)
        np.minimum(left, np.clip(0.5 + 0.5 * (gap - radius) / half_shade, 0.0, 1.0), out=left)
    return np.asarray(left)


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


@dataclass(frozen=True, slots=True, eq=False)
class Shade:
    """Light left by shadows in a part of a camera's image: (rows, columns), ``share``."""

    rows: slice
    columns: slice
    share: Grey


def shade(
    shadows: ShadowMap, backdrop: Backdrop, camera: CameraModel, rays: tuple[Floats, Floats]
) -> Shade | None:
    """The shadows as a camera sees them on the table; None where they fall outside of its image."""
    low = np.array([shadows.x_mm, max(shadows.y_mm, backdrop.table_front_y_mm)])
    high = np.minimum(shadows.high_mm(), [np.inf, backdrop.board_y_mm])
    u, v = np.meshgrid(np.linspace(low[0], high[0], 5), np.linspace(low[1], high[1], 5))
    pixels = camera.project(np.column_stack([u.ravel(), v.ravel(), np.zeros(u.size)]))
    size = [camera.width_px, camera.height_px]
    left, top = np.clip(np.floor(pixels.min(axis=0)), 0, size).astype(int)
    right, bottom = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, size).astype(int)
    if right <= left or bottom <= top:
        return None
    x, y = (ray[top:bottom, left:right] for ray in rays)
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
    return Shade(slice(int(top), int(bottom)), slice(int(left), int(right)), share)
