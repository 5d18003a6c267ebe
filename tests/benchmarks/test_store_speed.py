"""What the record costs: events, steps in a long run, frames; beside bluesky's count plan where that is installed."""

from __future__ import annotations

import importlib
import importlib.util
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from bench.store import FinishedTrial, Store
from instruments.clock import stopwatch_s, wall_time
from tests.bench.test_store import facts
from tests.benchmarks.figures import figure

EVENTS, A_STEP = 3000, 50
LONG = 100_000
FRAMES, A_TRIAL = 96, 4


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    made = Store.create(tmp_path / "run", {})
    facts(made)
    yield made
    made.close()


def rate(count: int, benchmark: BenchmarkFixture) -> float:
    assert benchmark.stats is not None
    return count / float(benchmark.stats.stats.median)


def test_events_in_steps(benchmark: BenchmarkFixture, store: Store) -> None:
    def events() -> None:
        for _ in range(EVENTS // A_STEP):
            with store.step():
                for number in range(A_STEP):
                    store.event(float(number), "state", "the stage moves to x = 120 mm", wall_time())

    benchmark.pedantic(events, rounds=5, warmup_rounds=1)
    figure(benchmark, f"events a second, durable with their step of {A_STEP}", rate(EVENTS, benchmark), "at least 5 000")


def test_events_one_by_one(benchmark: BenchmarkFixture, store: Store) -> None:
    def events() -> None:
        for number in range(200):
            store.event(float(number), "state", "the stage moves to x = 120 mm", wall_time())

    benchmark.pedantic(events, rounds=3, warmup_rounds=1)
    figure(benchmark, "events a second, each durable as it returns", rate(200, benchmark), "none: one sync of the disk each")


def bare_trial(number: int) -> FinishedTrial:
    name = f"{number:06d}-x-1"
    head: dict[str, Any] = {"id": name, "number": number, "name": "x", "situation": "s", "repeat": 1, "wall_time": "now"}
    detection = {"trial": name, "detector": "thesis", "hidden": 0, "reason": None, "trace": "{}", "wall_seconds": 0.1}
    found = {"trial": name, "detector": "thesis", "number": 1, "x_mm": 1.0, "y_mm": 2.0, "z_mm": 3.0}
    truth = {"trial": name, "teat": "1", "x_mm": 1.0, "y_mm": 2.0, "z_mm": 3.0, "u_mm": 0.2, "visible": 1}
    return FinishedTrial(head, [], [], [truth], [detection], [found], [])


def test_a_step_late_in_a_run_of_100_000(benchmark: BenchmarkFixture, store: Store) -> None:
    """Syncs would hide it: they are off here, so that what grows with the run is all that could show."""
    store._db.execute("PRAGMA synchronous = OFF")
    taken: list[float] = []

    def whole_run() -> None:
        for number in range(1, LONG + 1):
            start = stopwatch_s()
            store.finished(bare_trial(number))
            taken.append(stopwatch_s() - start)

    benchmark.pedantic(whole_run, rounds=1)
    first, last = (1e6 * median(some) for some in (taken[100 : LONG // 10], taken[-LONG // 10 :]))
    figure(benchmark, "a trial's step in the run's first tenth without sync, us", first, "-")
    figure(benchmark, f"the same in the last tenth of {LONG}, us", last, f"no more than {first:.4g}")


@pytest.mark.parametrize("bits", [16, 8])
def test_frames(benchmark: BenchmarkFixture, store: Store, bits: int) -> None:
    """640 x 480, a smooth scene with a sensor's noise on it."""
    chance = np.random.default_rng(1)
    y, x = np.mgrid[:480, :640]
    scene = 29_500 + 300 * np.exp(-((y - 200.0) ** 2 + (x - 300.0) ** 2) / 8000)
    raw = [(scene + chance.normal(0.0, 5.0, scene.shape)).astype(np.uint16) for _ in range(A_TRIAL)]
    images = {f"camera-{k}": image if bits == 16 else (image // 118).astype(np.uint8) for k, image in enumerate(raw)}
    trials = itertools.count()

    def frames() -> None:
        for _ in range(FRAMES // A_TRIAL):
            store.frames(str(next(trials)), images, {})

    benchmark.pedantic(frames, rounds=5, warmup_rounds=1)
    aim = "at least 300" if bits == 16 else "-"
    figure(benchmark, f"frames of {bits} bits a second, hashed and synced, {A_TRIAL} a trial", rate(FRAMES, benchmark), aim)


class Counter:
    """As little of a detector as bluesky reads."""

    name, parent = "counter", None

    def read(self) -> dict[str, Any]:
        return {self.name: {"value": 1.0, "timestamp": stopwatch_s()}}

    def describe(self) -> dict[str, Any]:
        return {self.name: {"source": "count", "dtype": "number", "shape": []}}


@pytest.mark.skipif(importlib.util.find_spec("bluesky") is None, reason="bluesky is not installed: nothing to compare with")
def test_blueskys_count_plan(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    """The same machine in the same minute: events of ``count`` through bluesky's run engine into a file of JSON lines, never synced."""
    engine = importlib.import_module("bluesky").RunEngine({}, context_managers=[])
    plans = importlib.import_module("bluesky.plans")

    def count() -> None:
        with (tmp_path / "documents.jsonl").open("a", encoding="utf-8") as file:
            engine(plans.count([Counter()], num=300), lambda name, doc: file.write(json.dumps([name, doc], default=str) + "\n"))

    benchmark.pedantic(count, rounds=3, warmup_rounds=1)
    figure(benchmark, "bluesky: events of the count plan a second, to JSON lines", rate(300, benchmark), "for scale")
