"""How many moves a second driver and emulated stage make over a loopback link under virtual time.
Aim: 500 or more.

A poll costs a round trip, and there is one every 0.2 s of virtual time: long moves cost more than
short ones.
"""

from __future__ import annotations

import itertools
import threading

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.listener import Listener
from instruments.stage.driver import Stage
from instruments.stage.emulator.board import StageEmulator
from instruments.stage.emulator.store import CLASSIC, GRBL_HAL, Dialect
from tests.benchmarks.figures import figure, taken_s


@pytest.mark.parametrize("dialect", [CLASSIC, GRBL_HAL], ids=["grbl", "grblHAL"])
@pytest.mark.parametrize(("step_mm", "feed_mm_min"), [(10.0, 3000.0), (20.0, 1500.0)])
def test_moves_per_second(
    benchmark: BenchmarkFixture, dialect: Dialect, step_mm: float, feed_mm_min: float
) -> None:
    clock = VirtualClock()
    emulator = StageEmulator(clock, dialect=dialect, play_mm=(0.05, 0.05, 0.0))
    listener = Listener(emulator, clock, lock=threading.RLock(), name="stage")
    stage = Stage(Link(listener.url, clock, who="stage"), clock)
    try:
        stage.connect()
        stage.home()
        xs = itertools.cycle([-100.0, -100.0 - step_mm, -100.0 - 2 * step_mm, -100.0 - step_mm])
        benchmark(lambda: stage.move_to(next(xs), -100.0, feed_mm_min=feed_mm_min))
    finally:
        stage.close()
        listener.close()
    what = f"moves a second of {step_mm:g} mm, {dialect.name}"
    figure(benchmark, what, 1.0 / taken_s(benchmark, "mean"), "at least 500")
