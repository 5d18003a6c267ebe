"""Backdrops that another process draws are those that this one would draw."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from instruments.world import backdrop as backdrops
from instruments.world.ahead import DrawnAhead
from instruments.world.optics import CameraModel
from instruments.world.situations import situation
from tests.instruments.world.scenes import renderer

SCENES = [
    (one.backdrop, one.lighting) for one in (situation("overlapping", seed) for seed in range(3))
]


@pytest.fixture
def cameras() -> tuple[CameraModel, ...]:
    return renderer().cameras[:2]


@pytest.fixture
def ahead(cameras: tuple[CameraModel, ...]) -> Iterator[DrawnAhead]:
    drawn = DrawnAhead(cameras, SCENES)
    yield drawn
    drawn.close()


@pytest.mark.slow
def test_the_pictures_are_the_same_bytes(
    ahead: DrawnAhead, cameras: tuple[CameraModel, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = {
        (number, camera.name): backdrops.draw(*SCENES[number], camera)
        for number in (0, 2)
        for camera in cameras
    }
    monkeypatch.delattr(backdrops, "draw")  # the process has its own
    for (number, name), pictures in wanted.items():  # scene 1 is passed over
        camera = next(one for one in cameras if one.name == name)
        for mine, its in zip(pictures, ahead.draw(*SCENES[number], camera), strict=True):
            assert mine.dtype == its.dtype
            assert np.array_equal(mine, its)


def test_a_process_that_died_costs_only_time(
    ahead: DrawnAhead, cameras: tuple[CameraModel, ...]
) -> None:
    ahead.close()
    light, _ = ahead.draw(*SCENES[0], cameras[0])
    assert light.shape == (cameras[0].height_px, cameras[0].width_px)
