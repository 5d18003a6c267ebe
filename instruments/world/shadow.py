"""Soft shadows on the table: where things stand between it and the lamps, or hide the room's light from it.

Worked out on a coarse grid on the table, as lamps are large and shadows soft, then looked up by each pixel. Only the table
receives shadows; hoses lie on it and cast none worth drawing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.world.backdrop import Backdrop
from instruments.world.optics import CameraModel, Floats
from instruments.world.raycast import dot
from instruments.world.shading import Lamp, Lighting, Rows, irradiance
from instruments.world.solids import Ints, Solids

Grey = NDArray[np.float32]

TEXEL_MM = 8.0
REACH_MM = 150.0  # how far around a thing its shadow is looked for
LAMP_RADIUS_MM = 130.0
STANDING_MM = 12.0  # what starts lower than this stands on the table
LEAST_CASTER_MM = 6.0  # thinner things (hoses) cast no shadow


@dataclass(frozen=True, slots=True, eq=False)
class ShadowMap:
    """Share of the table's light that is left, on a grid: ``share[i, j]`` at x = x_mm + j TEXEL_MM, y = y_mm + i TEXEL_MM."""

    x_mm: float
    y_mm: float
    share: Grey

    def high_mm(self) -> Floats:
        """The grid's far corner, (2,) mm."""
        return np.array([self.x_mm, self.y_mm]) + TEXEL_MM * np.array([self.share.shape[1] - 1, self.share.shape[0] - 1])


def shadow_map(lighting: Lighting, solids: Solids) -> ShadowMap | None:
    """The shadows of all ``solids`` (world frame) on the table; None where nothing casts one, or there is no light."""
    casters = np.flatnonzero(np.maximum(solids.radius_a, solids.radius_b) >= LEAST_CASTER_MM)
    if len(casters) == 0 or lighting.brightness <= 0.0:
        return None
    low = np.minimum(solids.a[casters], solids.b[casters]).min(axis=0)[:2] - REACH_MM
    high = np.maximum(solids.a[casters], solids.b[casters]).max(axis=0)[:2] + REACH_MM
    x, y = (np.arange(low[axis], high[axis] + TEXEL_MM, TEXEL_MM, dtype=np.float32) for axis in (0, 1))
    points = np.stack([*(grid.ravel() for grid in np.meshgrid(x, y)), np.zeros(len(x) * len(y), dtype=np.float32)])
    up = np.array([[0.0], [0.0], [1.0]], dtype=np.float32)
    sky = irradiance(Lighting(1.0, (), lighting.ambient), points, up)
    total, lit = sky, sky * _sky_left(solids, casters, points)
    for lamp in lighting.lamps:
        light = irradiance(Lighting(1.0, (lamp,), 0.0), points, up)
        total, lit = total + light, lit + light * _lamp_left(solids, casters, points, lamp)
    share = (lit / np.maximum(total, 1e-9)).reshape(len(y), len(x))
    return ShadowMap(float(low[0]), float(low[1]), share.astype(np.float32))


def _lamp_left(solids: Solids, casters: Ints, points: Rows, lamp: Lamp) -> Rows:
    """Share of a round lamp that each table point (3, n) sees: the gap between its ray and each solid, against the penumbra there."""
    way = np.asarray(lamp.at_mm, dtype=np.float32)[:, None] - points
    far = np.sqrt(dot(way, way))
    way /= far
    left = np.ones_like(far)
    for i in casters:
        a, b = solids.a[i].astype(np.float32), solids.b[i].astype(np.float32)
        gap, along, part = _nearest(points, way, a, b)
        radius = np.float32(solids.radius_a[i]) + part * np.float32(solids.radius_b[i] - solids.radius_a[i])
        half_shade = np.maximum(along, 2.0) * (LAMP_RADIUS_MM / far)
        np.minimum(left, np.clip(0.5 + 0.5 * (gap - radius) / half_shade, 0.0, 1.0), out=left)
    return np.asarray(left)


def _nearest(points: Rows, way: Rows, a: Rows, b: Rows) -> tuple[Rows, Rows, Rows]:
    """Of rays (points, unit way; 3, n) and the segment a b: least distance, how far along the ray, which part of the segment."""
    span = b - a
    off = points - a[:, None]
    cross, d_way, d_span = dot(way, span), dot(off, way), dot(off, span)
    under = np.maximum(dot(span, span) - cross * cross, np.float32(1e-3))
    part = np.clip((d_span - d_way * cross) / under, 0.0, 1.0)
    along = np.maximum(part * cross - d_way, 0.0)
    off += along * way
    off -= part * span[:, None]
    return np.asarray(np.sqrt(dot(off, off))), along, part


def _sky_left(solids: Solids, casters: Ints, points: Rows) -> Rows:
    """Share of the room's light that each table point keeps beside standing things: a post of height h and radius r at
    distance d hides asin(r / d) / pi of the horizon, up to a cosine-weighted h^2 / (h^2 + d^2)."""
    left = np.ones_like(points[0])
    lowest = solids.nearest_depth()
    for i in casters[lowest[casters] < STANDING_MM]:
        height = np.float32(max(solids.a[i, 2], solids.b[i, 2]))
        radius = np.float32(max(solids.radius_a[i], solids.radius_b[i]))
        x, y = solids.a[i, :2].astype(np.float32)
        d2 = np.maximum((points[0] - x) ** 2 + (points[1] - y) ** 2, radius**2)
        left *= 1.0 - np.arcsin(radius / np.sqrt(d2)) / np.float32(np.pi) * height**2 / (height**2 + d2)
    return np.asarray(left)


@dataclass(frozen=True, slots=True, eq=False)
class Shade:
    """What shadows leave of the light in a part of a camera's image: (rows, columns), ``share`` of that shape."""

    rows: slice
    columns: slice
    share: Grey


def shade(shadows: ShadowMap, backdrop: Backdrop, camera: CameraModel, rays: tuple[Floats, Floats]) -> Shade | None:
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
    on_x, on_y = (((at - origin) / TEXEL_MM).astype(np.float32) for at, origin in ((table_x, shadows.x_mm), (table_y, shadows.y_mm)))
    looked_up = cv2.remap(shadows.share, on_x, on_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0)
    share = np.asarray(looked_up, dtype=np.float32)
    share[(table_y > high[1]) | (table_y < low[1]) | (to_z > -1e-6)] = 1.0
    return Shade(slice(int(top), int(bottom)), slice(int(left), int(right)), share)
