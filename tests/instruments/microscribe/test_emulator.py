"""The emulated arm, byte for byte, and what its mechanics put in."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from instruments.microscribe.kinematics import OutOfReachError, encoded
from instruments.microscribe.mechanics import KinematicError, Mechanics, workspace
from instruments.microscribe.protocol import PacketDecoder, State
from instruments.microscribe.unit import UNIT_40937
from tests.instruments.microscribe.bare_host import AT_REST, POINT, UP, Hand, Host

ARM = UNIT_40937.geometry()
HOME_RAD = ARM.angles(UNIT_40937.home)[0]


@pytest.fixture
def fresh() -> Iterator[Host]:
    host = Host()
    yield host
    host.close()
    assert not [thread.name for thread in threading.enumerate() if thread.name.endswith("emulator")]


@pytest.fixture
def host(fresh: Host) -> Host:
    fresh.session()
    return fresh


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ("03", AT_REST),
        ("83", AT_REST),
        ("01", "81 00 6C 4F 30 5E 35 54 20 02 18 79"),
        ("02", "82 00 6C 4F 30 5E 35 54 20 02 18 79 41 60 00 00"),
        ("00", "80 00"),
        ("07", "87 00 00 00 00 6C 4F 30 5E 35 54 20 02 18 79 41 60"),
        ("C8", "C8 4D 69 63 72 6F 53 63 72 69 62 65 33 44 00"),
        ("C9", "C9 4D 53 43 52 00"),
        ("CA", "CA 44 58 00"),
        ("CB", "CB 34 30 39 33 37 00"),
        ("CC", "CC 53 74 61 6E 64 61 72 64 2B 42 65 74 61 00"),
        ("CD", "CD 46 6F 72 6D 61 74 20 44 48 30 2E 35 00"),
        ("CE", "CE 48 43 49 20 32 2E 30 00"),
        ("C6", "C6 03 3F FF 00 00 00 00 00 00 00 00 00 3F FF 3F FF 1F FF 0F FF 0F FF 00 00"),
        (
            "C0",
            (
                "C0 24 00 00 3F F5 FF F9 3F E5 C0 02 C0 0C 00 00 03 C0 28 10 02 15 FE 6F 01 8F 20"
                " 6C FC 92 FF FD 24 1C 01 40 EB 66"
            ),
        ),
        ("D3", "D3 02 00 03"),
        ("C2", "C2"),
        ("C4 10", "C4"),
        ("C4 55", ""),
        ("D2 41", "D2 41"),
        ("C1", ""),
        ("13", ""),
        ("C5", "C5"),
        ("C5 03", "C5"),
        ("03 03", f"{AT_REST} {AT_REST}"),
    ],
)
def test_golden_answers_whole_and_byte_by_byte(host: Host, asked: str, answer: str) -> None:
    assert host.ask(asked) == answer
    if not asked.startswith("C5"):
        pieces = [host.ask(byte, 0.001) for byte in asked.split()]
        assert " ".join(piece for piece in pieces if piece) == answer


def test_outside_a_session_it_hears_its_words_only(fresh: Host) -> None:
    assert fresh.ask("03 C9 42 45 47 49 4E") == ""
    assert fresh.ask("49 4D 4D") == ""
    assert fresh.ask("43") == "49 4D 4D 43"
    assert fresh.ask("03") == ""
    assert fresh.ask("C5 42 45 47 49 4E") == ""
    assert fresh.arm.state is State.FINDING_BAUD


def test_a_time_stamp_counts_ticks_of_the_clock(host: Host) -> None:
    host.clock.sleep(10.0 - host.clock.now())
    ticks = PacketDecoder().feed(bytes.fromhex(host.ask("23")))[0].ticks
    assert ticks == int(10.0 / 0.001111)
    host.clock.sleep(18.3)
    later = PacketDecoder().feed(bytes.fromhex(host.ask("23")))[0].ticks
    assert later is not None
    assert later < 9001 + 200  # wrapped at about 18 s


def test_pedals(host: Host) -> None:
    host.arm.buttons = 0x06
    assert host.ask("00") == "80 02"


@pytest.mark.parametrize("asked", ["C2", "42"])
def test_homing_off_the_peg_ruins_every_later_position(host: Host, asked: str) -> None:
    host.hand.point = POINT
    before = host.counts()
    assert before != UNIT_40937.home
    assert host.ask(asked) == "C2"
    # the hand trembles
    assert np.abs(np.subtract(host.counts()[:5], UNIT_40937.home[:5])).max() <= 3
    host.hand.point = None
    assert host.counts() != UNIT_40937.home


def test_begin_in_a_live_session_homes_and_ends_it(host: Host) -> None:
    host.hand.point = POINT
    assert host.ask("42 45 47 49 4E") == "C2 C5"
    assert host.arm.state is State.FINDING_BAUD


def test_immc_in_a_live_session_asks_for_names_and_starts_an_eeprom_write(host: Host) -> None:
    names = "C9 4D 53 43 52 00", *["CD 46 6F 72 6D 61 74 20 44 48 30 2E 35 00"] * 2
    assert host.ask("49 4D 4D 43") == " ".join(names)
    assert host.arm.eeprom_attempts == 1


def test_the_letter_o_swallows_24_bytes(host: Host) -> None:
    assert host.ask("4F " + "03 " * 24) == "CF"  # a stream by differences, and nothing differs
    assert host.ask("03") == AT_REST
    assert host.ask("4F 00 00 02 " + "01 " * 23 + "03") == f"CF {AT_REST}"  # 26 with seven encoders


def test_a_stream_at_a_fixed_rate_until_any_command(host: Host) -> None:
    got = host.ask("CF 00 0A 03" + "00" * 21, 0.105)
    assert got == "CF" + f" {AT_REST}" * 10
    states = [host.arm.state]
    assert host.ask("D2 07", 0.001).startswith("D2 07")
    states.append(host.arm.state)
    host.ask("00", 0.001)
    assert [*states, host.arm.state] == [State.STREAMING, State.STREAMING, State.SESSION]
    assert host.ask("C9", 0.5) == "C9 4D 53 43 52 00"


def test_a_stream_without_delay_is_as_fast_as_the_wire(host: Host) -> None:
    packets = PacketDecoder(3).feed(bytes.fromhex(host.ask("CF 00 00 03" + "00" * 21, 1.0)))
    assert len(packets) == pytest.approx(823, abs=1)


def test_power_cycling_off_the_peg_gives_plausible_wrong_counts(host: Host) -> None:
    host.hand.point = POINT
    host.arm.power_cycle()
    assert host.ask("03") == ""
    host.session()
    assert np.abs(np.subtract(host.counts()[:5], UNIT_40937.home[:5])).max() <= 3


def test_without_power_there_is_silence(host: Host) -> None:
    host.arm.power_off()
    assert host.ask("C5 49 4D 4D 43") == ""
    host.arm.power_on()
    host.session()
    assert host.ask("03") == AT_REST


def test_a_session_outlives_its_host(host: Host) -> None:
    host.plug_in_again()
    assert host.ask("03") == AT_REST


@settings(max_examples=30, deadline=None)
@given(st.lists(st.binary(min_size=1, max_size=40), max_size=6))
def test_whatever_it_hears_it_can_be_signed_on_again(noise: list[bytes]) -> None:
    host = Host()
    try:
        for data in noise:
            host.ask(data.hex(), 0.001)
        host.ask("C5 " * 28)  # an unfinished stream command swallows 26 bytes
        host.session()
        assert len(host.counts()) == 6
    finally:
        host.close()


# Mechanics


def mechanics(
    hand: Hand, *, seed: int = 1, accuracy_mm: float = 0.0, tremor_mm: float = 0.0
) -> Mechanics:
    return Mechanics(
        ARM, UNIT_40937.home, hand, seed=seed, accuracy_mm=accuracy_mm, tremor_mm=tremor_mm
    )


def grip(x: float = -180.0, y: float = 240.0, z: float = 130.0) -> Hand:
    return Hand(np.array([x, y, z]))


def test_a_perfect_arm_stands_where_the_hand_holds_it() -> None:
    counts = mechanics(grip()).counts(1)
    np.testing.assert_allclose(ARM.forward(counts)[0], [POINT], atol=1e-6)
    assert np.linalg.norm(ARM.forward(encoded(counts))[0] - POINT) < 0.4


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_mean_error_over_the_workspace_is_what_was_asked_for(seed: int) -> None:
    error = KinematicError(ARM, HOME_RAD, seed=seed, accuracy_mm=0.23)
    poses = workspace(ARM, HOME_RAD, np.random.default_rng(99))
    # a shift of all would be another frame
    assert np.linalg.norm(error.at(poses).mean(axis=0)) < 0.02
    sizes = np.linalg.norm(error.at(poses), axis=1)
    assert sizes.mean() == pytest.approx(0.23, rel=0.04)
    assert sizes.max() < 1.0


def test_the_error_is_a_smooth_function_of_the_pose() -> None:
    error = KinematicError(ARM, HOME_RAD, seed=3, accuracy_mm=0.23)
    poses = workspace(ARM, HOME_RAD, np.random.default_rng(4))
    here, near = error.at(poses), error.at(poses + 0.005)  # about 3 mm at the tip
    assert np.linalg.norm(here - near, axis=1).max() < 0.01


def test_the_error_is_the_arms_not_the_packets() -> None:
    arm = mechanics(grip(), accuracy_mm=0.23)
    first, tip = arm.counts(1), ARM.forward(arm.counts(2))[0][0]
    np.testing.assert_array_equal(first, arm.counts(500))
    expected = KinematicError(ARM, HOME_RAD, seed=1, accuracy_mm=0.23).at(
        ARM.angles(mechanics(grip()).counts(1))
    )[0]
    np.testing.assert_allclose(tip - POINT, expected, atol=1e-6)


def test_rounded_counts_are_those_that_are_not_rounded_rounded() -> None:
    arm = mechanics(grip(), accuracy_mm=0.23, tremor_mm=0.05)
    for packet in (1, 2, 1023, 1024, 5000, 3):
        assert arm.whole(packet) == np.rint(arm.counts(packet)).tolist()
    assert mechanics(Hand()).whole(1) == list(UNIT_40937.home)


def test_the_tremor_has_the_size_asked_for_and_is_new_with_each_packet() -> None:
    arm = mechanics(grip(), tremor_mm=0.05)
    tips = ARM.forward([arm.counts(i) for i in range(3000)])[0]
    assert np.sqrt(np.mean(np.sum((tips - POINT) ** 2, axis=1))) == pytest.approx(0.05, rel=0.05)
    assert np.linalg.norm(tips.mean(axis=0) - POINT) < 0.005
    np.testing.assert_array_equal(arm.counts(7), mechanics(grip(), tremor_mm=0.05).counts(7))
    assert (arm.counts(7) != mechanics(grip(), seed=2, tremor_mm=0.05).counts(7)).any()


def test_what_the_arm_cannot_reach_is_told_beforehand(fresh: Host) -> None:
    fresh.arm.check_reach(POINT, UP)
    with pytest.raises(OutOfReachError, match="out of reach"):
        fresh.arm.check_reach(POINT * 5, UP)


@pytest.mark.parametrize("move", [lambda hand: None, lambda hand: setattr(hand, "point", None)])
def test_a_target_that_changes_is_followed(move: Callable[[Hand], None]) -> None:
    hand = grip()
    arm = mechanics(hand)
    arm.counts(1)
    hand.point = POINT + 5.0
    np.testing.assert_allclose(ARM.forward(arm.counts(2))[0], [POINT + 5.0], atol=1e-6)
    move(hand)
    expected = POINT + 5.0 if hand.point is not None else ARM.forward(UNIT_40937.home)[0][0]
    np.testing.assert_allclose(ARM.forward(arm.counts(3))[0], [expected], atol=1e-6)
