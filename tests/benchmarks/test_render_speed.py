"""How long the scene takes to draw, on one core: printed, not asserted. `pytest tests/benchmarks
--benchmark-only`.
"""

from __future__ import annotations

import subprocess
import sys
import tomllib
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from bench.rig.scenes import warm
from instruments.world.phantom import PlatePose
from instruments.world.scene import Renderer
from instruments.world.situations import SITUATIONS as FAMILIES
from instruments.world.situations import situation as member
from tests.benchmarks.figures import PEAK_KIB, cpu_s, figure, kernel, taken_s
from tests.situations import SITUATIONS, situation

pytestmark = pytest.mark.usefixtures("one_core")

ROOT = Path(__file__).resolve().parents[2]
CALIBRATION = ROOT / "bench/rigs/calibration.toml"
ELEVEN = tuple(FAMILIES)[:11]
ONE_START = (
    PEAK_KIB
    + """
import sys, time, tomllib
from pathlib import Path
start = time.perf_counter()
import cv2, numpy as np
cv2.setNumThreads(1)
from instruments.world.scene import Renderer
from instruments.world.situations import SITUATIONS, situation
def draw(renderer, found):
    renderer.render(found.state((32.5,) * len(found.phantom.teats), 33.0, 21.0), np.random.default_rng(0))
renderer = Renderer.from_calibration(tomllib.loads(Path(sys.argv[1]).read_text(encoding="utf-8")), 7)
draw(renderer, situation("cooler_bodies", 0))
first_s = time.perf_counter() - start
for name in SITUATIONS:
    draw(renderer, situation(name, 1))
print(first_s, peak_kib() / 1024.0)
"""
)


def make_renderer() -> Renderer:
    return Renderer.from_calibration(
        tomllib.loads(CALIBRATION.read_text(encoding="utf-8")), camera_seed=7
    )


@pytest.mark.parametrize("name", sorted(SITUATIONS))
def test_frame_set_at_a_new_pose(benchmark: BenchmarkFixture, name: str) -> None:
    """Two 1360 x 1024 and one thermal frame, a new pose and fresh noise each time."""
    renderer, poses = make_renderer(), count()
    still = situation(name)
    renderer.render(still, np.random.default_rng(0))

    def draw() -> None:
        i = next(poses)
        renderer.render(
            replace(still, phantom=still.phantom.moved(PlatePose(x_mm=0.37 * (i % 40)))),
            np.random.default_rng(i),
        )

    benchmark.pedantic(draw, rounds=15, warmup_rounds=1)
    figure(benchmark, f"{name}, new pose, median ms", 1e3 * taken_s(benchmark), "at most 30")


def test_frame_set_of_a_new_scene(benchmark: BenchmarkFixture) -> None:
    """Everything new each time: background, light, paint, things, phantom. In CPU seconds, and as
    the ratio to the fixed work between, which is the same on a busy machine and on another.
    """
    renderer = make_renderer()
    renderer.render(warm(member("ideal", 0)), np.random.default_rng(0))
    ratios: dict[str, float] = {}

    def draw() -> None:
        for name in ELEVEN:
            drawn_s: list[float] = []
            fixed_s: list[float] = []
            for state in [warm(member(name, seed)) for seed in range(1, 9)]:
                drawn_s.append(cpu_s(partial(renderer.render, state, np.random.default_rng(0))))
                fixed_s.append(cpu_s(kernel))
            ratios[name] = float(np.median(drawn_s) / np.median(fixed_s))

    benchmark.pedantic(draw, rounds=1)
    for name, ratio in ratios.items():
        figure(benchmark, f"{name}, new scene / fixed work, CPU", ratio, "at most 4")
    mean = float(np.mean([*ratios.values()]))
    figure(benchmark, "all families, new scene / fixed work, CPU", mean, "at most 4")


@pytest.mark.skipif(
    sys.platform == "win32",
    reason="peak memory is asked of the resource module, which Windows hasn't",
)
def test_first_frame_set_and_peak_memory(benchmark: BenchmarkFixture) -> None:
    """A process of its own: from its first import to the first frame set, and its peak."""
    figures: list[list[float]] = []

    def start() -> None:
        said = subprocess.run(
            [sys.executable, "-c", ONE_START, str(CALIBRATION)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
        figures.append([float(word) for word in said.stdout.split()])

    benchmark.pedantic(start, rounds=3)
    first_s, peak_mib = np.median(figures, axis=0)
    figure(
        benchmark, "first frame set after start, imports included, s", float(first_s), "at most 2"
    )
    figure(benchmark, "peak memory, MiB", float(peak_mib), "under 500")
