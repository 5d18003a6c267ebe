"""The bench's own detector, by numpy and by compiled loops, beside the thesis's on the same frame
sets, one core: times are printed, not asserted.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from bench.record.recording import Recording
from bench.rig.loading import find_rig, load_rig
from bench.rig.scenes import draw, record, rig_renderer, warm
from detector import registry
from detector.calibration import Calibration
from detector.outline import fast
from detector.protocol import Detection
from instruments.camera.frame import FrameSet
from instruments.world.situations import SITUATIONS, situation
from tests.benchmarks.figures import figure

FAMILIES = ("ideal", "overlapping", "hot_body_at_ends", "low_contrast")
SEEDS = 4
MEMBERS, SEED = range(1000, 1018), 7  # of every family: 306 frame sets
PROMISED_MM = 0.01


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> list[FrameSet]:
    folder = tmp_path_factory.mktemp("recording")
    list(record(load_rig(find_rig(None)), FAMILIES, range(SEEDS), folder, 1))
    recording = Recording(folder)
    return [recording.load(frame) for frame in recording.frames]


@pytest.fixture
def one_core() -> Iterator[None]:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(threads)


@pytest.fixture
def kernels(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Which loops run: "numpy" or "numba"."""
    monkeypatch.setenv(fast.VARIABLE, request.param)
    fast.chosen.cache_clear()
    yield request.param
    fast.chosen.cache_clear()


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
@pytest.mark.parametrize(
    ("name", "kernels"),
    [("fused", "numpy"), ("fused", "numba"), ("thesis", "numpy")],
    indirect=["kernels"],
)
def test_detectors_on_sixteen_frame_sets(
    benchmark: BenchmarkFixture, name: str, kernels: str, frames: list[FrameSet]
) -> None:
    detector, calibration = registry.create(name), calibration_of_rig()
    if kernels not in fast.chosen().by:
        pytest.skip(fast.chosen().why)
    detector.detect(frames[0], calibration)  # the first call loads code and fills caches
    rng, times_ms, fixed_ms = np.random.default_rng(0), list[float](), list[float]()

    def all_frames() -> None:
        for one in frames:
            start = time.process_time()
            detector.detect(one, calibration)
            times_ms.append(1000.0 * (time.process_time() - start))
            fixed_ms.append(1000.0 * fixed_s(rng))

    benchmark.pedantic(all_frames, rounds=3, iterations=1)
    who = f"{name} by {kernels}"
    figure(benchmark, f"{who}: median of processor time, ms", float(np.median(times_ms)), "20")
    figure(benchmark, f"{who}: 99th percentile, ms", float(np.percentile(times_ms, 99)), "40")
    ratio = float(np.median(times_ms) / np.median(fixed_ms))
    figure(benchmark, f"{who}: of a fixed piece of numpy", ratio, "as little as can be")


@pytest.mark.usefixtures("one_core")
@pytest.mark.parametrize("kernels", ["numba"], indirect=True)
def test_kernels_find_what_numpy_finds_on_306_frame_sets(
    benchmark: BenchmarkFixture, kernels: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    loops = fast.chosen().loops
    if loops is None:
        pytest.skip(fast.chosen().why)
    rig, calibration = load_rig(find_rig(None)), calibration_of_rig()
    renderer, detector = rig_renderer(rig, SEED), registry.create("fused")
    furthest_mm, teats = [0.0], 0

    def compare() -> None:
        nonlocal teats
        for name in SITUATIONS:
            for member in MEMBERS:
                shot = draw(renderer, name, warm(situation(name, member)), [SEED, member])
                found = list[Detection]()
                for one in (None, loops):
                    monkeypatch.setattr(fast, "compiled", lambda one=one: one)
                    found.append(detector.detect(shot.frames, calibration))
                slow, quick = found
                assert len(slow.teats) == len(quick.teats), f"{name} {member}"
                assert (slow.hidden, slow.reason) == (quick.hidden, quick.reason)
                teats += len(slow.teats)
                pairs = zip(slow.teats, quick.teats, strict=True)
                furthest_mm.extend(float(np.abs(a.world_mm - b.world_mm).max()) for a, b in pairs)
                assert furthest_mm[-1] <= PROMISED_MM, f"{name} {member}"

    benchmark.pedantic(compare, rounds=1, iterations=1)
    figure(
        benchmark, f"numpy and numba, {teats} ends: furthest apart, mm", max(furthest_mm), "0.01"
    )
    assert max(furthest_mm) <= PROMISED_MM


def calibration_of_rig() -> Calibration:
    rig = load_rig(find_rig(None))
    assert Path(rig.calibration_path).is_file()
    return rig.calibration
