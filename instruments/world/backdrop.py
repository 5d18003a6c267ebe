"""What never moves: the table, its front, the board behind, the dark room. Drawn once a camera and kept.

Each is a flat patch with a texture that is fixed to it, so both cameras see the same texture where they should.
May not know of the phantom, or of anything that stands on the table.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.world.coverage import Cover, cover_outlines
from instruments.world.optics import CameraModel, Floats
from instruments.world.shading import Lighting, irradiance
from instruments.world.solids import Ints, Point

TEXEL_MM = 2.0


@dataclass(frozen=True, slots=True)
class Backdrop:
    """Table at z = 0 with its front edge, and an upright board behind; world frame, mm.

    ``…_texture`` is the share that an albedo varies by.
    """

    board_albedo: float = 0.55
    board_texture: float = 0.08
    table_albedo: float = 0.50
    table_texture: float = 0.12
    front_albedo: float = 0.10
    room_albedo: float = 0.05
    texture_seed: int = 0
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
    texture: float
    seed: int


def patches(backdrop: Backdrop) -> tuple[Patch, ...]:
    """Far to near: board, table, the table's front."""
    b = backdrop
    wide = b.board_x_mm[1] - b.board_x_mm[0]
    reach, deep = 2.0 * b.table_reach_mm, b.board_y_mm - b.table_front_y_mm
    edge = (-b.table_reach_mm - 190.0, b.table_front_y_mm, 0.0)
    return (
        Patch(
            (b.board_x_mm[0], b.board_y_mm, 0.0), (wide, 0.0, 0.0), (0.0, 0.0, b.board_top_mm),
            (0.0, -1.0, 0.0), b.board_albedo, b.board_texture, 2 * b.texture_seed,
        ),
        Patch(edge, (reach, 0.0, 0.0), (0.0, deep, 0.0), (0.0, 0.0, 1.0), b.table_albedo, b.table_texture, 2 * b.texture_seed + 1),
        Patch(edge, (reach, 0.0, 0.0), (0.0, 0.0, -b.table_drop_mm), (0.0, -1.0, 0.0), b.front_albedo, 0.0, 0),
    )  # fmt: skip


def draw(backdrop: Backdrop, lighting: Lighting, camera: CameraModel, rays: tuple[Floats, Floats]) -> NDArray[np.float32]:
    """Light from the backdrop at each pixel, (height, width), before the lens and the sensor; edges by exact coverage."""
    image = np.full(camera.height_px * camera.width_px, backdrop.room_albedo * lighting.ambient * lighting.brightness)
    for patch in patches(backdrop):
        seen = _outline(patch, camera)
        pixel = seen.row * camera.width_px + seen.column
        light = _light(patch, lighting, camera, rays, pixel)
        image[pixel] += seen.share * (light - image[pixel])
    return image.reshape(camera.height_px, camera.width_px).astype(np.float32)


def _outline(patch: Patch, camera: CameraModel) -> Cover:
    corner, across, along = np.asarray(patch.corner_mm), np.asarray(patch.across_mm), np.asarray(patch.along_mm)
    square = np.array([corner, corner + across, corner + across + along, corner + along])
    return cover_outlines([camera.camera_from_world(square)], camera)


def _light(patch: Patch, lighting: Lighting, camera: CameraModel, rays: tuple[Floats, Floats], pixel: Ints) -> Floats:
    ray = camera.R.T @ np.stack([rays[0].reshape(-1)[pixel], rays[1].reshape(-1)[pixel], np.ones(len(pixel))])
    normal, corner = np.asarray(patch.normal), np.asarray(patch.corner_mm)
    eye = camera.centre_mm
    towards = normal @ ray
    # A pixel on the patch's edge may look past it, and past the horizon: its light is that of a far point.
    depth = np.clip((corner - eye) @ normal / np.where(np.abs(towards) > 1e-6, towards, -1e-6), 0.0, 1e4)
    points = eye[:, None] + depth * ray
    albedo = patch.albedo * (1.0 + patch.texture * _texture(patch, points)) if patch.texture > 0.0 else patch.albedo
    return np.asarray(irradiance(lighting, points, normal[:, None]) * albedo)


def _texture(patch: Patch, points_mm: Floats) -> NDArray[np.float32]:
    """A cloudy grain fixed to the patch, about -1 to 1, at surface points (3, n)."""
    size = [float(np.linalg.norm(edge)) for edge in (patch.across_mm, patch.along_mm)]
    off = points_mm - np.asarray(patch.corner_mm)[:, None]
    where = [np.asarray(edge) @ off / (length * TEXEL_MM) for edge, length in zip((patch.across_mm, patch.along_mm), size, strict=True)]
    cloth = _cloth(patch.seed, round(size[0] / TEXEL_MM), round(size[1] / TEXEL_MM))
    u, v = (np.ascontiguousarray(w, dtype=np.float32) for w in where)
    values = [
        cv2.remap(cloth, u[i : i + 30000, None], v[i : i + 30000, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for i in range(0, len(u), 30000)  # remap takes at most 32767 rows
    ]
    return np.asarray(np.concatenate([np.zeros((0, 1)), *values]).reshape(-1), dtype=np.float32)


def _cloth(seed: int, width: int, height: int) -> NDArray[np.float32]:
    """Random lattices of several sizes, blown up smoothly and added."""
    rng = np.random.Generator(np.random.PCG64(seed))
    cloth = np.zeros((height, width), dtype=np.float32)
    for cell, weight in ((120, 0.5), (40, 0.3), (12, 0.2), (3, 0.15), (1, 0.12)):
        lattice = rng.standard_normal((height // cell + 2, width // cell + 2), dtype=np.float32)
        cloth += np.float32(weight) * cv2.resize(lattice, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(cloth, -1.5, 1.5), dtype=np.float32)
