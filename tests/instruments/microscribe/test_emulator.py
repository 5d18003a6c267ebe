"""The emulated arm, byte for byte, and what its mechanics put in."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from instruments.clock import RealClock, VirtualClock
from instruments.link import Link
from instruments.listener import Listener
from instruments.microscribe.configuration import StreamRequest
from instruments.microscribe.emulator import (
    ArmEmulator,
    KinematicError,
    Look,
    Mechanics,
    Trigger,
    workspace,
)
from instruments.microscribe.kinematics import OutOfReachError
from instruments.microscribe.protocol import PacketDecoder, State
from tests.instruments.microscribe.rigs import AT_REST, POINT, REPLIES, UNIT, UP, Hand, Host

ARM = UNIT.geometry()
HOME_RAD = ARM.angles(UNIT.home)[0]


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ("03", AT_REST),
        ("83", AT_REST),
        ("01", "81 00 6C 4F 30 5E 35 54 20 02 18 79"),
        ("02", "82 00 6C 4F 30 5E 35 54 20 02 18 79 41 60 00 00"),
        ("00", "80 00"),
        ("07", "87 00 00 00 00 6C 4F 30 5E 35 54 20 02 18 79 41 60"),
        *((f"{code:02X}", reply.hex(" ").upper()) for code, reply in REPLIES.items()),
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


def test_a_time_stamp_counts_ticks_of_the_clock(host: Host) -> None:
    host.clock.sleep(10.0 - host.clock.now())
    ticks = PacketDecoder().feed(bytes.fromhex(host.ask("23")))[0].ticks
    assert ticks == int(10.0 / 0.001111)
    host.clock.sleep(18.3)
    later = PacketDecoder().feed(bytes.fromhex(host.ask("23")))[0].ticks
    assert later is not None
    assert later < 9001 + 200  # wrapped at about 18 s


@pytest.mark.parametrize(
    ("words", "answer", "after", "eeprom_attempts"),
    [
        ("BEGIN", "C2 C5", State.FINDING_BAUD, 0),
        (
            "IMMC",
            "C9 4D 53 43 52 00" + " CD 46 6F 72 6D 61 74 20 44 48 30 2E 35 00" * 2,
            State.SESSION,
            1,
        ),
        ("B", "C2", State.SESSION, 0),
    ],
)
def test_words_in_a_live_session_are_commands_and_homing_off_the_peg_ruins_positions(
    host: Host, words: str, answer: str, after: State, eeprom_attempts: int
) -> None:
    host.hand.point = POINT
    assert host.counts() != UNIT.home
    assert host.ask(words.encode().hex()) == answer
    assert (host.arm.state, host.arm.eeprom_attempts) == (after, eeprom_attempts)
    if words == "B":  # the hand trembles
        assert np.abs(np.subtract(host.counts()[:5], UNIT.home[:5])).max() <= 3


def test_the_letter_o_swallows_24_bytes(host: Host) -> None:
    assert host.ask("4F " + "03 " * 24) == "CF"  # a stream by differences, and nothing differs
    assert host.ask("03") == AT_REST
    assert host.ask("4F 00 00 02 " + "01 " * 23 + "03") == f"CF {AT_REST}"  # 26 with seven encoders


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


# Streams


def stream(
    delay_ms: int, *, command: str = "03", mask: int = 0, deltas: tuple[int, ...] = (0,) * 6
) -> str:
    """The stream command, typed field by field as the sheet has it."""
    return (
        f"CF {delay_ms:04X} {command} {mask:02X} "
        + "00 " * 8
        + " ".join(f"{delta:04X}" for delta in deltas)
    )


@pytest.mark.parametrize(
    ("command", "rate_hz"),
    [("03", 822.9), ("01", 960.0), ("23", 720.0), ("00", 5760.0)],
    ids=["six encoders", "five", "time stamps", "buttons alone"],
)
def test_without_delay_a_stream_is_as_fast_as_115200_baud(
    host: Host, command: str, rate_hz: float
) -> None:
    assert len(host.packets(stream(0, command=command), 1.0)) == pytest.approx(rate_hz, abs=1)


def test_differences_send_when_a_joint_has_moved_so_far_and_not_else(host: Host) -> None:
    host.hand.point = POINT
    assert host.ask(stream(0, deltas=(20, 0, 0, 0, 0, 0)), 0.5) == "CF"
    start, counts = host.counts()[0], []
    host.ask(stream(0, deltas=(20, 0, 0, 0, 0, 0)))
    for step in range(60):
        host.hand.point = POINT + np.array([0.0, 0.5 * step, 0.0])
        counts += [packet.counts[0] for packet in host.packets("", 0.002)]
    moved = np.abs(np.diff([start, *counts]))
    assert len(counts) == 6, "the base turns by 3.1 degrees: 142 counts"
    assert (moved >= 20).all()
    assert (moved < 20 + 4).all(), "a step of the hand is 0.5 mm, some 4 counts at most"
    assert host.arm.state is State.STREAMING


def test_a_pedal_of_the_mask_sends_when_it_changes(host: Host) -> None:
    assert host.ask(stream(0, mask=0x01)) == "CF"
    seen = []
    for buttons in (1, 1, 0, 2, 3, 2, 0):
        host.arm.buttons = buttons
        seen += [packet.buttons & 1 for packet in host.packets("", 0.01)]
    assert seen == [1, 0, 1, 0]


def test_a_slow_drift_is_measured_from_the_last_packet() -> None:
    drift = [Look(0, (count % 16384,)) for count in range(16380, 16414)]
    trigger = Trigger(StreamRequest(0, 3, encoder_deltas=(5, 0, 0, 0, 0, 0)), drift[0])
    fired = [look.counts[0] for look in drift[1:] if trigger.fires(look)]
    assert fired == [1, 6, 11, 16, 21, 26], "counts go round at 16384"


def test_the_marker_comes_back_in_its_place_and_any_command_ends_a_stream(host: Host) -> None:
    assert host.ask(stream(10), 0.025) == f"CF {AT_REST} {AT_REST}"
    assert host.ask("D2 55", 0.025) == f"D2 55 {AT_REST} {AT_REST}"
    host.ask("C9", 0.0)
    assert host.arm.state is State.SESSION
    assert host.ask("", 1.0) == ""


def test_a_stream_goes_on_for_the_next_host(host: Host) -> None:
    host.ask(stream(10))
    host.plug_in_again()
    assert host.ask("", 0.105) == " ".join([AT_REST] * 10), (
        "the arm doesn't notice who is plugged in"
    )
    assert host.ask("03") == AT_REST
    assert host.ask("", 0.1) == ""


def test_a_stream_never_outruns_its_line() -> None:
    clock = RealClock()
    arm = ArmEmulator(Hand(clock), clock)
    listener = Listener(arm, clock, lock=threading.RLock(), name="arm", baud=9600)
    link = Link(listener.url, clock, who="host")
    for sent, length in (("49 4D 4D 43", 4), ("42 45 47 49 4E", 5), (stream(0), 1)):
        link.write(bytes.fromhex(sent))
        assert len(link.read(length, 5.0)) == length
    start = clock.now()
    got = link.read(14 * 20, 5.0)
    made, took_s = arm.packets, clock.now() - start
    assert made <= took_s / (14 * 10 / 9600) + 3, "what doesn't fit on the line isn't made"
    link.write(b"\xc5")
    got += link.read_until(b"\xc5", 5.0)
    assert len(PacketDecoder(0x03).feed(got)) == arm.packets, "and what was made arrives"
    link.close()
    listener.close()
    clock.close()


# Mechanics


def mechanics(
    hand: Hand, *, seed: int = 1, accuracy_mm: float = 0.0, tremor_mm: float = 0.0
) -> Mechanics:
    return Mechanics(ARM, UNIT.home, hand, seed=seed, accuracy_mm=accuracy_mm, tremor_mm=tremor_mm)


@pytest.fixture
def grip() -> Hand:
    return Hand(VirtualClock(), POINT)


def test_a_perfect_arm_stands_where_the_hand_holds_it_and_follows(grip: Hand) -> None:
    arm = mechanics(grip)
    for point in (POINT, POINT + 5.0):
        grip.point = point
        pose = arm.solve(point, UP)
        np.testing.assert_allclose(ARM.forward(pose.counts)[0], [point], atol=1e-6)
        assert arm.counts(1) == np.rint(pose.counts).tolist()
        assert np.linalg.norm(ARM.forward(arm.counts(2))[0] - point) < 0.4
    grip.point = None
    assert arm.counts(3) == UNIT.home


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_error_is_a_smooth_function_of_the_pose_of_the_size_asked_for(
    grip: Hand, seed: int
) -> None:
    error = KinematicError(ARM, HOME_RAD, seed=seed, accuracy_mm=0.23)
    poses = workspace(ARM, HOME_RAD, np.random.default_rng(99))
    here, near = error.at(poses), error.at(poses + 0.005)  # about 3 mm at the tip
    # a shift of all would be another frame
    assert np.linalg.norm(here.mean(axis=0)) < 0.02
    sizes = np.linalg.norm(here, axis=1)
    assert sizes.mean() == pytest.approx(0.23, rel=0.04)
    assert sizes.max() < 1.0
    assert np.linalg.norm(here - near, axis=1).max() < 0.01
    arm = mechanics(grip, seed=seed, accuracy_mm=0.23)
    assert arm.counts(1) == arm.counts(500)
    tip = ARM.forward(arm.solve(POINT, UP).counts)[0][0]
    expected = error.at(ARM.angles(mechanics(grip).solve(POINT, UP).counts))[0]
    np.testing.assert_allclose(tip - POINT, expected, atol=1e-6)


def test_the_tremor_has_the_size_asked_for_and_is_new_with_each_packet(grip: Hand) -> None:
    arm = mechanics(grip, tremor_mm=0.05)
    off = np.concatenate([arm.tremor(block) for block in range(3)])
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) == pytest.approx(0.05, rel=0.05)
    assert np.linalg.norm(off.mean(axis=0)) < 0.005
    pose = arm.solve(POINT, UP)
    for packet in (1, 2, 1023, 1024, 3):
        shaken = pose.counts + pose.counts_per_mm @ off[packet]
        assert arm.counts(packet) == np.rint(shaken).tolist()
        np.testing.assert_allclose(ARM.forward(shaken)[0][0] - POINT, off[packet], atol=1e-3)
    assert arm.counts(7) == mechanics(grip, tremor_mm=0.05).counts(7)
    assert (arm.tremor(0) != mechanics(grip, seed=2, tremor_mm=0.05).tremor(0)).any()


def test_what_the_arm_cannot_reach_is_told_beforehand(fresh: Host) -> None:
    fresh.arm.check_reach(POINT, UP)
    with pytest.raises(OutOfReachError, match="out of reach"):
        fresh.arm.check_reach(POINT * 5, UP)
