"""How long a calibration takes: printed, not asserted (`pytest tests/benchmarks --benchmark-only`)."""

from __future__ import annotations

import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from bench.calibrate.cameras import PAIR, calibrate_pair
from bench.calibrate.views import find_pictures, find_views, pattern_of, write_picture
from bench.rig.loading import RIGS
from detector.calibration.boards import Board
from instruments.world.boards import poses
from instruments.world.phantom import Phantom
from instruments.world.scene import Renderer
from instruments.world.state import SceneState
from tests.benchmarks.figures import beside_fixed, figure, taken_s

PAIRS = 24
BOARD = Board("chessboard", 9, 6, 40.0)


@pytest.fixture
def two_cores() -> Iterator[None]:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(2)
    yield
    cv2.setNumThreads(threads)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """24 pairs of 1360 x 1024, rendered."""
    folder = tmp_path_factory.mktemp("pictures")
    renderer = Renderer.from_calibration(
        tomllib.loads((RIGS / "calibration.toml").read_text(encoding="utf-8")), 1
    )
    for number, board in enumerate(
        poses(pattern_of(BOARD), renderer.cameras[:2], (500.0, 1200.0), 1, PAIRS)
    ):
        state = SceneState(Phantom(()), (), 20.0, 20.0, boards=(board,))
        for name, camera in (("left", renderer.left), ("right", renderer.right)):
            image = camera.expose(state, None, np.random.default_rng([1, number]))
            write_picture(folder / name / f"{number:02d}.png", image.astype(np.uint8))
    return folder


def test_from_files_to_a_calibration(
    benchmark: BenchmarkFixture, pictures: Path, two_cores: None
) -> None:
    begun_s = time.process_time()
    result = benchmark.pedantic(
        lambda: calibrate_pair(find_views(find_pictures([pictures], PAIR), BOARD)),
        rounds=1,
        iterations=1,
    )
    spent_s = time.process_time() - begun_s
    assert len(result.views.pairs()) >= PAIRS - 2
    beside_fixed(benchmark, f"{PAIRS} pairs of 1360 x 1024", spent_s, "3")
    by_clock_s = taken_s(benchmark, "min")
    figure(benchmark, f"{PAIRS} pairs of 1360 x 1024, s on two cores", by_clock_s, "at most 60")
