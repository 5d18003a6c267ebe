"""How fast the arm's wire, driver and kinematics are. Figures beside their aims; nothing is
asserted about them.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
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
from instruments.microscribe.protocol import PacketDecoder
from instruments.microscribe.unit import shipped_unit
from tests.benchmarks.figures import figure, taken_s

AT_REST = bytes.fromhex("83 00 6C 4F 30 5E 35 54 20 02 18 79 41 60")
UNIT = shipped_unit("40937")
ARM = UNIT.geometry()
LATENCY_S = 0.001  # what the sheet's highest rates reckon with


class Hand:
    def arm_target(self) -> tuple[Floats, Floats] | None:
        return np.array([-180.0, 240.0, 130.0]), np.array([0.0, 0.0, 1.0])


Arms = Callable[..., tuple[MicroScribe, Listener]]


@pytest.fixture
def arms() -> Iterator[Arms]:
    with ExitStack() as stack:

        def make(
            *, baud: int | None = None, latency_s: float = 0.0
        ) -> tuple[MicroScribe, Listener]:
            clock = stack.enter_context(closing(RealClock()))
            emulator, lock = ArmEmulator(Hand(), clock), threading.RLock()
            paced: dict[str, Any] = {"baud": baud, "latency_s": latency_s}
            listener = Listener(emulator, clock, lock=lock, name="arm", **paced)
            stack.enter_context(closing(listener))
            arm = MicroScribe(Link(listener.url, clock, who="arm"), clock)
            stack.enter_context(closing(arm))
            arm.sign_on()
            return arm, listener

        yield make


@pytest.mark.parametrize(("baud", "highest_hz"), [(115200, 434), (38400, 204)])
def test_polls_a_second_on_a_paced_link(
    benchmark: BenchmarkFixture, arms: Arms, baud: int, highest_hz: int
) -> None:
    arm, _ = arms(baud=baud, latency_s=LATENCY_S)

    def some() -> None:
        for _ in range(25):
            arm.poll()

    benchmark.pedantic(some, rounds=20, iterations=1, warmup_rounds=1)
    share = 25 / taken_s(benchmark, "min") / highest_hz
    figure(
        benchmark,
        f"polls at {baud} baud, share of the sheet's highest rate",
        share,
        "at least 0.95",
    )


@pytest.mark.parametrize(("baud", "highest_hz"), [(115200, 720), (38400, 240)])
def test_samples_a_second_streamed_on_a_paced_link(
    benchmark: BenchmarkFixture, arms: Arms, baud: int, highest_hz: int
) -> None:
    arm, _ = arms(baud=baud, latency_s=LATENCY_S)
    with arm.stream() as samples:
        next(samples)

        def two_hundred() -> None:
            for _ in range(200):
                next(samples)

        benchmark.pedantic(two_hundred, rounds=5, iterations=1, warmup_rounds=1)
    # the mean: a round may find samples that waited for it
    share = 200 / taken_s(benchmark, "mean") / highest_hz
    figure(
        benchmark,
        f"samples streamed at {baud} baud, share of the sheet's highest rate",
        share,
        "at least 0.95",
    )


def test_round_trips_of_the_emulator_over_loopback(benchmark: BenchmarkFixture, arms: Arms) -> None:
    """A bare socket asks, so that emulator and listener are measured, and not our driver."""
    _, listener = arms()
    with socket.create_connection(("127.0.0.1", listener.port)) as host:
        host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for word, length in ((b"\xc5IMMC", 5), (b"BEGIN", 5)):
            host.sendall(word)
            time.sleep(0.05)
            assert len(host.recv(100)) == length

        def thousand() -> None:
            for _ in range(1000):
                host.sendall(b"\x03")
                assert len(host.recv(100)) == 14

        benchmark(thousand)
    figure(
        benchmark,
        "round trips of the emulator a second",
        1000 / taken_s(benchmark, "min"),
        "at least 10 000",
    )


def test_packets_decoded_in_bulk(benchmark: BenchmarkFixture) -> None:
    stream = AT_REST * 100_000
    packets = benchmark(lambda: PacketDecoder(0x03).feed(stream))
    figure(
        benchmark,
        "packets decoded a second",
        len(packets) / taken_s(benchmark, "min"),
        "at least 100 000",
    )


def test_kinematics_vectorised(benchmark: BenchmarkFixture) -> None:
    counts = np.random.default_rng(0).integers(0, 16384, (10_000, 6))
    tips, _ = benchmark(lambda: ARM.forward(counts))
    figure(
        benchmark,
        "poses of the kinematics a second",
        len(tips) / taken_s(benchmark, "min"),
        "at least 1 000 000",
    )
