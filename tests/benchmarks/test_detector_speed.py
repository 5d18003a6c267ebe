"""How long the thesis's detector and the triangulation take: printed, not asserted. Run with
`pytest tests/benchmarks --benchmark-only`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.calibration import Calibration, load_calibration
from detector.geometry import triangulate
from detector.thesis.detector import ThesisDetector


@dataclass(frozen=True)
class Drawn:
    """A frame set drawn for the clock: dark round-ended strokes before a grainy bright ground."""

    left: NDArray[Any]
    right: NDArray[Any]
    thermal: NDArray[Any] | None
    thermal_k: NDArray[Any] | None = None


@pytest.fixture(scope="module")
def rig() -> Calibration:
    return load_calibration(
        Path(__file__).resolve().parents[2] / "bench" / "rigs" / "calibration.toml"
    )


@pytest.fixture
def one_core() -> Iterator[None]:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(threads)


@pytest.fixture(scope="module")
def frames(rig: Calibration) -> Drawn:
    assert rig.thermal.lens is not None
    assert rig.thermal_from_right is not None
    teats_mm = np.array(
        [
            [-255.0, 275.0, 132.0],
            [-205.0, 200.0, 137.0],
            [-140.0, 205.0, 136.0],
            [-80.0, 270.0, 134.0],
        ]
    )
    thermal_px = rig.thermal.lens.project(
        rig.thermal_from_right.apply(rig.world_from_right.inverse().apply(teats_mm))
    )
    left_px, right_px = rig.project(teats_mm)
    thermal = strokes((640, 480), thermal_px, 21)
    left, right = (
        strokes(rig.left.image_size, left_px, 13),
        strokes(rig.right.image_size, right_px, 13),
    )
    return Drawn(left, right, np.ascontiguousarray(thermal[:, ::-1]))


def strokes(size: tuple[int, int], ends_px: NDArray[np.float64], radius: int) -> NDArray[np.uint8]:
    picture = np.random.default_rng(1).normal(205, 6, (size[1], size[0]))
    for x, y in ends_px:
        top = (round(x), round(y) + radius)
        cv2.line(picture, top, (top[0], top[1] + 9 * radius), (20.0,), thickness=2 * radius)
    return np.clip(picture, 0, 255).astype(np.uint8)


@pytest.mark.usefixtures("one_core")
def test_thesis_detector_on_one_frame_set(
    benchmark: Callable[..., Any], frames: Drawn, rig: Calibration
) -> None:
    found = benchmark(ThesisDetector().detect, frames, rig)
    assert len(found.teats) == 4


def test_triangulation_of_100_000_pairs(benchmark: Callable[..., Any], rig: Calibration) -> None:
    points = np.random.default_rng(2).uniform([-200, -150, 1000], [150, 100, 1200], (100_000, 3))
    left_px, right_px = (
        rig.left.project(rig.right_from_left.inverse().apply(points)),
        rig.right.project(points),
    )
    found, _ = benchmark(triangulate, left_px, right_px, rig.left, rig.right, rig.right_from_left)
    assert np.abs(found - points).max() < 1e-6
