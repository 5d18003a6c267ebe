"""Readings: right when the arm is still and homed, refused when it isn't; lost power and cables;
streams and pedals.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.errors import LimitError, LinkError, ProtocolError
from instruments.listener import Connection
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.errors import (
    AnotherArmError,
    ArmMovesError,
    NoSessionError,
    NotHomedError,
    SilentArmError,
    UnusableArmError,
)
from instruments.microscribe.faults import ArmFault
from instruments.microscribe.pedals import Debouncer, Pedal, PedalEvent
from instruments.microscribe.protocol import State
from tests.instruments.microscribe.rigs import POINT, UNIT, UP, Ear, Rig, renamed


def test_at_rest_the_recorded_counts_and_the_position_of_the_sheet(rig: Rig) -> None:
    driver = rig.signed_on()
    assert driver.poll().counts == (13903, 6238, 6868, 4098, 3193, 8416)
    reading = driver.read()
    assert np.hypot(*reading.tip_mm[:2]) == pytest.approx(np.hypot(73.6746, 14.0353), abs=1e-3)
    assert reading.tip_mm[2] == pytest.approx(212.2005, abs=1e-3)
    assert reading.axis is not None
    assert reading.axis[2] == pytest.approx(0.99996, abs=1e-5)
    assert (reading.n, reading.counts[3]) == (8, 4098)
    assert reading.spread_mm < 1e-9


def test_a_touch_is_right_within_the_stated_accuracy_and_repeatable(
    make: Callable[..., Rig],
) -> None:
    seen = []
    for _ in range(2):
        rig = make()
        driver = rig.signed_on()
        rig.hand.point = POINT
        reading = driver.read(32)
        assert np.linalg.norm(reading.tip_mm - POINT) < 0.8
        assert 0.0 < reading.spread_mm < 0.6
        assert reading.axis is not None
        np.testing.assert_allclose(reading.axis, UP, atol=0.01)
        seen.append((reading.tip_mm.tobytes(), rig.clock.now()))
    assert seen[0] == seen[1]


def test_no_position_before_homing_is_confirmed_in_each_session(rig: Rig) -> None:
    driver = rig.driver()
    driver.sign_on()
    assert driver.poll().counts == UNIT.home
    first = (
        r"before homing is confirmed: it has not been confirmed since sign-on.*stylus on its peg"
    )
    with pytest.raises(NotHomedError, match=first):
        driver.read()
    driver.confirm_homed()
    driver.read()
    driver.sign_on()
    assert not driver.homed
    with pytest.raises(NotHomedError, match="the session was opened anew"):
        driver.read()


def test_homing_that_is_not_confirmed_by_the_arm_does_not_count(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.faults.inject("silent", 1)
    with pytest.raises(LinkError, match=r"does not answer \(asked C2"):
        driver.home()
    with pytest.raises(NotHomedError, match="asked to home, and did not confirm it"):
        driver.read()


def test_a_reading_is_refused_while_the_arm_moves_and_of_nothing(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.hand.point, rig.hand.drift = POINT, 100.0
    with pytest.raises(
        ArmMovesError, match=r"the arm moves: 8 packets spread by \d\.\d+ mm, more than 1 mm.*still"
    ):
        driver.read()
    rig.hand.drift = 0.0
    driver.read()
    with pytest.raises(ValueError, match="one packet at least"):
        driver.read(0)
    with pytest.raises(ValueError, match="one sample at least"):
        driver.position([])


@pytest.mark.parametrize(
    "fault", [ArmFault.BIT_7, ArmFault.LOST_BYTE, ArmFault.GARBAGE, ArmFault.SILENT]
)
def test_a_damaged_packet_is_asked_for_again(rig: Rig, fault: ArmFault) -> None:
    driver = rig.signed_on()
    for _ in range(20):
        rig.arm.faults.inject(fault, 1)
        assert driver.poll().counts == UNIT.home
    # a lost header leaves no packet to call damaged
    assert driver.damaged >= (15 if fault in (ArmFault.BIT_7, ArmFault.LOST_BYTE) else 0)


def test_packets_that_are_always_damaged_are_refused(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.faults.inject("bit 7 in payload")
    with pytest.raises(ProtocolError, match=r"3 packets in a row came damaged \(asked 03, got 83"):
        driver.poll()
    rig.arm.faults.clear("bit 7 in payload")
    driver.read()


def test_a_hand_that_reaches_too_far_breaks_the_link_rather_than_lies(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.hand.point = POINT * 10
    with pytest.raises(LinkError, match="hung up"):
        driver.read()
    assert "out of reach" in str(rig.arm.unreachable)


# Power and cables


def test_power_loss_is_noticed_and_recovering_waits_for_the_power_as_long_as_is_said(
    rig: Rig,
) -> None:
    driver = rig.signed_on()
    start = rig.clock.now()
    rig.arm.power_off()
    with pytest.raises(SilentArmError, match=r"fallen silent.*lost its power.*on its peg"):
        driver.read()
    assert rig.clock.now() - start < 1.0
    assert not driver.homed
    with pytest.raises(NoSessionError, match="no session"):
        driver.read()
    start = rig.clock.now()
    with pytest.raises(SilentArmError, match="nothing answers the sign-on"):
        driver.recover(5.0)
    assert rig.clock.now() - start == pytest.approx(5.0, abs=0.5)
    back = rig.clock.now() + 8.0
    with rig.lock:
        rig.clock.call_at(back, rig.arm.power_on)
    assert driver.recover(30.0) == driver.identity
    assert rig.clock.now() - back < 2.0
    assert driver.poll().counts == UNIT.home
    with pytest.raises(NotHomedError, match="the arm fell silent: it may have lost its power"):
        driver.read()
    driver.confirm_homed()
    driver.read()


def test_what_is_refused_for_good_is_not_tried_again(rig: Rig) -> None:
    driver = rig.signed_on()
    port = rig.unplug()
    with pytest.raises(LinkError):
        driver.poll()
    other = ArmEmulator(rig.hand, rig.clock, unit=renamed(serial_number="51234"), seed=1)
    rig.plug_in(port, other)
    start = rig.clock.now()
    for _ in range(2):
        with pytest.raises(AnotherArmError, match="arm 40937 was lost, and arm 51234 answers"):
            driver.recover(60.0)
        assert not driver.live
    assert driver.sign_on().serial_number == "51234"
    other.faults.inject("IBOX")
    with pytest.raises(UnusableArmError):
        driver.recover(60.0)
    assert rig.clock.now() - start < 2.0


# Streams

START = bytes.fromhex("CF 0000 23") + bytes(21)
FASTEST_HZ = 720.0  # of the sheet, with stamps


def test_a_stream_is_asked_for_and_ended_as_the_sheet_says(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.ear.heard = b""
    with driver.stream() as samples:
        got = list(itertools.islice(samples, 50))
        states = [rig.arm.state]
        ended = rig.clock.now()
    assert rig.ear.heard == START + b"\x00"
    assert len(START) == 25
    assert rig.clock.now() - ended == pytest.approx(0.05)
    assert [*states, rig.arm.state] == [State.STREAMING, State.SESSION]
    assert {sample.counts for sample in got} == {UNIT.home}
    gaps_s = [b.t_s - a.t_s for a, b in itertools.pairwise(got)]
    assert sum(gaps_s) / len(gaps_s) == pytest.approx(1 / FASTEST_HZ, rel=0.02)
    assert got[0].t_s == 0.0


def test_whichever_byte_of_the_request_is_lost_no_harm_is_done(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.hand.point = POINT  # off the peg: homing would show
    before = driver.poll().counts[:5]
    for lost in range(25):
        rig.ear.lose = {lost}
        with driver.stream() as samples:
            got = np.array([sample.counts[:5] for sample in itertools.islice(samples, 30)])
        assert np.abs(got - before).max() < 20
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


@pytest.mark.slow
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
