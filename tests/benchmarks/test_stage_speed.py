"""How many moves a second driver and emulated stage make over a loopback link under virtual time. Aim: 500 or more."""

from __future__ import annotations

import itertools
import threading

from pytest_benchmark.fixture import BenchmarkFixture

from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.listener import Listener
from instruments.stage.driver import Stage
from instruments.stage.emulator import StageEmulator


def test_moves_per_second(benchmark: BenchmarkFixture) -> None:
    clock = VirtualClock()
    emulator = StageEmulator(clock)
    listener = Listener(emulator, clock, lock=threading.RLock(), name="stage")
    stage = Stage(Link(listener.url, clock, who="stage"), clock)
    try:
        stage.connect()
        stage.home()
        xs = itertools.cycle([-100.0, -110.0, -120.0, -110.0])
        benchmark(lambda: stage.move_to(next(xs), -100.0))
    finally:
        stage.close()
        listener.close()
