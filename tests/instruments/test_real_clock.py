"""Real time has fine steps on every system."""

from __future__ import annotations

import time

import pytest

from instruments.clock import RealClock, stopwatch_s

TICK_S = 1.0 / 64.0  # of Windows, in which `time.monotonic` goes on before Python 3.13


def test_times_of_two_moments_differ_though_the_systems_tick_is_coarse(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fine = time.monotonic
    monkeypatch.setattr(time, "monotonic", lambda: fine() // TICK_S * TICK_S)
    clock, seen = RealClock(), set[float]()
    end_s = stopwatch_s() + 4 * TICK_S
    while stopwatch_s() < end_s:
        seen.add(clock.now())
    assert len(seen) > 6, "more than ticks have passed"
