"""Interlocks as a table, and the watch that holds them against every reading."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest

from bench.interlocks import RULES, InterlockTrip, first_broken
from bench.rig import Limits
from bench.stability import StabilityGate, State
from bench.store import Row
from bench.watch import Watch
from instruments.bath.reading import BathReading
from instruments.clock import VirtualClock
from instruments.errors import LinkError

CALM = BathReading(t_s=0.0, temp_c=33.0, raw=(1, 2), external_c=None, power_percent=2.0, safety_c=None, alarm=0, warning=0, remote=True)


@dataclass
class ScriptedBath:
    """Reads what a function of time says."""

    clock: VirtualClock
    at: Callable[[float], BathReading]

    def read(self) -> BathReading:
        return replace(self.at(self.clock.now()), t_s=self.clock.now())


def watched(at: Callable[[float], BathReading]) -> tuple[Watch, VirtualClock, list[Row]]:
    clock, rows = VirtualClock(), list[Row]()
    watch = Watch(ScriptedBath(clock, at), clock, StabilityGate(33.0, window_s=60.0), Limits(), rows.append)
    watch.start()
    return watch, clock, rows


@pytest.mark.parametrize(
    ("now", "earlier", "rule"),
    [
        (CALM, None, None),
        (replace(CALM, temp_c=37.0), None, None),
        (replace(CALM, temp_c=37.01), None, "over-temperature"),
        (replace(CALM, temp_c=-5.1), None, "implausible reading"),
        (replace(CALM, t_s=30.0, temp_c=35.01), CALM, "rate"),
        (replace(CALM, t_s=30.0, temp_c=34.99), CALM, None),
        (replace(CALM, t_s=30.0, temp_c=30.9), CALM, "rate"),
        (replace(CALM, alarm=1), None, "controller alarm"),
    ],
)
def test_each_rule_of_the_table(now: BathReading, earlier: BathReading | None, rule: str | None) -> None:
    trip = first_broken(now, earlier, Limits())
    assert (trip.rule if trip else None) == rule


def test_every_rule_says_what_to_do() -> None:
    assert len({rule.name for rule in RULES}) == len(RULES)
    assert all(rule.then.endswith(".") for rule in RULES)


def test_the_bath_is_read_every_second_and_recorded() -> None:
    watch, clock, rows = watched(lambda t: replace(CALM, raw=(int(t),)))
    clock.sleep(100.0)
    watch.check()
    assert len(rows) == 101
    assert watch.state is State.STABLE
    watch.stop()
    clock.sleep(10.0)
    assert len(rows) == 101


@pytest.mark.parametrize(
    ("at", "rule"),
    [
        (lambda t: replace(CALM, temp_c=33.0 + t * 0.05, raw=(int(t),)), "over-temperature"),
        (lambda t: replace(CALM, temp_c=20.0 + t * 0.1, raw=(int(t),)), "rate"),
        (lambda t: replace(CALM, alarm=int(t > 40)), "controller alarm"),
    ],
)
def test_a_trip_waits_until_it_is_asked_for_and_stays(at: Callable[[float], BathReading], rule: str) -> None:
    watch, clock, _ = watched(at)
    clock.sleep(200.0)
    for _ in range(2):
        with pytest.raises(InterlockTrip) as caught:
            watch.check()
        assert caught.value.rule == rule


def test_a_bath_that_falls_silent_trips_after_the_limit_and_not_before() -> None:
    def at(t: float) -> BathReading:
        if 10.0 < t < 14.0 or t > 20.0:
            raise LinkError("bath", "no answer", seconds=1.0)
        return replace(CALM, raw=(int(t),))

    watch, clock, rows = watched(at)
    clock.sleep(20.0)
    watch.check()
    clock.sleep(4.0)
    watch.check()
    clock.sleep(3.0)
    with pytest.raises(InterlockTrip, match=r"communications lost.*no answer"):
        watch.check()
    assert len(rows) == 18


def test_a_frozen_reading_is_never_stable() -> None:
    watch, clock, _ = watched(lambda t: CALM)
    clock.sleep(3000.0)
    assert watch.state is not State.STABLE
    assert watch.why_not_stable


def test_a_mistake_of_ours_is_not_swallowed() -> None:
    def at(t: float) -> BathReading:
        if t > 5:
            raise ZeroDivisionError
        return CALM

    watch, clock, _ = watched(at)
    clock.sleep(10.0)
    with pytest.raises(ZeroDivisionError):
        watch.check()
