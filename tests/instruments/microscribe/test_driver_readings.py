"""Readings: right when the arm is still and homed, refused when it isn't, and honest on a bad
cable.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from instruments.errors import LimitError, LinkError, ProtocolError
from instruments.link import Link
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.errors import ArmMovesError, NotHomedError
from instruments.microscribe.faults import Fault
from instruments.microscribe.unit import UNIT_40937
from tests.instruments.microscribe.driver_rig import POINT, UP, Rig


def test_at_rest_the_recorded_counts_and_the_position_of_the_sheet(rig: Rig) -> None:
    driver = rig.signed_on()
    assert driver.poll().counts == (13903, 6238, 6868, 4098, 3193, 8416)
    reading = driver.read()
    assert np.hypot(*reading.tip_mm[:2]) == pytest.approx(np.hypot(73.6746, 14.0353), abs=1e-3)
    assert reading.tip_mm[2] == pytest.approx(212.2005, abs=1e-3)
    assert reading.axis[2] == pytest.approx(0.99996, abs=1e-5)
    assert (reading.n, reading.counts[3]) == (8, 4098)
    assert reading.spread_mm < 1e-9


def test_a_touch_is_right_within_the_stated_accuracy(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.hand.point = POINT
    reading = driver.read(32)
    assert np.linalg.norm(reading.tip_mm - POINT) < 0.8
    assert 0.0 < reading.spread_mm < 0.6
    np.testing.assert_allclose(reading.axis, UP, atol=0.01)


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("place", range(1, 14))
def test_a_byte_that_comes_twice_gives_no_wrong_packet(rig: Rig, place: int, apart: bool) -> None:
    driver = rig.signed_on()
    right = driver.poll().counts
    left = 1

    def spoil(data: bytes) -> list[bytes]:
        nonlocal left
        if not left or len(data) != 14:
            return [data]
        left -= 1
        doubled = data[: place + 1] + data[place:]
        return [doubled[:14], doubled[14:]] if apart else [doubled]

    rig.ear.spoil = spoil
    assert driver.poll().counts == right
    assert (left, driver.damaged) == (0, 1)
    assert driver.poll().counts == right


def test_one_wrong_packet_among_eight_does_not_move_a_reading(rig: Rig) -> None:
    driver = rig.signed_on()
    right = driver.read()
    answers = 0

    def spoil(data: bytes) -> list[bytes]:
        nonlocal answers
        answers += 1
        return [data[:5] + bytes([data[5] ^ 0x06]) + data[6:]] if answers == 3 else [data]

    rig.ear.spoil = spoil
    reading = driver.read()
    assert 0.1 < reading.spread_mm < 1.0
    np.testing.assert_allclose(reading.tip_mm, right.tip_mm, atol=1e-9)
    np.testing.assert_allclose(reading.axis, right.axis, atol=1e-9)


def test_the_same_seed_gives_the_same_readings(make: Callable[..., Rig]) -> None:
    readings = []
    for _ in range(2):
        rig = make()
        driver = rig.signed_on()
        rig.hand.point = POINT
        readings.append((driver.read().tip_mm.tobytes(), rig.clock.now()))
    assert readings[0] == readings[1]


@pytest.mark.parametrize(
    ("encoders", "stamped", "asked", "counts"),
    [(5, False, 0x01, 5), (5, True, 0x21, 5), (6, True, 0x23, 6)],
)
def test_five_encoders_or_six_with_a_stamp_or_without(
    rig: Rig, encoders: int, stamped: bool, asked: int, counts: int
) -> None:
    driver = rig.signed_on()
    packet = driver.poll(encoders=encoders, stamped=stamped)
    assert rig.ear.heard.endswith(bytes([asked]))
    assert packet.counts == UNIT_40937.home[:counts]
    assert (packet.ticks is not None) is stamped
    assert driver.poll().counts == UNIT_40937.home


def test_seven_encoders_are_no_arm(rig: Rig) -> None:
    with pytest.raises(ValueError, match="5 or 6 encoders"):
        rig.signed_on().poll(encoders=7)


def test_another_tip_is_longer_along_the_stylus(rig: Rig) -> None:
    standard = rig.signed_on().read()
    driver = MicroScribe(
        Link(rig.listener.url, rig.clock, who="arm"), rig.clock, tip_longer_mm=25.0
    )
    rig.drivers.append(driver)
    driver.sign_on()
    driver.confirm_homed()
    np.testing.assert_allclose(
        driver.read().tip_mm, standard.tip_mm - 25.0 * standard.axis, atol=1e-9
    )


def test_no_position_before_homing_is_confirmed(rig: Rig) -> None:
    driver = rig.driver()
    driver.sign_on()
    assert driver.poll().counts == UNIT_40937.home
    with pytest.raises(
        NotHomedError,
        match=(
            r"before homing is confirmed: it has not been confirmed since sign-on.*stylus on"
            r" its peg"
        ),
    ):
        driver.read()
    driver.confirm_homed()
    assert driver.homed
    driver.read()


def test_every_sign_on_asks_for_homing_anew(rig: Rig) -> None:
    driver = rig.signed_on()
    driver.sign_on()
    assert not driver.homed
    with pytest.raises(NotHomedError, match="the session was opened anew"):
        driver.read()


def test_home_reloads_the_counts_on_the_peg(make: Callable[..., Rig]) -> None:
    rig = make(accuracy_mm=0.0)
    rig.hand.point = POINT
    rig.arm.power_cycle()
    rig.hand.point = None
    driver = rig.driver()
    driver.sign_on()
    assert driver.poll().counts != UNIT_40937.home
    driver.home()
    assert driver.homed
    assert driver.poll().counts == UNIT_40937.home
    rig.hand.point = POINT
    assert np.linalg.norm(driver.read(32).tip_mm - POINT) < 0.3


def test_homing_that_is_not_confirmed_by_the_arm_does_not_count(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.faults.inject("silent", 1)
    with pytest.raises(LinkError, match=r"does not answer \(asked C2"):
        driver.home()
    with pytest.raises(NotHomedError, match="asked to home, and did not confirm it"):
        driver.read()


def test_a_reading_is_refused_while_the_arm_moves(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.hand.point, rig.hand.drift = POINT, 100.0
    with pytest.raises(
        ArmMovesError, match=r"the arm moves: 8 packets spread by \d\.\d+ mm, more than 1 mm.*still"
    ):
        driver.read()
    rig.hand.drift = 0.0
    driver.read()


def test_a_reading_of_nothing_is_refused(rig: Rig) -> None:
    driver = rig.signed_on()
    with pytest.raises(ValueError, match="one packet at least"):
        driver.read(0)
    with pytest.raises(ValueError, match="one sample at least"):
        driver.position([])


@pytest.mark.parametrize("fault", [Fault.BIT_7, Fault.LOST_BYTE])
def test_a_damaged_packet_is_asked_for_again(rig: Rig, fault: Fault) -> None:
    driver = rig.signed_on()
    for _ in range(20):
        rig.arm.faults.inject(fault, 1)
        assert driver.poll().counts == UNIT_40937.home
    assert driver.damaged >= 15  # a lost header leaves no packet to call damaged


def test_garbage_before_a_packet_does_no_harm(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.faults.inject("garbage between packets")
    assert {driver.poll().counts for _ in range(50)} == {UNIT_40937.home}


def test_packets_that_are_always_damaged_are_refused(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.faults.inject("bit 7 in payload")
    with pytest.raises(ProtocolError, match=r"3 packets in a row came damaged \(asked 03, got 83"):
        driver.poll()
    rig.arm.faults.clear("bit 7 in payload")
    driver.read()


def test_a_flipped_bit_shows_as_motion(rig: Rig) -> None:
    driver = rig.signed_on()
    refused = 0
    for _ in range(30):
        rig.arm.faults.inject("flipped bit", 1)
        try:
            tip = driver.read().tip_mm
        except LimitError:
            refused += 1
        # a low bit, a joint that is none, or the buttons: no further off than the spread allows
        else:
            assert np.hypot(*tip[:2]) == pytest.approx(75, abs=1)
    assert refused > 5


def test_one_lost_question_is_asked_again(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.faults.inject("silent", 1)
    driver.read()


def test_a_late_answer_is_not_taken_for_the_next_one(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.ear.late_s = 0.15  # after the time-out, before the silence that the driver then waits for
    assert driver.poll().counts == UNIT_40937.home
    rig.clock.sleep(0.1)  # by now the late answer, from the peg, has come in any case
    rig.hand.point = POINT
    assert driver.poll().counts != UNIT_40937.home


def test_a_hand_that_reaches_too_far_breaks_the_link_rather_than_lies(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.hand.point = POINT * 10
    with pytest.raises(LinkError, match="hung up"):
        driver.read()
    assert "out of reach" in str(rig.arm.unreachable)
