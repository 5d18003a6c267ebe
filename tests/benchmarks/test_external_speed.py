"""What a process of its own costs a detector: a question and its answer, a start, and the files
written outside of its time.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from detector.calibration import Calibration, load_calibration
from detector.external import ExternalDetector
from detector.external.serve import Pictures
from tests.benchmarks.figures import figure, taken_s
from tests.detector.children import GOOD, child
from tests.detector.conftest import ROOT


@pytest.fixture(scope="module")
def rig() -> Calibration:
    return load_calibration(ROOT / "bench" / "rigs" / "calibration.toml")


@pytest.fixture(scope="module")
def frames() -> Pictures:
    noise = np.random.default_rng(2)
    left, right, thermal = (
        noise.normal(120, 4, size).astype(np.uint8)
        for size in ((1024, 1360), (1024, 1360), (480, 640))
    )
    return Pictures(left, right, thermal)


@pytest.fixture
def detector(tmp_path: Path) -> Iterator[ExternalDetector]:
    made = child(tmp_path, GOOD)
    yield made
    made.close()


def test_a_question_and_its_answer(
    benchmark: BenchmarkFixture, detector: ExternalDetector, frames: Pictures, rig: Calibration
) -> None:
    def prepared() -> None:
        detector.prepare(frames, rig)

    found = benchmark.pedantic(lambda: detector.detect(frames, rig), setup=prepared, rounds=20)
    assert found.hidden == 1
    figure(
        benchmark,
        "a question and its answer over pipes, ms",
        1e3 * taken_s(benchmark),
        "below 5 ms",
    )


def test_the_pictures_are_written(
    benchmark: BenchmarkFixture, detector: ExternalDetector, frames: Pictures, rig: Calibration
) -> None:
    detector.prepare(frames, rig)
    benchmark.pedantic(lambda: detector.prepare(frames, rig), rounds=10)
    figure(
        benchmark,
        "two optical pictures and a thermal one as PNG, outside of the detector's time, ms",
        1e3 * taken_s(benchmark),
        "none",
    )


def test_a_start(
    benchmark: BenchmarkFixture, tmp_path: Path, frames: Pictures, rig: Calibration
) -> None:
    def whole() -> ExternalDetector:
        made = ExternalDetector(
            "mine", [sys.executable, str(tmp_path / "program.py")], time.perf_counter
        )
        made.prepare(frames, rig)
        made.close()
        return made

    (tmp_path / "program.py").write_text(GOOD, encoding="utf-8")
    made = benchmark.pedantic(whole, rounds=3)
    assert made.start_up_s is not None
    figure(
        benchmark,
        "start of a small Python program with its leash, ms",
        1e3 * made.start_up_s,
        "none",
    )
