"""How long the scene takes to draw, on one core: printed, not asserted. `pytest tests/benchmarks --benchmark-only`."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from instruments.world.phantom import PlatePose
from instruments.world.scene import Renderer, SceneState
from tests.situations import SITUATIONS, situation

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def one_core() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(before)


def make_renderer() -> Renderer:
    table = tomllib.loads((ROOT / "bench/rigs/calibration.toml").read_text(encoding="utf-8"))
    return Renderer.from_calibration(table, camera_seed=7)


def _time(benchmark: BenchmarkFixture, work: Callable[[], object], rounds: int) -> None:
    benchmark.pedantic(work, rounds=rounds, warmup_rounds=1)


@pytest.mark.parametrize("name", sorted(SITUATIONS))
def test_frame_set(benchmark: BenchmarkFixture, name: str) -> None:
    """Two 1360 x 1024 and one thermal frame, a new pose of the phantom and fresh noise each time."""
    renderer, poses = make_renderer(), count()
    still = situation(name)
    renderer.render(still, np.random.default_rng(0))

    def draw() -> None:
        i = next(poses)
        phantom = still.phantom.moved(PlatePose(x_mm=0.37 * (i % 40)))
        state = SceneState(phantom, still.teat_temps_c, still.hose_temp_c, still.ambient_c, still.objects)
        renderer.render(state, np.random.default_rng(i))

    _time(benchmark, draw, 15)


def test_first_frame_set_after_start(benchmark: BenchmarkFixture) -> None:
    """Cameras' rays, fixed patterns and backdrop included."""
    _time(benchmark, lambda: make_renderer().render(situation("non_vertical"), np.random.default_rng(0)), 3)


def test_visibility_of_the_ends(benchmark: BenchmarkFixture) -> None:
    renderer, state = make_renderer(), situation("cooler_bodies")
    _time(benchmark, lambda: renderer.visible_ends(state), 10)
