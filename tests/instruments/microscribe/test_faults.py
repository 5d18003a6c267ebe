"""What goes wrong with the emulated arm by name, byte for byte."""

from __future__ import annotations

import numpy as np
import pytest

from instruments.errors import LinkError
from instruments.microscribe.faults import AMOUNTS, Fault, Faults
from instruments.microscribe.protocol import State
from tests.instruments.microscribe.rigs import AT_REST, POINT, UNIT, Host


def bits_apart(a: str, b: str) -> int:
    return sum((x ^ y).bit_count() for x, y in zip(bytes.fromhex(a), bytes.fromhex(b), strict=True))


def test_a_bad_cable(host: Host) -> None:
    host.arm.faults.inject("bit 7 in payload", 1)
    assert len([b for b in bytes.fromhex(host.ask("03")) if b & 0x80]) == 2
    host.arm.faults.inject("lost byte", 1)
    assert len(bytes.fromhex(host.ask("03"))) == 13
    host.arm.faults.inject("flipped bit", 1)
    assert bits_apart(host.ask("03"), AT_REST) == 1
    host.arm.faults.inject("garbage between packets", 1)
    got = host.ask("03")
    assert got.endswith(AT_REST)
    assert len(got) == len(AT_REST) + 5 * 3
    host.arm.faults.inject("silent", 2)
    assert [host.ask("03"), host.ask("03"), host.ask("03")] == ["", "", AT_REST]


def test_a_fault_may_spare_the_first_answers(host: Host) -> None:
    host.arm.faults.inject("bit 7 in payload", 2, after=3)
    whole = [host.ask("03") == AT_REST for _ in range(7)]
    assert whole == [True] * 3 + [False] * 2 + [True] * 2


@pytest.mark.parametrize(("fault", "left"), [("flipped bit", 37), ("lost byte", 37)])
def test_replies_have_no_checksum_either(host: Host, fault: str, left: int) -> None:
    right = bytes.fromhex(host.ask("C0"))
    host.arm.faults.inject(fault, 1)
    wrong = bytes.fromhex(host.ask("C0"))
    assert wrong != right
    assert len(wrong) - (fault == "flipped bit") == left
    assert bytes.fromhex(host.ask("C0")) == right


def test_a_byte_lost_to_the_arm_makes_it_wait_for_one_more(host: Host) -> None:
    host.arm.faults.inject("lost byte to the arm", 1)
    assert host.ask("03") == ""
    assert host.ask("03") == AT_REST
    host.arm.faults.inject("lost byte to the arm", 1)
    assert host.ask("D2 41") in ("", "87 00 00 00 00 " + AT_REST[6:]), (
        "the marker's code or its value, which is no command"
    )


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


def test_an_old_session_ends_at_c5(fresh: Host) -> None:
    fresh.arm.faults.inject("old session alive", 1)
    fresh.plug_in_again()
    assert fresh.ask("C5 49 4D 4D 43") == "C5 49 4D 4D 43"


def test_at_another_rate_nothing_is_understood(fresh: Host) -> None:
    fresh.arm.faults.inject("wrong baud", 3)
    noise = [fresh.ask("C5 49 4D 4D 43") for _ in range(3)]
    assert all(len(bytes.fromhex(got)) == 5 for got in noise)
    assert len({*noise}) == 3
    assert fresh.arm.state is State.FINDING_BAUD
    fresh.session()


def test_an_echo_only_after_repeats(fresh: Host) -> None:
    fresh.arm.faults.inject("echo after repeats", amount=4)
    assert [fresh.ask("C5 49 4D 4D 43") for _ in range(3)] == [""] * 3
    fresh.session()
    assert fresh.ask("C5") == "C5"
    assert fresh.ask("49 4D 4D 43" * 3) == "", "again so many in the next sign-on"
    fresh.arm.faults.clear("echo after repeats")
    assert fresh.ask("C5 49 4D 4D 43") == "49 4D 4D 43"


def test_surplus_echoes(fresh: Host) -> None:
    fresh.arm.faults.inject("surplus echoes", 1)
    assert fresh.ask("49 4D 4D 43") == " ".join(["49 4D 4D 43"] * 3)
    assert fresh.ask("49 4D 4D 43") == "49 4D 4D 43"


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


def test_a_session_left_alive_needs_power(fresh: Host) -> None:
    fresh.arm.faults.inject("power loss")
    fresh.arm.faults.inject("old session alive")
    fresh.plug_in_again()
    fresh.arm.faults.clear("power loss")
    assert fresh.arm.state is State.FINDING_BAUD
    assert fresh.ask("03") == ""


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


def test_the_cable_breaks_behind_a_slow_adapter(host: Host) -> None:
    host.arm.faults.inject("slow adapter")
    host.arm.faults.inject("disconnect", amount=6)
    host.link.write(b"\x03")
    start = host.clock.now()
    assert host.link.read(6, 1.0).hex(" ").upper() == AT_REST[:17]
    assert host.clock.now() - start == pytest.approx(0.016)
    with pytest.raises(LinkError, match="hung up"):
        host.link.receive(1.0)


def test_the_same_seed_gives_the_same_damage() -> None:
    def garbled(seed: int) -> list[bytes]:
        faults = Faults(seed)
        faults.inject("flipped bit")
        faults.inject("garbage between packets")
        return [faults.damage(bytes(14)) for _ in range(5)]

    assert garbled(1) == garbled(1) != garbled(2)


def test_the_interface_box_and_a_block_of_another_length(fresh: Host) -> None:
    fresh.arm.faults.inject("IBOX", 1)
    fresh.ask("49 4D 4D 43")
    assert fresh.ask("42 45 47 49 4E") == "49 42 4F 58 00"
    fresh.arm.faults.inject("parameter block of another length", 1)
    assert fresh.ask("C0").startswith("C0 22 00 00 3F F5")
    assert fresh.ask("C0").startswith("C0 24 00 00 3F F5")


def test_a_fault_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="no fault 'sick'; it has: silent, flipped bit"):
        Faults(0).inject("sick")


@pytest.mark.parametrize(("fault", "amount"), [("silent", 3.0), ("slow adapter", -0.1)])
def test_an_amount_that_cannot_be_is_refused(fault: str, amount: float) -> None:
    with pytest.raises(
        ValueError, match=rf"'{fault}' has no amount {amount:g}.*slow adapter \(0.016\)"
    ):
        Faults(0).inject(fault, amount=amount)


def test_faults_tell_that_they_come_and_go() -> None:
    told: list[tuple[Fault, bool]] = []
    faults = Faults(0, lambda fault, on: told.append((fault, on)))
    faults.clear("power loss")
    faults.inject("power loss")
    faults.clear("power loss")
    assert told == [(Fault.POWER_LOSS, True), (Fault.POWER_LOSS, False)]


def test_an_amount_is_the_usual_one_unless_told() -> None:
    faults = Faults(0)
    faults.inject("slow adapter", amount=0.1)
    assert faults.amount(Fault.SLOW_ADAPTER) == 0.1
    faults.inject("slow adapter")
    assert faults.amount(Fault.SLOW_ADAPTER) == AMOUNTS[Fault.SLOW_ADAPTER] == 0.016
