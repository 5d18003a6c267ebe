"""What listening in costs, and how fast a capture is read and played. Printed, not asserted: run
with --benchmark-only.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from instruments.captures.capture import CaptureFile, read_capture
from instruments.captures.replay import Replay
from instruments.clock import RealClock
from instruments.link import Link
from instruments.listener import Connection, Listener

FACTS = {"teatbench": "0", "command": "c", "machine": "m"}
PACKET = bytes.fromhex("83 00 6C 4F 30 5E 35 54 20 02 18 79 41 60")
POLLS = 1000


class Answering:
    """A packet for every byte, as an arm that is polled."""

    def connect(self, connection: Connection) -> None: ...

    def receive(self, connection: Connection, data: bytes) -> None:
        connection.send(PACKET * len(data))

    def disconnect(self, connection: Connection) -> None: ...


@pytest.fixture(params=["plain", "captured"])
def captures(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[CaptureFile | None]:
    if request.param == "plain":
        yield None
        return
    with CaptureFile(tmp_path / "c", FACTS) as capture:
        yield capture


def poll(link: Link) -> None:
    for _ in range(POLLS):
        link.write(b"\3")
        link.read(len(PACKET), 5.0)


def test_round_trips_with_and_without_a_capture(
    benchmark: BenchmarkFixture, captures: CaptureFile | None
) -> None:
    clock = RealClock()
    listener = Listener(Answering(), clock, lock=threading.RLock(), name="arm")
    tap = captures.tap("arm", clock) if captures else None
    link = Link(listener.url, clock, who="arm", tap=tap)
    benchmark.extra_info["polls a round"] = POLLS
    benchmark(lambda: poll(link))
    link.close()
    listener.close()


def test_events_written(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    with CaptureFile(tmp_path / "c", FACTS) as capture:
        tap = capture.tap("arm", RealClock())
        tap.opened("u")
        benchmark(lambda: tap.received(PACKET))


@pytest.fixture
def capture_of_polls(tmp_path: Path) -> Path:
    with CaptureFile(tmp_path / "c", FACTS) as capture:
        tap = capture.tap("arm", RealClock())
        tap.opened("u")
        for _ in range(20 * POLLS):
            tap.sent(b"\3")
            tap.received(PACKET)
    return tmp_path / "c"


def test_a_capture_read(benchmark: BenchmarkFixture, capture_of_polls: Path) -> None:
    capture = benchmark(lambda: read_capture(capture_of_polls))
    benchmark.extra_info["events a round"] = 2 * (len(capture.links["arm"][0].exchanges) - 1)


def test_round_trips_with_a_replay(benchmark: BenchmarkFixture, capture_of_polls: Path) -> None:
    clock = RealClock()
    with Replay(read_capture(capture_of_polls), clock, fast=True) as replay:
        link = Link(replay.urls["arm"], clock, who="arm")
        benchmark.extra_info["polls a round"] = POLLS
        benchmark.pedantic(lambda: poll(link), rounds=19)
        link.close()
    assert replay.mismatches == []
