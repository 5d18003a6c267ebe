"""Which teat ends a camera can see: rays to points of each end, against every other solid and
board. No picture is used, so the truth doesn't depend on a camera's resolution.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from instruments.world.boards import Board
from instruments.world.optics import CameraModel, Floats
from instruments.world.phantom import Phantom
from instruments.world.solids import Bools, Solids, meet

RINGS_DEG = (30.0, 60.0, 85.0)
ROUND = 16


def seen_share(
    phantom: Phantom, solids: Solids, camera: CameraModel, boards: Sequence[Board] = ()
) -> Floats:
    """Visible share of each rounded end's near side, (n,); 0 where the apex is hidden or outside.
    ``solids`` (world frame) begin with the teats; a teat doesn't hide its own end.
    """
    ends = phantom.ends_mm
    shares = np.zeros(len(ends))
    inside = _in_image(camera.project(ends), camera)
    seen = solids.in_camera(camera)
    for i, (end, axis) in enumerate(zip(ends, phantom.axes, strict=True)):
        points = np.concatenate(
            [end[None, :], _near_side(end, axis, phantom.teats[i].shape.radius_mm, camera)]
        )
        free = _free(points, seen, i, camera) & _past_boards(points, boards, camera)
        shares[i] = float(free[1:].mean()) if inside[i] and free[0] else 0.0
    return shares


def _in_image(pixels: Floats, camera: CameraModel) -> Bools:
    size = np.array([camera.width_px, camera.height_px])
    return np.asarray(np.all((pixels >= -0.5) & (pixels <= size - 0.5), axis=1))


def _near_side(end_mm: Floats, axis: Floats, radius_mm: float, camera: CameraModel) -> Floats:
    """Points of the hemisphere that face the camera, (n, 3)."""
    middle = end_mm - radius_mm * axis
    u = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.7 else [0.0, 1.0, 0.0])
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    polar, round_ = np.meshgrid(np.radians(RINGS_DEG), np.arange(ROUND) * 2.0 * np.pi / ROUND)
    across = np.cos(round_.ravel())[:, None] * u + np.sin(round_.ravel())[:, None] * v
    outward = np.cos(polar.ravel())[:, None] * axis + np.sin(polar.ravel())[:, None] * across
    towards = camera.centre_mm - middle
    return np.asarray(middle + radius_mm * outward[outward @ towards > 0.0])


def _free(points_mm: Floats, solids: Solids, itself: int, camera: CameraModel) -> Bools:
    """Whether only solid ``itself`` stands between the camera and each point (n, 3)."""
    seen = camera.camera_from_world(points_mm)
    count = len(solids)
    which = np.tile(np.arange(count), len(seen))
    point = np.repeat(seen, count, axis=0)
    depth, _, hit = meet(solids, which, point[:, 0] / point[:, 2], point[:, 1] / point[:, 2])
    blocks = hit & (depth > 0.0) & (depth < point[:, 2])
    return np.asarray(~(blocks & (which != itself)).reshape(len(seen), count).any(axis=1))


def _past_boards(points_mm: Floats, boards: Sequence[Board], camera: CameraModel) -> Bools:
    """Whether no board stands between the camera and each point (n, 3)."""
    free = np.ones(len(points_mm), dtype=np.bool_)
    away = points_mm - camera.centre_mm
    for board in boards:
        towards = away @ board.normal
        part = ((np.asarray(board.corner_mm) - camera.centre_mm) @ board.normal) / np.where(
            np.abs(towards) > 1e-9, towards, 1e-9
        )
        met = camera.centre_mm + part[:, None] * away - np.asarray(board.corner_mm)
        u, v = met @ np.asarray(board.across), met @ np.asarray(board.along)
        width, height = board.pattern.size_mm
        free &= ~(
            (part > 0.0) & (part < 1.0) & (u >= 0.0) & (u <= width) & (v >= 0.0) & (v <= height)
        )
    return free
