"""Streams: in the arm's own time, ended as the maker's host does, and restarted; pedal events
without bounce.
"""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.errors import LimitError, LinkError, ProtocolError
from instruments.listener import Connection
from instruments.microscribe.errors import NoSessionError, SilentArmError
from instruments.microscribe.protocol import State
from instruments.microscribe.stream import Debouncer, Pedal, PedalEvent
from tests.instruments.microscribe.rigs import POINT, UNIT, Ear, Rig

START = bytes.fromhex("CF 0000 23") + bytes(21)
FASTEST_HZ = 720.0  # of the sheet, with stamps


def test_a_stream_is_asked_for_and_ended_as_the_sheet_says(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.ear.heard = b""
    with driver.stream() as samples:
        got = list(itertools.islice(samples, 50))
        assert rig.arm.state is State.STREAMING
        ended = rig.clock.now()
    assert rig.ear.heard == START + b"\x00"
    assert len(START) == 25
    assert rig.clock.now() - ended == pytest.approx(0.05)
    assert rig.arm.state is State.SESSION
    assert {sample.counts for sample in got} == {UNIT.home}
    gaps_s = [b.t_s - a.t_s for a, b in itertools.pairwise(got)]
    assert sum(gaps_s) / len(gaps_s) == pytest.approx(1 / FASTEST_HZ, rel=0.02)
    assert got[0].t_s == 0.0


def test_the_same_session_goes_on_behind_a_stream(rig: Rig) -> None:
    driver = rig.signed_on()
    with driver.stream() as samples:
        next(samples)
    rig.hand.point = POINT
    assert driver.homed
    asked = rig.clock.now()
    # nothing that the stream left is taken for the answer
    assert driver.poll().counts != UNIT.home
    assert rig.clock.now() == asked


def test_without_a_stamp_samples_take_the_hosts_time(rig: Rig) -> None:
    driver = rig.signed_on()
    with driver.stream(stamped=False) as samples:
        sample = next(samples)
        assert sample.t_s == rig.clock.now()
        assert driver.position([sample]).tip_mm[2] == pytest.approx(212.2005, abs=1e-3)


@pytest.mark.parametrize("lost", range(25))
def test_whichever_byte_of_the_request_is_lost_no_harm_is_done(rig: Rig, lost: int) -> None:
    driver = rig.signed_on()
    rig.hand.point = POINT  # off the peg: homing would show
    before = driver.poll().counts
    rig.ear.lose = {lost}
    with driver.stream() as samples:
        got = list(itertools.islice(samples, 30))
    assert all(
        abs(a - b) < 20
        for sample in got
        for a, b in zip(sample.counts[:5], before[:5], strict=True)
    )
    assert rig.arm.eeprom_attempts == 0
    driver.read()


def test_questions_within_a_stream_are_refused(rig: Rig) -> None:
    driver = rig.signed_on()
    with driver.stream() as samples:
        for ask in (driver.poll, driver.read, driver.home, lambda: driver.stream().__enter__()):
            with pytest.raises(LimitError, match=r"a stream runs .*End the stream first"):
                ask()
        next(samples)
    with pytest.raises(NoSessionError, match="the stream has ended"):
        next(samples)


def test_a_stream_that_something_ended_is_started_again(rig: Rig) -> None:
    driver = rig.signed_on()
    with driver.stream() as samples:
        next(samples)
        with rig.lock:
            rig.arm.receive(rig.ear.hosts[-1], b"\x00")  # as noise on the cable would
        assert len(list(itertools.islice(samples, 20))) == 20
    assert rig.ear.heard.count(START) == 2


@pytest.mark.parametrize(
    ("error", "message"), [(SilentArmError, "fallen silent"), (LinkError, "the link broke")]
)
def test_power_or_cable_lost_within_a_stream(
    rig: Rig, error: type[Exception], message: str
) -> None:
    driver = rig.signed_on()
    with pytest.raises(error, match=message), driver.stream() as samples:  # noqa: PT012
        next(samples)
        if error is SilentArmError:
            rig.arm.power_cycle()
        else:
            rig.ear.hosts[-1].hang_up()
        list(itertools.islice(samples, 100))
    assert not driver.homed
    driver.recover()
    assert driver.poll().counts == UNIT.home


@pytest.mark.parametrize(
    ("answer", "error", "message"),
    [
        (b"", SilentArmError, "answers polls, but no stream"),
        (b"\x81\x02", ProtocolError, r"answered otherwise .asked CF, got 81 02"),
    ],
)
def test_an_arm_that_does_not_stream_is_told_apart_from_one_that_is_gone(
    rig: Rig, answer: bytes, error: type[Exception], message: str
) -> None:
    class Deaf(Ear):
        """Keeps stream requests from the arm, and answers them with ``answer``."""

        def receive(self, connection: Connection, data: bytes) -> None:
            if data[0] == 0xCF:
                connection.send(answer)
            else:
                super().receive(connection, data)

    driver = rig.signed_on()
    rig.ear.device = Deaf(rig.arm)
    with pytest.raises(error, match=message), driver.stream():
        pass
    driver.read()


# Pedals


@pytest.mark.parametrize(
    ("levels", "events"),
    [
        (
            [(0, 0), (10, 1), (20, 1), (29, 1), (30, 1), (100, 0), (119, 0), (121, 0)],
            [PedalEvent(Pedal.RIGHT, True, 0.01), PedalEvent(Pedal.RIGHT, False, 0.1)],
        ),
        ([(0, 0), (10, 1), (15, 0), (20, 1), (35, 1)], []),
        ([(0, 0), (10, 1), (15, 0), (20, 1), (40, 1)], [PedalEvent(Pedal.RIGHT, True, 0.02)]),
        ([(0, 0), (100, 2), (200, 0), (300, 0)], []),
        ([(0, 0), (100, 2), (200, 2)], [PedalEvent(Pedal.LEFT, True, 0.1)]),
        ([(0, 1), (50, 1), (100, 0), (150, 0)], [PedalEvent(Pedal.RIGHT, False, 0.1)]),
        (
            [(0, 0), (10, 1), (20, 3), (31, 3), (40, 3)],
            [PedalEvent(Pedal.RIGHT, True, 0.01), PedalEvent(Pedal.LEFT, True, 0.02)],
        ),
        ([(0, 0), (10, 0x7C), (100, 0x7C)], []),
    ],
)
def test_events_of_milliseconds_and_buttons(
    levels: list[tuple[int, int]], events: list[PedalEvent]
) -> None:
    debouncer = Debouncer()
    seen = [event for t_ms, buttons in levels for event in debouncer.feed(t_ms / 1000, buttons)]
    assert seen == events


@given(st.lists(st.tuples(st.integers(1, 50), st.integers(0, 3)), max_size=80))
def test_events_alternate_and_agree_with_what_is_down(steps: list[tuple[int, int]]) -> None:
    debouncer, now_ms = Debouncer(), 0
    events: dict[Pedal, list[bool]] = {pedal: [] for pedal in Pedal}
    debouncer.feed(0.0, 0)
    for step_ms, buttons in steps:
        now_ms += step_ms
        for event in debouncer.feed(now_ms / 1000, buttons):
            assert now_ms / 1000 - event.t_s >= 0.02 - 1e-6
            events[event.pedal].append(event.pressed)
        for pressed in events.values():
            assert pressed == [at % 2 == 0 for at in range(len(pressed))]
