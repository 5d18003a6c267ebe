"""Standby from an event of virtual time, in the midst of another call on the same link: it goes
out, and it has the last word.

Interlocks do that: their watch is planned on the clock, and the clock moves while a driver waits
for an answer.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import pytest

from instruments.bath.driver import Bath
from instruments.bath.errors import BrokenError
from instruments.bath.profile import load_profile
from instruments.clock import VirtualClock
from instruments.errors import InstrumentError
from tests.instruments.bath.stand import Stand

CALLS: dict[str, Callable[[Bath], object]] = {
    "read": lambda bath: bath.read(),
    "get": lambda bath: bath.get("set_point"),
    "set": lambda bath: bath.set("set_point", 30.0),
    "start": lambda bath: bath.start(33.0),
    "safe": lambda bath: bath.safe(),
}
FAMILIES = ["julabo-presto", "eurotherm-3200"]


def stand_of(family: str) -> Stand:
    return Stand(profile=load_profile(family))


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("after_s", [0.05, 0.3, 0.9, 1.4, 2.6])
def test_standby_within_another_call_while_nobody_answers(
    family: str, call: str, after_s: float
) -> None:
    """The first attempts fail and close the session that the outer call waits on."""
    stand = stand_of(family)
    try:
        bath = stand.bath()
        stand.plant.run(33.0)
        stand.emulator.fault("silence")
        stand.clock.call_at(
            stand.clock.now() + after_s + 4.0, lambda: stand.emulator.fault("silence", on=False)
        )
        made_safe: list[bool] = []

        def trip() -> None:
            bath.safe()
            made_safe.append(not stand.plant.running)

        stand.clock.call_at(stand.clock.now() + after_s, trip)
        with suppress(InstrumentError):  # and nothing else
            CALLS[call](bath)
        if not made_safe:  # the call was over before
            stand.clock.sleep(after_s + 8.0)
        assert made_safe == [True]
        assert not stand.plant.running
    finally:
        stand.close()


@pytest.mark.parametrize("family", FAMILIES)
def test_a_session_that_is_closed_while_it_waits_is_told_as_a_broken_link(family: str) -> None:
    stand = stand_of(family)
    try:
        bath = stand.bath()
        stand.emulator.fault("silence")
        stand.clock.call_at(stand.clock.now() + 0.5, bath.close)
        with pytest.raises(BrokenError, match="the link broke"):
            bath._wire.read(3, 0, 1)
        stand.emulator.fault("silence", on=False)
        assert bath.read().temp_c == pytest.approx(20.0, abs=0.05)
    finally:
        stand.close()


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("within", range(1, 12))
def test_a_start_never_undoes_a_standby_that_came_meanwhile(family: str, within: int) -> None:
    """Standby comes amid the start's ``within``-th question, which is slow to be answered."""
    stand = stand_of(family)
    try:
        bath = stand.bath()
        tripped: list[float] = []
        asked = len(stand.emulator.asked)
        receive = stand.emulator.receive

        def trip() -> None:
            stand.emulator.fault("late answer", on=False)
            bath.safe()
            tripped.append(stand.clock.now())

        def slow(connection: object, data: bytes) -> None:
            if len(stand.emulator.asked) == asked + within - 1 and not tripped:
                stand.emulator.late_s = 0.6
                stand.emulator.fault("late answer")
                stand.clock.call_at(stand.clock.now() + 0.2, trip)
            receive(connection, data)  # type: ignore[arg-type]

        stand.emulator.receive = slow  # type: ignore[method-assign]
        with suppress(InstrumentError):
            bath.start(33.0)
        if tripped:
            assert not stand.plant.running
        else:
            assert stand.plant.running
        stand.clock.sleep(1.0)
        bath.read()
        assert stand.plant.running == (not tripped)
    finally:
        stand.close()


def test_who_starts_learns_that_it_was_made_safe() -> None:
    stand = stand_of("julabo-presto")
    try:
        bath = stand.bath()
        # writes to a JULABO keep 0.25 s apart
        stand.clock.call_at(stand.clock.now() + 0.1, bath.safe)
        with pytest.raises(InstrumentError, match="not started: it was made safe meanwhile"):
            bath.start(33.0)
        assert not stand.plant.running
        bath.start(33.0)
        assert stand.plant.running
    finally:
        stand.close()


def test_a_bath_that_never_answers_again_says_so_from_both_calls() -> None:
    stand = stand_of("julabo-presto")
    try:
        bath, inner = stand.bath(), []
        stand.emulator.fault("silence")

        def trip() -> None:
            try:
                bath.safe()
            except InstrumentError as error:
                inner.append(error)

        stand.clock.call_at(stand.clock.now() + 0.5, trip)
        with pytest.raises(InstrumentError):
            bath.read()
        assert len(inner) == 1
        assert isinstance(stand.clock, VirtualClock)
    finally:
        stand.close()
