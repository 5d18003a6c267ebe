"""Real time has fine steps on every system."""

from __future__ import annotations

import os
import time

import pytest

from instruments.clock import RealClock, load_per_processor, stopwatch_s

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


def test_where_no_system_says_how_busy_it_is_there_is_no_load(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def unobtainable() -> tuple[float, float, float]:
        raise OSError("Load averages are unobtainable")

    monkeypatch.setattr(os, "getloadavg", unobtainable, raising=False)
    assert load_per_processor() is None
    monkeypatch.delattr(os, "getloadavg")
    assert load_per_processor() is None
