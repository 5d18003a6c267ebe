"""The short way of drawing the backdrop against the long one: each pixel's light worked out, and
its place on the weave interpolated without rounding.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from instruments.world import backdrop as backdrops
from instruments.world.backdrop import FAR_MM, TEXEL_MM, Backdrop, Patch, Poster, patches
from instruments.world.boards import woven
from instruments.world.compositing import cover_outlines
from instruments.world.optics import CameraModel
from instruments.world.sensor import Image
from instruments.world.shading import Lighting, irradiance
from instruments.world.situations import situation
from tests.examples import few
from tests.instruments.world.scenes import renderer

MEAN_GREY, MOST_GREY = 0.1, 4.0


def in_full(
    backdrop: Backdrop, lighting: Lighting, camera: CameraModel
) -> tuple[Image, Image, Image]:
    """Light, depth and warmth of all pixels, (height, width) each."""
    x, y = camera.rays()
    ray = np.einsum("ij,jhw->ihw", camera.R.T, np.stack([x, y, np.ones_like(x)]))
    light = np.full(x.shape, backdrop.room_albedo * lighting.ambient * lighting.brightness)
    depth, warmth = np.full(x.shape, FAR_MM), np.zeros(x.shape)
    for patch in patches(backdrop):
        corner, across, along = (np.asarray(p) for p in patch.place[:3])
        square = np.array([corner, corner + across, corner + across + along, corner + along])
        seen = cover_outlines([camera.camera_from_world(square)], camera)
        share = np.zeros(x.shape)
        share[seen.row, seen.column] = seen.share
        towards = np.einsum("i,ihw->hw", patch.place.normal, ray)
        with np.errstate(divide="ignore", invalid="ignore"):
            deep = np.asarray(patch.place.normal) @ (corner - camera.centre_mm) / towards
        deep = np.where((deep > 0.0) & (deep < 1e4), deep, 1e4)
        points = camera.centre_mm[:, None, None] + deep * ray
        own = patch.albedo * irradiance(
            lighting, points.reshape(3, -1), np.asarray(patch.place.normal)[:, None]
        ).reshape(x.shape)
        if patch.texture:
            own = own * (1.0 + patch.texture * texture(patch, points))
        light += share * (own - light)
        depth += share * (deep - depth)
        warmth += share * (patch.warmer_k - warmth)
    return light.astype(np.float32), depth.astype(np.float32), warmth.astype(np.float32)


def texture(patch: Patch, points: NDArray[np.float64]) -> NDArray[np.float32]:
    off, places, sizes = points - np.asarray(patch.place.corner_mm)[:, None, None], [], []
    for edge in (patch.place.across_mm, patch.place.along_mm):
        length = float(np.linalg.norm(edge))
        places.append(np.einsum("i,ihw->hw", np.asarray(edge) / (length * TEXEL_MM), off))
        sizes.append(round(length / TEXEL_MM))
    u, v = (np.clip(place, -9.0, 9999.0).astype(np.float32) for place in places)
    cloth = woven(patch.weave, patch.seed, *sizes)
    found = cv2.remap(cloth, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, np.float32)


OFF = Backdrop(  # a poster that reaches off the board, and one on it
    posters=(Poster(1000.0, 600.0, 300.0, 300.0, 0.9), Poster(0.0, 100.0, 80.0, 60.0, 0.1)),
    board_k=0.5,
    table_k=-0.4,
)
SCENES = [situation("anywhere", 11)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("backdrop", "lighting"),
    few([(OFF, Lighting()), *((scene.backdrop, scene.lighting) for scene in SCENES)], 2),
    ids=["poster off the board", *(scene.name for scene in SCENES)],
)
def test_light_depth_and_warmth_are_those_of_the_long_way(
    backdrop: Backdrop, lighting: Lighting
) -> None:
    for camera in renderer().cameras[1:]:
        light, depth, warmth = in_full(backdrop, lighting, camera)
        shown, deep, _ = backdrops.draw(backdrop, lighting, camera)
        off_dn = 255.0 * (shown.astype(float) - light)
        assert np.abs(off_dn).mean() <= MEAN_GREY
        assert abs(off_dn.mean()) <= 0.01
        assert np.abs(off_dn).max() <= MOST_GREY
        np.testing.assert_allclose(deep, depth, rtol=1e-5, atol=0.05)
        np.testing.assert_allclose(backdrops.warmer(backdrop, camera), warmth, atol=1e-5)
