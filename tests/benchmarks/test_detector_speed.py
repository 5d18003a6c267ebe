"""The bench's own detector beside the thesis's on the same frame
sets, one core: times are printed, not asserted.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from bench.record.recording import Recording
from bench.rig.loading import find_rig, load_rig
from bench.rig.scenes import record_scenes as record
from detector import registry
from detector.calibration import Calibration
from instruments.camera.frame import FrameSet
from tests.benchmarks.figures import cpu_s, figure, kernel

FAMILIES = ("ideal", "overlapping", "hot_body_at_ends", "low_contrast")
SEEDS = 4


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> list[FrameSet]:
    folder = tmp_path_factory.mktemp("recording")
    list(record(load_rig(find_rig(None)), FAMILIES, range(SEEDS), folder, 1))
    recording = Recording(folder)
    return [recording.load(frame) for frame in recording.frames]


@pytest.mark.usefixtures("one_core")
@pytest.mark.parametrize("name", ["fused", "thesis"])
def test_detectors_on_sixteen_frame_sets(
    benchmark: BenchmarkFixture, name: str, frames: list[FrameSet]
) -> None:
    detector, calibration = registry.create(name), calibration_of_rig()
    detector.detect(frames[0], calibration)  # the first call loads code and fills caches
    times_ms, fixed_ms = list[float](), list[float]()

    def all_frames() -> None:
        for one in frames:
            times_ms.append(1000.0 * cpu_s(partial(detector.detect, one, calibration)))
            fixed_ms.append(1000.0 * cpu_s(kernel))

    benchmark.pedantic(all_frames, rounds=3, iterations=1)
    figure(benchmark, f"{name}: median of processor time, ms", float(np.median(times_ms)), "20")
    figure(benchmark, f"{name}: 99th percentile, ms", float(np.percentile(times_ms, 99)), "40")
    ratio = float(np.median(times_ms) / np.median(fixed_ms))
    figure(benchmark, f"{name} / fixed work, CPU", ratio, "as little as can be")


def calibration_of_rig() -> Calibration:
    rig = load_rig(find_rig(None))
    assert Path(rig.calibration_path).is_file()
    return rig.calibration
