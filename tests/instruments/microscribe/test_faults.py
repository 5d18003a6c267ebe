"""What goes wrong with the emulated arm by name, byte for byte."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from instruments.errors import LinkError
from instruments.microscribe.faults import Faults
from tests.instruments.microscribe.rigs import AT_REST, POINT, UNIT, Host

REST = bytes.fromhex(AT_REST)


@pytest.mark.parametrize(
    ("fault", "hit"),
    [
        ("bit 7 in payload", lambda got: sum(byte >> 7 for byte in got) == 2 and len(got) == 14),
        ("lost byte", lambda got: len(got) == 13),
        (
            "flipped bit",
            lambda got: sum((a ^ b).bit_count() for a, b in zip(got, REST, strict=True)) == 1,
        ),
        ("garbage between packets", lambda got: got[5:] == REST),
        ("silent", lambda got: not got),
    ],
)
def test_a_bad_cable(host: Host, fault: str, hit: Callable[[bytes], bool]) -> None:
    host.arm.faults.inject(fault, 2)
    assert [hit(bytes.fromhex(host.ask("03"))) for _ in range(2)] == [True, True]
    assert host.ask("03") == AT_REST


def test_a_fault_may_spare_the_first_answers(host: Host) -> None:
    host.arm.faults.inject("bit 7 in payload", 2, after=3)
    whole = [host.ask("03") == AT_REST for _ in range(7)]
    assert whole == [True] * 3 + [False] * 2 + [True] * 2


def test_an_old_session_hears_letters_as_commands(fresh: Host) -> None:
    fresh.arm.faults.inject("old session alive", 1)
    fresh.plug_in_again()
    assert fresh.ask("03") == AT_REST
    fresh.hand.point = POINT
    assert fresh.ask("42 45 47 49 4E") == "C2 C5"
    fresh.session()
    assert np.abs(np.subtract(fresh.counts()[:5], UNIT.home[:5])).max() <= 3, "re-homed off the peg"


@pytest.mark.parametrize("letter", ["43", "47", "C3", "C7", "D0", "D1", "50", "51"])
def test_letters_that_start_an_eeprom_write_are_noticed(host: Host, letter: str) -> None:
    assert host.ask(letter) == ""
    assert host.arm.eeprom_attempts == 1
    assert host.ask("03") == AT_REST


def test_an_echo_only_after_repeats(fresh: Host) -> None:
    fresh.arm.faults.inject("echo after repeats", amount=4)
    assert [fresh.ask("C5 49 4D 4D 43") for _ in range(3)] == [""] * 3
    fresh.session()
    assert fresh.ask("C5") == "C5"
    assert fresh.ask("49 4D 4D 43" * 3) == "", "again so many in the next sign-on"
    fresh.arm.faults.clear("echo after repeats")
    assert fresh.ask("C5 49 4D 4D 43") == "49 4D 4D 43"


def test_power_goes_and_comes_back(host: Host) -> None:
    host.arm.faults.inject("power loss")
    assert host.ask("03") == ""
    assert host.ask("C5 49 4D 4D 43") == ""
    host.hand.point = POINT
    host.arm.faults.clear("power loss")
    assert host.ask("03") == "", "the session is gone"
    host.session()
    assert np.abs(np.subtract(host.counts()[:5], UNIT.home[:5])).max() <= 3, (
        "home counts, wherever the stylus is"
    )


def test_an_arm_that_nobody_homed_gives_plausible_wrong_counts(host: Host) -> None:
    host.arm.faults.inject("never homed")
    off = np.abs(np.subtract(host.counts(), UNIT.home))
    assert (off >= 500).all()
    assert (off <= 1000).all()
    host.arm.power_cycle()
    host.session()
    assert host.counts() != UNIT.home, "nor at the next power-up, while the fault is on"
    host.arm.faults.clear("never homed")
    assert host.ask("C2") == "C2"
    assert host.counts() == UNIT.home, "homed on the peg"


def test_a_pedal_bounces_for_a_while(host: Host) -> None:
    host.arm.faults.inject("pedal bounce", 2)
    for pressed in (1, 0):
        host.arm.buttons = pressed
        seen = []
        for _ in range(20):
            seen.append(host.packets("00", 0.0)[0].buttons)
            host.clock.sleep(0.0009)
        assert {*seen} == {0, 1}
        host.clock.sleep(0.01)
        assert {host.packets("00", 0.0)[0].buttons for _ in range(20)} == {pressed}
    host.arm.buttons = 1
    assert {host.packets("00", 0.0)[0].buttons for _ in range(20)} == {1}, "only twice"


def test_a_slow_adapter_holds_every_answer_back_and_keeps_their_order(host: Host) -> None:
    host.arm.faults.inject("slow adapter")
    start = host.clock.now()
    host.link.write(b"\x03\xc9")
    assert host.link.read(20, 1.0).hex(" ").upper() == f"{AT_REST} C9 4D 53 43 52 00"
    assert host.clock.now() - start == pytest.approx(0.016)
    host.link.write(b"\xc9")
    host.arm.faults.clear("slow adapter")
    host.link.write(b"\xca")
    assert host.link.read(10, 1.0) == b"\xc9MSCR\0\xcaDX\0"


@pytest.mark.parametrize("passes", [0, 5, 14, 20])
def test_the_cable_breaks_at_a_given_byte(host: Host, passes: int) -> None:
    host.arm.faults.inject("disconnect", amount=passes)
    got = b""
    with pytest.raises(LinkError, match="hung up"):  # noqa: PT012 - until it breaks
        for _ in range(3):
            host.link.write(b"\x03")
            got += host.link.read(min(14, passes - len(got)), 0.05)
            host.link.drain(0.01)
    assert got.hex(" ").upper() == (AT_REST + " " + AT_REST)[: passes * 3 - 1 if passes else 0]
    host.plug_in_again()
    assert host.ask("03") == AT_REST, "the arm kept its session, and the fault is over"


def test_the_same_seed_gives_the_same_damage() -> None:
    def garbled(seed: int) -> list[bytes]:
        faults = Faults(seed)
        faults.inject("flipped bit")
        faults.inject("garbage between packets")
        return [faults.damage(bytes(14)) for _ in range(5)]

    assert garbled(1) == garbled(1) != garbled(2)


def test_a_fault_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="no fault 'sick'; it has: silent, flipped bit"):
        Faults(0).inject("sick")


@pytest.mark.parametrize(("fault", "amount"), [("silent", 3.0), ("slow adapter", -0.1)])
def test_an_amount_that_cannot_be_is_refused(fault: str, amount: float) -> None:
    with pytest.raises(
        ValueError, match=rf"'{fault}' has no amount {amount:g}.*slow adapter \(0.016\)"
    ):
        Faults(0).inject(fault, amount=amount)
