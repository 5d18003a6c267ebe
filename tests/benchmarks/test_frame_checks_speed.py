"""What looking at a frame set costs, beside the time that drawing or taking one takes."""

from __future__ import annotations

from itertools import cycle

from pytest_benchmark.fixture import BenchmarkFixture

from bench.rig.frame_capture import FrameChecks
from bench.rig.loading import find_rig, load_rig
from instruments.camera.emulator import EmulatedCameras
from tests.benchmarks.figures import figure, taken_s
from tests.instruments.camera.small_world import GalleryWorld


def test_looking_at_a_frame_set(benchmark: BenchmarkFixture) -> None:
    rig = load_rig(find_rig(None))
    looks = FrameChecks(rig.rig.cameras.checks, rig.rig.cameras.max_skew_s, rig.calibration)
    cameras = EmulatedCameras(GalleryWorld())
    frames = cycle([cameras.capture() for _ in range(5)])
    noticed = benchmark.pedantic(lambda: looks.notice(next(frames)), rounds=20, warmup_rounds=2)
    assert noticed == []
    looks_ms = 1000.0 * taken_s(benchmark)
    figure(benchmark, "all looks at a frame set, ms", looks_ms, "at most 60, as drawing one")
