"""Sign-on: by the sheet, in spite of what may be on the line, and read until two readings agree."""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Callable

import numpy as np
import pytest

from instruments.clock import VirtualClock
from instruments.errors import InstrumentError
from instruments.link import Link
from instruments.listener import Listener
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.faults import Fault
from instruments.microscribe.protocol import State
from instruments.microscribe.unit import UNIT_40937
from tests.instruments.microscribe.driver_rig import MAKERS_ORDER, Rig, renamed
from tests.instruments.microscribe.impostors import Ghost


def test_sign_on_goes_by_the_sheet_and_reads_who_it_is_twice(rig: Rig) -> None:
    driver = rig.driver()
    identity = driver.sign_on()
    assert rig.ear.heard == b"\xc5\xc5IMMCBEGIN" + MAKERS_ORDER + MAKERS_ORDER
    assert dataclasses.astuple(identity) == (
        "MicroScribe3D",
        "MSCR",
        "DX",
        "40937",
        "Standard+Beta",
        "Format DH0.5",
        "HCI 2.0",
    )
    assert driver.identity == identity
    assert driver.maxima.turns == (16384, 16384, 8192, 4096, 4096, 0)
    assert driver.parameters.d == (8300, -878, -3, 9244, 320, -5274)
    assert driver.beta_rad == pytest.approx(3 / 32768 * np.pi)
    # the pause after an end, and the silence that surplus echoes are waited for
    assert rig.clock.now() == pytest.approx(0.115)
    assert driver.warnings == ()


def test_what_a_run_records_is_enough_to_compute_positions_anew(rig: Rig) -> None:
    driver = rig.driver()
    driver.sign_on()
    record = driver.record()
    assert (record["serial_number"], record["beta"], record["baud"]) == ("40937", 3, 115200)
    assert record["parameters"] == dataclasses.asdict(UNIT_40937.parameters)
    assert record["maxima"] == dataclasses.asdict(UNIT_40937.maxima)


@pytest.mark.parametrize("echo_after", [2, 6])
def test_an_arm_that_wants_to_hear_it_several_times(
    make: Callable[..., Rig], echo_after: int
) -> None:
    rig = make(echo_after=echo_after)
    rig.driver().sign_on()
    assert rig.ear.heard.startswith(b"\xc5" + b"\xc5IMMC" * echo_after + b"BEGIN" + MAKERS_ORDER)


@pytest.mark.parametrize("fault", [Fault.OLD_SESSION, Fault.SURPLUS_ECHOES])
def test_sign_on_in_spite_of(rig: Rig, fault: Fault) -> None:
    rig.arm.faults.inject(fault, 1)
    driver = rig.signed_on()
    assert driver.identity.serial_number == "40937"
    assert driver.poll().counts == UNIT_40937.home


def test_a_second_host_takes_over_a_session_that_was_left_streaming(rig: Rig) -> None:
    link = Link(rig.listener.url, rig.clock, who="other host")
    for words in (b"IMMC", b"BEGIN", bytes.fromhex("CF 000A 03") + bytes(21)):
        link.write(words)
        link.receive(1.0)
    link.drain(0.2, at_most_s=0.05)
    link.close()
    rig.ear.heard = b""
    assert rig.arm.state is State.STREAMING
    assert rig.signed_on().poll().counts == UNIT_40937.home


def test_an_arm_without_beta_is_not_asked_for_it(make: Callable[..., Rig]) -> None:
    rig = make(renamed(comment="Standard"))
    driver = rig.driver()
    driver.sign_on()
    assert driver.beta_rad == 0.0
    assert b"\xd3" not in rig.ear.heard


def test_a_joint_that_loses_count_is_told(make: Callable[..., Rig]) -> None:
    maxima = dataclasses.replace(
        UNIT_40937.maxima, encoders=(0x3FFF, 0x3FFF, 0x1FFF, 4999, 0x0FFF, 0)
    )
    driver = make(dataclasses.replace(UNIT_40937, maxima=maxima)).driver()
    driver.sign_on()
    assert len(driver.warnings) == 1
    assert "joint 3 has 5000 counts a turn" in driver.warnings[0]


# Damage


def test_one_wrong_answer_is_read_over(rig: Rig) -> None:
    rig.arm.faults.inject("parameter block of another length", 1)
    driver = rig.driver()
    driver.sign_on()
    assert driver.parameters == UNIT_40937.parameters


@pytest.mark.parametrize("hit", range(10))
@pytest.mark.parametrize("bit", [0x01, 0x10])
def test_a_flipped_bit_in_any_reply_is_outvoted(hit: int, bit: int) -> None:
    replies, turn = UNIT_40937.replies(), iter(range(100))

    def answer(code: int) -> bytes:
        reply = bytearray(replies.get(code, b""))
        if reply and next(turn) == hit:
            reply[-2] ^= bit
        return bytes(reply)

    clock = VirtualClock()
    listener = Listener(Ghost(answer), clock, lock=threading.RLock(), name="ghost")
    driver = MicroScribe(Link(listener.url, clock, who="arm"), clock)
    driver.sign_on()
    assert (driver.identity, driver.maxima, driver.parameters) == (
        UNIT_40937.names,
        UNIT_40937.maxima,
        UNIT_40937.parameters,
    )
    assert driver.beta_rad == pytest.approx(3 / 32768 * np.pi)
    driver.close()
    listener.close()


@pytest.mark.parametrize("lost", range(30))
def test_whichever_byte_of_sign_on_is_lost_an_old_session_comes_to_no_harm(
    rig: Rig, lost: int
) -> None:
    rig.arm.faults.inject(Fault.OLD_SESSION, 1)
    driver = rig.driver()
    rig.ear.lose = {lost}
    with contextlib.suppress(InstrumentError):  # a BEGIN that arrives maimed is not sent again
        driver.sign_on()
    assert rig.arm.eeprom_attempts == 0
    driver.sign_on()
    assert driver.poll().counts == UNIT_40937.home
