"""Signs of life: who looks at the clock lives, who is silent for too long hangs, and what takes too
long in all does too.
"""

from __future__ import annotations

import socket
import threading
from itertools import pairwise

import pytest

from bench.safety.guardian_client import Heartbeat
from instruments.clock import RealClock, stopwatch_s
from instruments.link import Link


class Stopwatch:
    """Real time as the test says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        monkeypatch.setattr("bench.safety.guardian_client.stopwatch_s", lambda: self.now_s)


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Stopwatch:
    return Stopwatch(monkeypatch)


@pytest.fixture
def pulse(watch: Stopwatch) -> Heartbeat:
    """The main thread moves something, for ten minutes at most."""
    heartbeat = Heartbeat()
    heartbeat.sign("moving", 600.0, silence_s=10.0)
    return heartbeat


def test_a_long_move_that_shows_life_is_no_hang(watch: Stopwatch, pulse: Heartbeat) -> None:
    for _ in range(60):
        watch.now_s += 9.0
        assert pulse.overdue() is None
        pulse.alive()
    watch.now_s += 10.1
    assert pulse.overdue() == "the main thread hangs: moving, and no sign of life for 10 s"


def test_life_without_an_end_hangs_too(watch: Stopwatch, pulse: Heartbeat) -> None:
    for _ in range(101):
        watch.now_s += 6.0
        pulse.alive()
    assert pulse.overdue() == "the main thread hangs: moving took more than 600 s"


def test_a_computation_may_be_silent_for_as_long_as_it_may_take(watch: Stopwatch) -> None:
    pulse = Heartbeat()
    pulse.sign("detecting", 60.0)
    watch.now_s += 59.0
    assert pulse.overdue() is None
    watch.now_s += 2.0
    assert "detecting took more than 60 s" in str(pulse.overdue())


def test_who_sleeps_says_for_how_long(watch: Stopwatch, pulse: Heartbeat) -> None:
    pulse.alive(asleep_s=30.0)
    watch.now_s += 39.0
    assert pulse.overdue() is None
    watch.now_s += 2.0
    assert pulse.overdue() is not None


def test_the_life_of_another_thread_is_not_that_of_the_main_one(
    watch: Stopwatch, pulse: Heartbeat
) -> None:
    watch.now_s += 9.0
    other = threading.Thread(target=pulse.alive)
    other.start()
    other.join()
    watch.now_s += 2.0
    assert pulse.overdue() is not None


def test_a_clock_tells_who_looks_and_how_long_he_sleeps() -> None:
    clock, heard = RealClock(), list[float]()
    clock.subscribe(heard.append)
    clock.now()
    clock.sleep(0.01)
    clock.subscribe(None)
    clock.now()
    assert heard == [0.0, 0.01]


@pytest.mark.slow
def test_a_link_that_waits_for_an_answer_shows_life_every_second() -> None:
    clock, heard = RealClock(), list[float]()
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = Link(f"socket://127.0.0.1:{server.getsockname()[1]}", clock, who="nobody")
        near, _ = server.accept()
        clock.subscribe(lambda _: heard.append(stopwatch_s()))
        assert link.receive(2.5) == b""
        link.close()
        near.close()
    assert len(heard) >= 3
    assert max(b - a for a, b in pairwise(heard)) < 5.0
