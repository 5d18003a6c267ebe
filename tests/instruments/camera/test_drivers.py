"""Camera drivers: emulated ones on a small world, OpenCV's on a video file that the test writes."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from instruments.camera.emulator import EmulatedCameras
from instruments.camera.opencv import OpenCvCameras
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, LinkError
from instruments.world.scene import Renderer, SceneState
from tests.situations import situation

ROOT = Path(__file__).resolve().parents[3]


@cache
def renderer() -> Renderer:
    table = tomllib.loads((ROOT / "bench/rigs/calibration.toml").read_text(encoding="utf-8"))
    return Renderer.from_calibration(table, camera_seed=7)


@dataclass
class SmallWorld:
    """A world where nothing happens but what the test changes."""

    state: SceneState = field(default_factory=lambda: situation("spurious_teat"))
    clock: VirtualClock = field(default_factory=VirtualClock)

    @property
    def renderer(self) -> Renderer:
        return renderer()

    def scene(self) -> SceneState:
        return self.state

    def frame_rng(self, kind: str, index: int) -> np.random.Generator:
        return np.random.default_rng([3, *kind.encode(), index])


def test_emulated_cameras_see_the_world_as_it_is() -> None:
    world = SmallWorld()
    cameras = EmulatedCameras(world)
    warm = cameras.capture()
    world.state = replace(world.state, teat_temps_c=(21.0,) * 4, hose_temp_c=21.0)
    world.clock.sleep(12.5)
    cold = cameras.capture()
    assert warm.thermal_k is not None
    assert cold.thermal_k is not None
    assert warm.thermal_k.max() - cold.thermal_k.max() > 8.0
    assert dict(warm.exposed_s) == {"left": 0.0, "right": 0.0, "thermal": 0.0}
    assert cold.exposed_s["thermal"] == 12.5
    assert warm.identity["left"] == "emulated 1360 x 1024"
    cameras.close()


def test_emulated_frames_are_fresh_and_repeatable() -> None:
    one, two = EmulatedCameras(SmallWorld()), EmulatedCameras(SmallWorld())
    first, second = one.capture(), one.capture()
    assert not np.array_equal(first.left, second.left)
    assert np.array_equal(first.left, two.capture().left)
    assert np.array_equal(second.right, two.capture().right)


def video(path: Path, level: int, frames: int = 3) -> str:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    assert writer.isOpened()
    for i in range(frames):
        writer.write(np.full((48, 64, 3), level + 10 * i, dtype=np.uint8))
    writer.release()
    return str(path)


def test_opencv_plays_a_recorded_video_to_its_end(tmp_path: Path) -> None:
    clock = VirtualClock()
    clock.sleep(3.0)
    cameras = OpenCvCameras({"left": video(tmp_path / "left.avi", 40), "right": video(tmp_path / "right.avi", 120)}, clock)
    assert "64 x 48" in cameras.identity["left"]
    for i in range(3):
        frames = cameras.capture()
        assert frames.left.shape == (48, 64)
        assert frames.left.mean() == pytest.approx(40 + 10 * i, abs=3)
        assert frames.right.mean() == pytest.approx(120 + 10 * i, abs=3)
        assert frames.thermal is None
        assert frames.exposed_s == {"left": 3.0, "right": 3.0}
    with pytest.raises(LinkError, match=r"left camera at .*left\.avi: gave no frame"):
        cameras.capture()
    cameras.close()
    cameras.close()


def test_opencv_says_which_camera_does_not_open(tmp_path: Path) -> None:
    sources = {"left": video(tmp_path / "left.avi", 40), "right": str(tmp_path / "nothing.avi")}
    with pytest.raises(LinkError, match=r"right camera at .*nothing\.avi: can't be opened"):
        OpenCvCameras(sources, VirtualClock())


@pytest.mark.parametrize("names", [("left",), ("left", "right", "middle"), ()])
def test_opencv_needs_left_and_right(names: tuple[str, ...]) -> None:
    with pytest.raises(DeviceError, match="needs sources for left, right"):
        OpenCvCameras(dict.fromkeys(names, 0), VirtualClock())
