"""Streams: at the rate that was asked for, in the arm's own time, ended as the maker's host does,
and restarted.
"""

from __future__ import annotations

import itertools

import pytest

from instruments.errors import LinkError, ProtocolError
from instruments.microscribe.errors import NoSessionError, SilentArmError, StreamingError
from instruments.microscribe.protocol import State
from instruments.microscribe.stream import Pedal
from instruments.microscribe.unit import UNIT_40937
from tests.instruments.microscribe.driver_rig import POINT, Rig

START = bytes.fromhex("CF 000A 23") + bytes(21)


def state(rig: Rig) -> State:
    return rig.arm.state


def test_a_stream_is_asked_for_and_ended_as_the_sheet_says(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.ear.heard = b""
    with driver.stream(100.0) as samples:
        got = list(itertools.islice(samples, 50))
        assert state(rig) is State.STREAMING
        ended = rig.clock.now()
    assert rig.ear.heard == START + b"\x00"
    assert len(START) == 25
    assert rig.clock.now() - ended == pytest.approx(0.05)
    assert state(rig) is State.SESSION
    assert {sample.counts for sample in got} == {UNIT_40937.home}
    gaps_s = [b.t_s - a.t_s for a, b in itertools.pairwise(got)]
    assert sum(gaps_s) / len(gaps_s) == pytest.approx(0.01, rel=0.02)
    assert got[0].t_s == 0.0


def test_the_same_session_goes_on_behind_a_stream(rig: Rig) -> None:
    driver = rig.signed_on()
    with driver.stream(100.0) as samples:
        next(samples)
    rig.hand.point = POINT
    assert driver.homed
    asked = rig.clock.now()
    # nothing that the stream left is taken for the answer
    assert driver.poll().counts != UNIT_40937.home
    assert rig.clock.now() == asked


def test_time_goes_on_past_the_wrap_of_the_stamps(rig: Rig) -> None:
    driver = rig.signed_on()
    with driver.stream(10.0) as samples:
        first = next(samples)
        start = rig.clock.now()
        last = first
        while rig.clock.now() < start + 60.0:
            sample = next(samples)
            assert sample.t_s >= last.t_s
            last = sample
    assert last.t_s - first.t_s == pytest.approx(rig.clock.now() - start, abs=0.1)


def test_five_encoders_without_a_stamp_take_the_hosts_time(rig: Rig) -> None:
    driver = rig.signed_on()
    with driver.stream(50.0, encoders=5, stamped=False) as samples:
        sample = next(samples)
        assert sample.counts == UNIT_40937.home[:5]
        assert sample.t_s == rig.clock.now()
        assert driver.position([sample]).tip_mm[2] == pytest.approx(212.2005, abs=1e-3)


def test_as_fast_as_it_goes(rig: Rig) -> None:
    driver = rig.signed_on()
    with driver.stream() as samples:
        start = rig.clock.now()
        list(itertools.islice(samples, 500))
        assert 500 / (rig.clock.now() - start) > 600


def test_what_a_pedal_does_comes_with_the_samples(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.clock.call_at(rig.clock.now() + 0.5, lambda: setattr(rig.arm, "buttons", 0x02))
    rig.clock.call_at(rig.clock.now() + 0.8, lambda: setattr(rig.arm, "buttons", 0x00))
    with driver.stream(100.0) as samples:
        events = [event for sample in itertools.islice(samples, 150) for event in sample.events]
    assert [(event.pedal, event.pressed) for event in events] == [
        (Pedal.LEFT, True),
        (Pedal.LEFT, False),
    ]
    assert events[1].t_s - events[0].t_s == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize("rate_hz", [15.0, 12.5, 10.0, 8.0])
def test_no_delay_is_asked_for_that_would_be_a_command_by_itself(rig: Rig, rate_hz: float) -> None:
    driver = rig.signed_on()
    rig.ear.heard = b""
    with driver.stream(rate_hz) as samples:
        next(samples)
    # 63 ms: the next shorter one that is harmless
    assert rig.ear.heard[:4] == bytes.fromhex("CF 003F 23")


@pytest.mark.parametrize("lost", range(25))
def test_whichever_byte_of_the_request_is_lost_no_harm_is_done(rig: Rig, lost: int) -> None:
    driver = rig.signed_on()
    rig.hand.point = POINT  # off the peg: homing would show
    before = driver.poll().counts
    rig.ear.lose = {lost}
    with driver.stream(100.0) as samples:
        got = list(itertools.islice(samples, 30))
    assert all(
        abs(a - b) < 20
        for sample in got
        for a, b in zip(sample.counts[:5], before[:5], strict=True)
    )
    assert rig.arm.eeprom_attempts == 0
    driver.read()


@pytest.mark.parametrize("fault", ["lost byte", "bit 7 in payload", "garbage between packets"])
def test_damage_costs_packets_and_nothing_else(rig: Rig, fault: str) -> None:
    driver = rig.signed_on()
    with driver.stream(100.0) as samples:
        # one at a time: a byte lost in one packet and the header of the next make a packet that no
        # rule refuses
        for _ in range(20):
            rig.arm.faults.inject(fault, 1)
            assert {sample.counts for sample in itertools.islice(samples, 5)} == {UNIT_40937.home}
    assert driver.damaged >= (0 if fault == "garbage between packets" else 10)
    assert driver.poll().counts == UNIT_40937.home


def test_questions_within_a_stream_are_refused(rig: Rig) -> None:
    driver = rig.signed_on()
    with driver.stream(100.0) as samples:
        for ask in (
            driver.poll,
            driver.read,
            driver.home,
            lambda: driver.wait_for_pedal(1.0),
            lambda: driver.stream(10.0).__enter__(),
        ):
            with pytest.raises(StreamingError, match="End the stream first"):
                ask()
        next(samples)
    with pytest.raises(NoSessionError, match="the stream has ended"):
        next(samples)


def test_a_stream_that_something_ended_is_started_again(rig: Rig) -> None:
    driver = rig.signed_on()
    with driver.stream(100.0) as samples:
        next(samples)
        with rig.lock:
            rig.arm.receive(rig.ear.hosts[-1], b"\x00")  # as noise on the cable would
        assert len(list(itertools.islice(samples, 20))) == 20
    assert rig.ear.heard.count(START) == 2


def test_power_loss_within_a_stream(rig: Rig) -> None:
    driver = rig.signed_on()
    with (  # noqa: PT012
        pytest.raises(SilentArmError, match="fallen silent"),
        driver.stream(100.0) as samples,
    ):
        next(samples)
        rig.arm.power_cycle()
        list(itertools.islice(samples, 100))
    assert not driver.homed
    driver.sign_on()


def test_a_cable_pulled_within_a_stream(rig: Rig) -> None:
    driver = rig.signed_on()
    with (  # noqa: PT012
        pytest.raises(LinkError, match="the link broke"),
        driver.stream(100.0) as samples,
    ):
        next(samples)
        rig.ear.hosts[-1].hang_up()
        list(itertools.islice(samples, 100))
    driver.recover()
    assert driver.poll().counts == UNIT_40937.home


class Deaf:
    """Keeps stream requests from the arm, and answers them with ``answer``."""

    def __init__(self, rig: Rig, answer: bytes) -> None:
        self.inner = rig.arm
        self.answer = answer
        rig.ear.arm = self  # type: ignore[assignment]

    def receive(self, connection: object, data: bytes) -> None:
        if data[0] == 0xCF:
            connection.send(self.answer)  # type: ignore[attr-defined]
        else:
            self.inner.receive(connection, data)  # type: ignore[arg-type]

    def connect(self, connection: object) -> None: ...
    def disconnect(self, connection: object) -> None: ...


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
    driver = rig.signed_on()
    Deaf(rig, answer)
    with pytest.raises(error, match=message), driver.stream(100.0):
        pass
    driver.read()


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, 0.01, 1001.0, float("nan")])
def test_a_rate_that_cannot_be_had(rig: Rig, rate_hz: float) -> None:
    driver = rig.signed_on()
    with pytest.raises(ValueError, match="packets a second"), driver.stream(rate_hz):
        pass
