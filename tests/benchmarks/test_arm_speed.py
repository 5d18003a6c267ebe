"""How fast the arm's wire and kinematics are. Printed, not asserted: run with --benchmark-only."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from instruments.clock import Clock, RealClock, VirtualClock
from instruments.link import Link
from instruments.listener import Listener
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.kinematics import Floats, inverse
from instruments.microscribe.protocol import PacketDecoder
from instruments.microscribe.unit import UNIT_40937

AT_REST = bytes.fromhex("83 00 6C 4F 30 5E 35 54 20 02 18 79 41 60")
ARM = UNIT_40937.geometry()


class Hand:
    def arm_target(self) -> tuple[Floats, Floats] | None:
        return np.array([-180.0, 240.0, 130.0]), np.array([0.0, 0.0, 1.0])


@pytest.fixture(params=[RealClock, VirtualClock], ids=["real", "virtual"])
def driver(request: pytest.FixtureRequest) -> Iterator[MicroScribe]:
    clock: Clock = request.param()
    listener = Listener(ArmEmulator(Hand(), clock), clock, lock=threading.RLock(), name="arm")
    arm = MicroScribe(Link(listener.url, clock, who="arm"), clock)
    arm.sign_on()
    yield arm
    arm.close()
    listener.close()


def test_poll_round_trips_over_loopback(benchmark: BenchmarkFixture, driver: MicroScribe) -> None:
    def thousand() -> None:
        for _ in range(1000):
            driver.poll()

    benchmark.extra_info["polls a round"] = 1000
    benchmark(thousand)


def test_packets_decoded_in_bulk(benchmark: BenchmarkFixture) -> None:
    stream = AT_REST * 100_000
    packets = benchmark(lambda: PacketDecoder(0x03).feed(stream))
    benchmark.extra_info["packets a round"] = len(packets)


def test_kinematics_vectorised(benchmark: BenchmarkFixture) -> None:
    counts = np.random.default_rng(0).integers(0, 16384, (10_000, 6))
    tips, _ = benchmark(lambda: ARM.forward(counts))
    benchmark.extra_info["poses a round"] = len(tips)


def test_inverse_kinematics(benchmark: BenchmarkFixture) -> None:
    benchmark(lambda: inverse(ARM, (-180.0, 240.0, 130.0), (0.3, 0.2, 1.0), start=UNIT_40937.home))


def test_making_an_emulated_arm(benchmark: BenchmarkFixture) -> None:
    benchmark(lambda: ArmEmulator(Hand(), VirtualClock()))
