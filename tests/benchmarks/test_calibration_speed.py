"""How long a calibration takes, and triangulation beside OpenCV's: printed, not asserted (`pytest
tests/benchmarks --benchmark-only`).
"""

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
from detector.calibration import Calibration, load_calibration
from detector.calibration.boards import Board
from detector.geometry import Array, Camera, triangulate
from instruments.world.boards import poses
from instruments.world.phantom import Phantom
from instruments.world.scene import Renderer
from instruments.world.state import SceneState
from tests.benchmarks.figures import beside_fixed, figure, taken_s

PAIRS, POINTS = 24, 1_000_000
BOARD = Board("chessboard", 9, 6, 40.0)


@pytest.fixture(scope="module")
def rig() -> Calibration:
    return load_calibration(RIGS / "calibration.toml")


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


def test_a_million_points_beside_opencv(benchmark: BenchmarkFixture, rig: Calibration) -> None:
    """OpenCV triangulates undistorted points only: beside its own time stands that with
    cv2.undistortPoints, which does the same work.
    """
    rng = np.random.default_rng(1)
    in_right = rng.uniform((-200, -150, 900), (200, 150, 1300), (POINTS, 3))
    left_px = rig.left.project(rig.right_from_left.inverse().apply(in_right))
    right_px = rig.right.project(in_right)

    points = benchmark.pedantic(
        lambda: triangulate(left_px, right_px, rig.left, rig.right, rig.right_from_left)[0],
        rounds=3,
        warmup_rounds=1,
    )
    figure(benchmark, "a million points, s", taken_s(benchmark, "min"), "at most 1")
    begun_s = time.perf_counter()
    cameras = ((rig.left, left_px), (rig.right, right_px))
    theirs = _by_opencv(rig, *[_undistorted(camera, pixels) for camera, pixels in cameras])
    theirs_s = time.perf_counter() - begun_s
    figure(benchmark, "a million points, s by OpenCV", theirs_s, "for comparison")
    assert np.abs(points - theirs).max() < 1e-3


def _undistorted(camera: Camera, pixels_px: Array) -> Array:
    K = np.array(
        [[camera.fc[0], 0.0, camera.cc[0]], [0.0, camera.fc[1], camera.cc[1]], [0.0, 0.0, 1.0]]
    )
    return np.asarray(
        cv2.undistortPoints(pixels_px.reshape(-1, 1, 2), K, np.array(camera.kc)).reshape(-1, 2).T,
        dtype=np.float64,
    )


def _by_opencv(rig: Calibration, left: Array, right: Array) -> Array:
    left_from_right = rig.right_from_left.inverse()
    P_left = np.column_stack([left_from_right.R, left_from_right.T])
    found = cv2.triangulatePoints(P_left, np.eye(3, 4), left, right)
    return np.asarray((found[:3] / found[3]).T, dtype=np.float64)
