"""What a process of its own costs a detector: a question and its answer."""

from __future__ import annotations

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
