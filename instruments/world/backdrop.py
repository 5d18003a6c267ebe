"""What never moves: the table, its front, the board behind with what hangs on it, the dark room. Drawn once a camera and kept.

Each is a flat patch with a texture that is fixed to it, so both cameras see the same texture where they should.
May not know of the phantom, or of anything that stands on the table.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.world.coverage import Cover, cover_outlines
from instruments.world.noise import Image
from instruments.world.optics import CameraModel, Floats
from instruments.world.shading import Lighting, irradiance
from instruments.world.solids import Ints, Point
from instruments.world.texture import Weave, woven

TEXEL_MM = 2.0
PIXELS_AT_ONCE = 16384  # what is worked out on the way stays in the processor's cache; OpenCV's remap takes at most 32767 rows
FAR_MM = 2400.0  # the room's walls


@dataclass(frozen=True, slots=True)
class Poster:
    """A rectangle on the board: ``x_mm``, ``z_mm`` of its lower left corner, its size, and its albedo."""

    x_mm: float
    z_mm: float
    width_mm: float
    height_mm: float
    albedo: float

    def __post_init__(self) -> None:
        if not (self.width_mm > 0.0 and self.height_mm > 0.0 and 0.0 <= self.albedo <= 1.0):
            raise ValueError(f"a poster needs a size above zero and an albedo from 0 to 1, is {self}")


@dataclass(frozen=True, slots=True)
class Backdrop:
    """Table at z = 0 with its front edge, and an upright board behind; world frame, mm.

    ``…_texture`` is the share that an albedo varies by, ``…_weave`` how. ``posters`` hang on the board, later ones over earlier ones.
    ``board_k``, ``table_k``: how much warmer than the room they are.
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
        for name in ("board_albedo", "board_texture", "table_albedo", "table_texture", "front_albedo", "room_albedo"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be from 0 to 1, is {getattr(self, name)}")
        if not (self.board_y_mm > self.table_front_y_mm and self.board_x_mm[1] > self.board_x_mm[0] and self.board_top_mm > 0.0):
            raise ValueError(f"the board must stand behind the table's front edge and have a size, is {self}")


@dataclass(frozen=True, slots=True)
class Patch:
    """A rectangle: one corner and the two edges from it, mm; across x along gives the side that is seen."""

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
    b = backdrop
    wide = b.board_x_mm[1] - b.board_x_mm[0]
    reach, deep = 2.0 * b.table_reach_mm, b.board_y_mm - b.table_front_y_mm
    edge = (-b.table_reach_mm - 190.0, b.table_front_y_mm, 0.0)
    back, up, seed = (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), 2 * b.texture_seed
    corner = (b.board_x_mm[0], b.board_y_mm, 0.0)
    posters = (
        Patch((p.x_mm, b.board_y_mm, p.z_mm), (p.width_mm, 0.0, 0.0), (0.0, 0.0, p.height_mm), back, p.albedo, warmer_k=b.board_k)
        for p in b.posters
    )
    return (
        Patch(corner, (wide, 0.0, 0.0), (0.0, 0.0, b.board_top_mm), back, b.board_albedo, b.board_texture, b.board_weave, seed, b.board_k),
        *posters,
        Patch(edge, (reach, 0.0, 0.0), (0.0, deep, 0.0), up, b.table_albedo, b.table_texture, b.table_weave, seed + 1, b.table_k),
        Patch(edge, (reach, 0.0, 0.0), (0.0, 0.0, -b.table_drop_mm), back, b.front_albedo, warmer_k=b.table_k),
    )


def draw(backdrop: Backdrop, lighting: Lighting, camera: CameraModel, rays: tuple[Floats, Floats]) -> tuple[Image, Image]:
    """Light from the backdrop at each pixel before the lens and the sensor, and its depth in mm: two arrays (height, width).

    Edges by exact coverage.
    """
    image = np.full(camera.height_px * camera.width_px, backdrop.room_albedo * lighting.ambient * lighting.brightness, dtype=np.float32)
    depth = np.full_like(image, FAR_MM)
    for patch in patches(backdrop):
        seen = _outline(patch, camera)
        for start in range(0, len(seen.share), PIXELS_AT_ONCE):
            part = slice(start, start + PIXELS_AT_ONCE)
            pixel, share = seen.row[part] * camera.width_px + seen.column[part], seen.share[part].astype(np.float32)
            light, far = _light(patch, lighting, camera, rays, pixel)
            image[pixel] += share * (light - image[pixel])
            depth[pixel] += share * (far - depth[pixel])
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
    corner, across, along = np.asarray(patch.corner_mm), np.asarray(patch.across_mm), np.asarray(patch.along_mm)
    square = np.array([corner, corner + across, corner + across + along, corner + along])
    return cover_outlines([camera.camera_from_world(square)], camera)


def _light(patch: Patch, lighting: Lighting, camera: CameraModel, rays: tuple[Floats, Floats], pixel: Ints) -> tuple[Image, Image]:
    """Light from a patch at these pixels (n,), and its depth there."""
    x, y = (ray.reshape(-1)[pixel].astype(np.float32) for ray in rays)
    turn, eye = camera.R.astype(np.float32), camera.centre_mm.astype(np.float32)
    ray = np.stack([turn[0, i] * x + turn[1, i] * y + turn[2, i] for i in range(3)])
    normal, corner = np.asarray(patch.normal, dtype=np.float32), np.asarray(patch.corner_mm, dtype=np.float32)
    towards = normal @ ray
    # A pixel on the patch's edge may look past it, and past the horizon: its light is that of a far point.
    depth = np.clip(normal @ (corner - eye) / np.where(np.abs(towards) > 1e-6, towards, np.float32(-1e-6)), 0.0, 1e4).astype(np.float32)
    points = eye[:, None] + depth * ray
    light = irradiance(lighting, points, normal[:, None]) * np.float32(patch.albedo)
    if patch.texture > 0.0:
        light *= 1.0 + np.float32(patch.texture) * _texture(patch, points)
    return light.astype(np.float32, copy=False), depth


def _texture(patch: Patch, points_mm: NDArray[np.float32]) -> Image:
    """The weave fixed to the patch, about -1 to 1, at surface points (3, n)."""
    size = [float(np.linalg.norm(edge)) for edge in (patch.across_mm, patch.along_mm)]
    off = points_mm - np.asarray(patch.corner_mm, dtype=np.float32)[:, None]
    edges = [
        np.asarray(edge, dtype=np.float32) / np.float32(length * TEXEL_MM)
        for edge, length in zip((patch.across_mm, patch.along_mm), size, strict=True)
    ]
    u, v = (edge @ off for edge in edges)
    cloth = woven(patch.weave, patch.seed, round(size[0] / TEXEL_MM), round(size[1] / TEXEL_MM))
    values = cv2.remap(cloth, u[:, None], v[:, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values.reshape(-1), dtype=np.float32)
