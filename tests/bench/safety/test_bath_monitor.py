"""The watch: what it reads, what it does about a trip and when, whoever is busy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from bench.record.schema import Row
from bench.rig.model import SafetyLimits
from bench.run.live import bath_state
from bench.safety.bath_monitor import BathMonitor
from bench.safety.interlocks import Interlocks, InterlockTrip
from bench.safety.stability import BathState, StabilityGate
from instruments.bath.profile import load_profile
from instruments.bath.reading import BathReading
from instruments.clock import VirtualClock
from instruments.errors import LinkError
from tests.bench.safety.calm import CALM


class Watched:
    """A watch over a scripted bath under virtual time, with what it recorded and did."""

    def __init__(self, at: Callable[[float], BathReading], *, safe_from_s: float = 0.0) -> None:
        self.clock, self.rows = VirtualClock(), list[Row]()
        self.acts: list[tuple[float, Exception]] = []
        gate = StabilityGate(33.0, window_s=60.0)
        interlocks = Interlocks(SafetyLimits(), load_profile("julabo-presto"))

        def act(trip: Exception) -> bool:
            self.acts.append((self.clock.now(), trip))
            return self.clock.now() >= safe_from_s

        self.also: InterlockTrip | None = None
        acts = (self.clock, gate, interlocks, self.rows.append, act)
        self.watch = BathMonitor(
            lambda: replace(at(self.clock.now()), t_s=self.clock.now()),
            *acts,
            also=lambda: self.also,
        )
        self.watch.start()


def wobble(t: float) -> BathReading:
    return replace(CALM, temp_c=33.0 + 0.01 * (int(t) % 3), raw=(int(t),))


def test_the_bath_is_read_every_second_and_recorded() -> None:
    w = Watched(wobble)
    w.clock.sleep(100.0)
    w.watch.check()
    assert len(w.rows) == 101
    assert w.watch.state is BathState.STABLE
    w.watch.stop()
    w.clock.sleep(10.0)
    assert len(w.rows) == 101


def test_what_was_read_before_the_heating_is_no_evidence_of_stability() -> None:
    w = Watched(wobble)
    w.clock.sleep(100.0)
    w.watch.heating()
    states = [w.watch.state]
    w.clock.sleep(100.0)
    states.append(w.watch.state)
    assert [state is BathState.STABLE for state in states] == [False, True]


def test_it_goes_on_trying_until_the_bath_is_safe() -> None:
    w = Watched(lambda t: replace(CALM, alarm=int(t >= 10)), safe_from_s=22.0)
    w.clock.sleep(60.0)
    assert [when for when, _ in w.acts] == [10.0, 15.0, 20.0, 25.0]
    assert len(w.rows) == 61, "what the bath does afterwards is recorded too"


def test_a_bath_that_falls_silent_trips_after_the_limit_and_not_before() -> None:
    def at(t: float) -> BathReading:
        if 10.0 < t < 14.0 or t > 20.0:
            raise LinkError("bath", "no answer", seconds=1.0)
        return wobble(t)

    w = Watched(at)
    w.clock.sleep(20.0)
    w.watch.check()
    w.clock.sleep(4.0)
    w.watch.check()
    w.clock.sleep(3.0)
    with pytest.raises(InterlockTrip, match=r"communications lost.*no answer"):
        w.watch.check()
    assert len(w.rows) == 18


def test_a_mistake_of_ours_is_not_swallowed_and_makes_safe() -> None:
    def at(t: float) -> BathReading:
        if t > 5:
            raise ZeroDivisionError
        return wobble(t)

    w = Watched(at)
    w.clock.sleep(10.0)
    with pytest.raises(ZeroDivisionError):
        w.watch.check()
    assert [when for when, _ in w.acts] == [6.0]


def test_a_bath_that_falls_silent_is_shown_so_and_a_watch_that_has_ended_is_not() -> None:
    def gone(t: float) -> BathReading:
        if t > 40.0:
            raise LinkError("bath", "no answer", seconds=1.0)
        return wobble(t)

    w = Watched(gone)
    w.clock.sleep(39.5)
    assert w.watch.silence == ""
    w.clock.sleep(12.5)
    assert w.watch.silence == "no answer for 12 s"
    calm = Watched(wobble)
    calm.watch.end()
    calm.clock.sleep(60.0)
    assert calm.watch.silence == "", "it is asked for nothing more"


def test_time_left_is_that_of_a_person_who_watches_a_faster_world() -> None:
    w = Watched(wobble)
    w.clock.sleep(10.0)
    left = [bath_state(w.watch, 600.0, speed)["stable_in_s"] for speed in (1.0, 10.0)]
    assert left[0] > 0.0
    assert left[1] == pytest.approx(left[0] / 10.0)
