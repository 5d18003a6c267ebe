"""The bench's own detector beside the thesis's on the same frame
sets, one core: times are printed, not asserted.
"""

from __future__ import annotations

import time
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
from tests.benchmarks.figures import figure

FAMILIES = ("ideal", "overlapping", "hot_body_at_ends", "low_contrast")
SEEDS = 4


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> list[FrameSet]:
    folder = tmp_path_factory.mktemp("recording")
    list(record(load_rig(find_rig(None)), FAMILIES, range(SEEDS), folder, 1))
    recording = Recording(folder)
    return [recording.load(frame) for frame in recording.frames]


def fixed_s(rng: np.random.Generator) -> float:
    """Processor time of a fixed piece of numpy: what a machine is worth at the moment."""
    lines, bases = (rng.random(shape, dtype=np.float32) for shape in ((2000, 21), (21, 68)))
    start = time.process_time()
    for _ in range(20):
        along = lines @ bases
        (along * along).min(axis=1)
        np.sort(lines, axis=0)
    return time.process_time() - start


@pytest.mark.usefixtures("one_core")
@pytest.mark.parametrize("name", ["fused", "thesis"])
def test_detectors_on_sixteen_frame_sets(
    benchmark: BenchmarkFixture, name: str, frames: list[FrameSet]
) -> None:
    detector, calibration = registry.create(name), calibration_of_rig()
    detector.detect(frames[0], calibration)  # the first call loads code and fills caches
    rng, times_ms, fixed_ms = np.random.default_rng(0), list[float](), list[float]()

    def all_frames() -> None:
        for one in frames:
            start = time.process_time()
            detector.detect(one, calibration)
            times_ms.append(1000.0 * (time.process_time() - start))
            fixed_ms.append(1000.0 * fixed_s(rng))

    benchmark.pedantic(all_frames, rounds=3, iterations=1)
    figure(benchmark, f"{name}: median of processor time, ms", float(np.median(times_ms)), "20")
    figure(benchmark, f"{name}: 99th percentile, ms", float(np.percentile(times_ms, 99)), "40")
    ratio = float(np.median(times_ms) / np.median(fixed_ms))
    figure(benchmark, f"{name}: of a fixed piece of numpy", ratio, "as little as can be")


def calibration_of_rig() -> Calibration:
    rig = load_rig(find_rig(None))
    assert Path(rig.calibration_path).is_file()
    return rig.calibration
