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
        towards = np.einsum("i,ihw->hw", patch.normal, ray)
        with np.errstate(divide="ignore", invalid="ignore"):
            deep = np.asarray(patch.normal) @ (corner - camera.centre_mm) / towards
        deep = np.where((deep > 0.0) & (deep < 1e4), deep, 1e4)
        points = camera.centre_mm[:, None, None] + deep * ray
        own = patch.albedo * irradiance(
            lighting, points.reshape(3, -1), np.asarray(patch.normal)[:, None]
        ).reshape(x.shape)
        if patch.texture:
            own = own * (1.0 + patch.texture * texture(patch, points))
        light += share * (own - light)
        depth += share * (deep - depth)
        warmth += share * (patch.warmer_k - warmth)
    return light.astype(np.float32), depth.astype(np.float32), warmth.astype(np.float32)


def texture(patch: Patch, points: NDArray[np.float64]) -> NDArray[np.float32]:
    off, places, sizes = points - np.asarray(patch.corner_mm)[:, None, None], [], []
    for edge in (patch.across_mm, patch.along_mm):
        length = float(np.linalg.norm(edge))
        places.append(np.einsum("i,ihw->hw", np.asarray(edge) / (length * TEXEL_MM), off))
        sizes.append(round(length / TEXEL_MM))
    u, v = (np.clip(place, -9.0, 9999.0).astype(np.float32) for place in places)
    cloth = woven(patch.weave, patch.seed, *sizes)
    found = cv2.remap(cloth, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, np.float32)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("family", "seed"),
    [("ideal", 3), ("anywhere", 11), ("low_contrast", 5), ("hot_body_at_base", 8)],
)
def test_frames_are_those_of_the_long_way(
    family: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = situation(family, seed)
    state = found.state((33.0,) * len(found.phantom.teats), 33.0, 21.0)
    short = renderer().render(state, np.random.default_rng(1))
    monkeypatch.setattr(backdrops, "draw", lambda *given: in_full(*given)[:2])
    full = renderer().render(state, np.random.default_rng(1))
    for name in ("left", "right"):
        off = getattr(short, name).astype(float) - getattr(full, name)
        assert np.abs(off).mean() <= MEAN_GREY, name
        assert abs(off.mean()) <= 0.01, name
        assert np.abs(off).max() <= MOST_GREY, name


@pytest.mark.slow
def test_depth_and_warmth_are_those_of_the_long_way_and_a_poster_off_the_board_shows() -> None:
    whole = situation("anywhere", 11).backdrop
    off = Backdrop(
        posters=(Poster(1000.0, 600.0, 300.0, 300.0, 0.9), Poster(0.0, 100.0, 80.0, 60.0, 0.1)),
        board_k=0.5,
        table_k=-0.4,
    )
    for backdrop in (whole, off):
        for camera in renderer().cameras:
            _, depth, warmth = in_full(backdrop, Lighting(), camera)
            shown = backdrops.draw(backdrop, Lighting(), camera)[1]
            np.testing.assert_allclose(shown, depth, rtol=1e-5, atol=0.05)
            np.testing.assert_allclose(backdrops.warmer(backdrop, camera), warmth, atol=1e-5)
