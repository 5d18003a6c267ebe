"""How fast the arm's wire and driver are. Figures beside their aims; nothing is
asserted about them.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from typing import Any

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from instruments.clock import RealClock
from instruments.link import Link
from instruments.listener import Listener
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.kinematics import Floats
from tests.benchmarks.figures import figure, taken_s

LATENCY_S = 0.001  # what the sheet's highest rates reckon with


class Hand:
    def arm_target(self) -> tuple[Floats, Floats] | None:
        return np.array([-180.0, 240.0, 130.0]), np.array([0.0, 0.0, 1.0])


@contextmanager
def paced_arm(baud: int) -> Iterator[MicroScribe]:
    with ExitStack() as stack:
        clock = stack.enter_context(closing(RealClock()))
        pace: dict[str, Any] = {"baud": baud, "latency_s": LATENCY_S}
        emulator = ArmEmulator(Hand(), clock)
        listener = Listener(emulator, clock, lock=threading.RLock(), name="arm", **pace)
        stack.enter_context(closing(listener))
        arm = MicroScribe(Link(listener.url, clock, who="arm"), clock)
        stack.enter_context(closing(arm))
        arm.sign_on()
        yield arm


@pytest.mark.parametrize(("baud", "highest_hz"), [(115200, 434), (38400, 204)])
def test_polls_a_second_on_a_paced_link(
    benchmark: BenchmarkFixture, baud: int, highest_hz: int
) -> None:
    with paced_arm(baud) as arm:
        benchmark.pedantic(
            lambda: [arm.poll() for _ in range(25)], rounds=20, iterations=1, warmup_rounds=1
        )
    share = 25 / taken_s(benchmark, "min") / highest_hz
    what = f"polls at {baud} baud, share of the sheet's highest rate"
    figure(benchmark, what, share, "at least 0.95")


@pytest.mark.parametrize(("baud", "highest_hz"), [(115200, 720), (38400, 240)])
def test_samples_a_second_streamed_on_a_paced_link(
    benchmark: BenchmarkFixture, baud: int, highest_hz: int
) -> None:
    with paced_arm(baud) as arm, arm.stream() as samples:
        next(samples)
        benchmark.pedantic(
            lambda: [next(samples) for _ in range(200)], rounds=5, iterations=1, warmup_rounds=1
        )
    # the mean: a round may find samples that waited for it
    share = 200 / taken_s(benchmark, "mean") / highest_hz
    what = f"samples streamed at {baud} baud, share of the sheet's highest rate"
    figure(benchmark, what, share, "at least 0.95")
