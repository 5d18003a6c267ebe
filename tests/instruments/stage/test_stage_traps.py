"""The traps that the fact sheet marks as seen on the firmware, and its alarms, byte by byte."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest

from instruments.stage.emulator import GRBL_HAL, Fault
from tests.instruments.stage.board import LOCK, WELCOME, Board

Make = Callable[..., Board]


def test_a_fresh_eeprom_speaks_of_an_error_first(make_board: Make) -> None:
    greeting = make_board(fresh_eeprom=True).greeting
    assert greeting.startswith(b"error:7\r\n$0=10\r\n$1=25\r\n")
    assert greeting.endswith(b"$132=50.000\r\n" + WELCOME + LOCK)


def test_failed_homing_gives_alarm_ok_and_a_welcome(board: Board) -> None:
    board.emulator.inject(Fault.NO_SWITCH)
    assert board.say(b"$H\n", 60.0) == b"ALARM:9\r\nok\r\n" + WELCOME + LOCK
    board.emulator.cure(Fault.NO_SWITCH)
    board.emulator.inject(Fault.STUCK_SWITCH)
    assert board.say(b"$H\n", 60.0) == b"ALARM:8\r\nok\r\n" + WELCOME + LOCK
    board.emulator.cure(Fault.STUCK_SWITCH)
    assert board.say(b"$H\n", 60.0) == b"ok\r\n"


def test_beyond_the_soft_limit_nothing_is_heard_until_a_reset(board: Board) -> None:
    board.answered_at(b"$H\n")
    assert board.say(b"G53G1X-301F1000\n") == b"ALARM:2\r\n[MSG:Reset to continue]\r\n"
    assert board.say(b"?\n$X\n?!~", 10.0) == b""
    assert board.say(b"\x18") == b"ok\r\n" + WELCOME + LOCK
    assert board.state() == b"Alarm"


def test_a_soft_limit_behind_a_move_stops_that_move_without_losing_steps(board: Board) -> None:
    board.answered_at(b"$H\n")
    assert board.say(b"G53G1X-200F3000\n", 1.0) == b"ok\r\n"
    assert board.say(b"G53G1X5\n", 1.0) == b"ALARM:2\r\n[MSG:Reset to continue]\r\n"
    board.say(b"\x18")
    report = board.say(b"?")
    place = float(re.findall(rb"MPos:([-\d.]+)", report)[0])
    assert place == pytest.approx(board.emulator.position_mm()[0], abs=0.005)
    assert -60 < place < -40


def test_grblhal_still_reports_in_that_alarm(make_board: Make) -> None:
    board = make_board(dialect=GRBL_HAL)
    assert board.greeting.startswith(b"\r\nGrblHAL 1.1f ['$' or '$HELP' for help]\r\n")
    board.answered_at(b"$H\n")
    board.say(b"G53G1X-301F1000\n")
    report = board.say(b"?")
    assert report.startswith(b"<Alarm|")
    assert b"|H:" in report


def test_grblhal_tells_of_a_buffer_that_holds_a_byte_less_and_knows_any_line_number(
    make_board: Make,
) -> None:
    board = make_board({10: 3, 20: 0}, dialect=GRBL_HAL)
    assert b"|Bf:35,1023|FS:" in board.say(b"?")
    assert b"[OPT:V,35,1024]" in board.say(b"$I\n")
    board.unlock()
    assert board.say(b"N99999999\n") == b"ok\r\n"


def test_a_board_that_restarts_after_a_failed_homing_loses_what_is_said_to_it(board: Board) -> None:
    board.emulator.inject(Fault.NO_SWITCH)
    board.links[-1].write(b"$H\n")
    assert board.links[-1].read_until(b"ALARM:9\r\n", 60.0).endswith(b"ALARM:9\r\n")
    assert board.say(b"?", 1.0) == b"ok\r\n" + WELCOME + LOCK
    assert board.state() == b"Alarm"


def test_a_reset_in_motion_is_alarm_3_and_one_at_rest_is_not(free: Board) -> None:
    assert free.say(b"\x18") == WELCOME
    free.say(b"G1X-50F3000\n", 0.5)
    assert free.say(b"\x18") == b"ALARM:3\r\n" + WELCOME + LOCK
    assert free.say(b"G1X0F100\n") == b"error:9\r\n"


def test_a_reset_at_a_hold_keeps_the_position_without_alarm(free: Board) -> None:
    free.say(b"G1X-50F3000\n", 0.5)
    free.say(b"!", 1.0)
    place = free.emulator.position_mm()
    assert free.say(b"\x18") == WELCOME
    report = free.say(b"?")
    assert report.startswith(b"<Idle|MPos:")
    assert float(re.findall(rb"MPos:([-\d.]+)", report)[0]) == pytest.approx(
        place[0] + 150, abs=0.005
    )


def test_resume_is_lost_while_the_stage_still_brakes(free: Board) -> None:
    free.say(b"G1X-100F3000\n", 1.0)
    free.say(b"!", 0.1)
    assert free.state() == b"Hold:1"
    free.say(b"~", 0.5)
    assert free.state() == b"Hold:0"
    free.say(b"~", 0.1)
    assert free.state() == b"Run"
    free.hear(5.0)
    assert free.emulator.position_mm()[0] == pytest.approx(-250.0)


def test_settings_and_homing_are_refused_in_motion(free: Board) -> None:
    free.say(b"G1X-50F3000\n", 0.5)
    assert free.say(b"$130=200\n$H\n$$\n$I\n") == b"error:8\r\n" * 4


def test_sleep_is_left_only_by_a_reset_and_into_the_alarm(free: Board) -> None:
    assert free.say(b"$SLP\n") == b"ok\r\n[MSG:Sleeping]\r\n"
    assert free.state() == b"Sleep"
    assert free.say(b"$X\nG1X1F100\n~", 1.0) == b""
    assert free.say(b"\x18") == WELCOME + LOCK
    assert free.state() == b"Alarm"


def test_blasting_blindly_mangles_lines_into_many_kinds_of_error(free: Board) -> None:
    """As recorded, where 1230 bytes gave 48 ``ok`` and six kinds of error; which ones depends on
    the moves that were sent.

    Bytes come at 115200 baud; where the planner is full and the buffer too, they are lost, and what
    is left joins up.
    """
    lines = b"".join(
        b"G1X%.3fY%.3fF3000\r\n" % (-(n % 2) * 0.004, -(n % 3) * 0.004) for n in range(60)
    )
    answers = b"".join(free.say(bytes([byte]), 10 / 115200) for byte in lines[:1230]) + free.hear(
        60.0
    )
    assert len(set(re.findall(rb"error:\d+", answers))) >= 3
    assert answers.count(b"\r\n") < 2 * lines[:1230].count(b"\n"), (
        "CR and LF end a line each; some were lost"
    )


def test_the_buffer_holds_exactly_128_bytes(free: Board) -> None:
    free.say(b"!")
    free.say(b"\n" * 127 + b"$I\n")  # of the last line only the first byte finds room
    assert free.say(b"~", 0.01) == b"ok\r\n" * 127
    assert free.say(b"G\n").startswith(b"[GC:G0 ")


def test_a_limit_switch_in_motion_is_alarm_1_and_deaf(free: Board) -> None:
    free.emulator.inject(Fault.LIMIT_HIT, 0.5)
    assert free.say(b"G1X-50F3000\nG4P0\n", 2.0) == b"ok\r\nALARM:1\r\n[MSG:Reset to continue]\r\n"
    assert free.say(b"?", 1.0) == b""
    assert free.say(b"\x18") == b"ok\r\n" + WELCOME + LOCK


def test_a_reset_while_homing_is_alarm_6(board: Board) -> None:
    board.say(b"$H\n", 3.0)
    assert board.say(b"\x18") == b"ALARM:6\r\nok\r\n" + WELCOME + LOCK
