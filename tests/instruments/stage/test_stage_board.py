"""The emulated board, byte by byte: lines and their answers, homing, moves, reports; the traps that the fact
sheet marks as seen on the firmware; and every alarm and error that it lists."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import pytest

from instruments.clock import VirtualClock
from instruments.stage.emulator.board import StageEmulator, StageFault
from instruments.stage.emulator.store import GRBL_HAL, ZABER
from instruments.stage.protocol import codes
from tests.instruments.stage.board import LOCK, WELCOME, Board

Make = Callable[..., Board]


def test_settings(board: Board) -> None:
    lines = board.say(b"$$\n").split(b"\r\n")
    text = b"$20=1 $22=1 $27=1.000 $110=3000.000 $120=200.000 $130=300.000 $131=275.000 $132=50.000"
    assert set(text.split()) <= set(lines)
    assert lines[-2:] == [b"ok", b""]
    assert board.say(b"$130=250\n$$\n").count(b"$130=250.000") == 1


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        (b"(" + b"x" * 300 + b")", b"ok"),
        (b"G0" + b" " * 200, b"ok"),
        (b"G1X" + b"0" * 76, b"error:22"),
        (b"G1X" + b"0" * 77, b"error:11"),
        (b"G38.3X-1F600", b"[PRB:-1.000,0.000,0.000:0]\r\nok"),
        (b"G38.5X-1F600", b"ALARM:4\r\nok"),
        (b"G21\r", b"ok\r\nok"),  # both line ends are lines
    ],
)
def test_each_line_gets_its_one_answer(free: Board, line: bytes, answer: bytes) -> None:
    """What is no matter of its words, or moves; the words are in the witnesses."""
    assert free.say(line + b"\n", 5.0) == answer + b"\r\n"


def test_a_program_pauses_until_it_is_resumed(free: Board) -> None:
    assert free.say(b"G1X-10F600\nM0\nG21\n", 5.0) == b"ok\r\n"
    assert free.state() == b"Hold:0"
    assert free.say(b"~", 0.1) == b"ok\r\n" * 2
    assert free.state() == b"Idle"


def test_pins_that_are_active_are_reported(make_board: Make) -> None:
    board = make_board()
    board.emulator.inject(StageFault.PROBE_CLOSED)
    assert b"|Pn:P|" in board.say(b"?")
    board.emulator.cure(StageFault.PROBE_CLOSED)
    assert b"Pn:" not in board.say(b"?")
    board.say(b"$5=1\n")  # not as the switches are wired
    assert b"|Pn:XYZ" in board.say(b"?")
    assert board.say(b"$H\n", 60.0).startswith(b"ALARM:8\r\n")
    board.say(b"$X\n$5=0\n")
    assert board.answered_at(b"$H\n") > 1.0


def test_homing_answers_only_when_done_and_is_silent_until_then(board: Board) -> None:
    assert board.say(b"$H\n?", 5.0) == b""
    middle = board.emulator.position_mm()
    assert middle[2] == pytest.approx(-1.0)
    assert -150 < middle[0] < -1
    answer = board.hear(20.0)
    assert answer.startswith(b"<Home|MPos:-1.000,-1.000,-1.000|")
    assert answer.endswith(b">\r\nok\r\n")
    assert board.say(b"?") == b"<Idle|MPos:-1.000,-1.000,-1.000|FS:0,0|Ov:100,100,100>\r\n"
    assert board.emulator.position_mm() == pytest.approx([-1, -1, -1])


def test_a_hold_at_rest_waits_for_a_resume_and_keeps_lines_waiting(free: Board) -> None:
    assert free.say(b"!G21\n", 1.0) == b""
    assert free.state() == b"Hold:0"
    report, answer = free.say(b"~?", 0.01).split(b"\r\n")[:2]
    assert report.startswith(b"<Hold:0|"), "a report that is asked for in the same pass comes first"
    assert answer == b"ok"
    assert free.state() == b"Idle"


def test_the_door_stops_and_resumes(free: Board) -> None:
    assert free.say(b"G1X-10F600\n", 0.5) == b"ok\r\n"
    assert free.say(b"\x84", 0.02) == b"[MSG:Check Door]\r\n"
    assert free.state() == b"Door:2"
    free.hear(1.0)
    assert free.state() == b"Door:0"
    free.say(b"~", 5.0)
    assert free.state() == b"Idle"


def test_a_jog_beyond_the_travel_is_an_error_and_no_alarm(board: Board) -> None:
    board.answered_at(b"$H\n")
    assert board.say(b"$J=G91X5F1000\n") == b"error:15\r\n"
    assert board.state() == b"Idle"
    assert board.say(b"$J=G91X-50F3000\n", 0.5) == b"ok\r\n"
    assert board.state() == b"Jog"
    assert board.say(b"G1X-5F100\n") == b"error:9\r\n"
    board.say(b"\x85", 0.5)
    assert board.state() == b"Idle"
    assert -51 < board.emulator.position_mm()[0] < -10


def test_a_dwell_behind_a_move_is_answered_when_the_move_is_over(free: Board) -> None:
    assert free.answered_at(b"G1X-100F3000\n") == 0.0
    assert free.answered_at(b"G4P0\n") == pytest.approx(100 / 50 + 50 / 200, abs=1e-6)
    assert free.answered_at(b"G4P1.5\n") == pytest.approx(1.5, abs=1e-6)
    free.say(b"G1X-98F3000\n")
    assert free.answered_at(b"G4P0\n") == pytest.approx(2 * math.sqrt(2 / 200), abs=1e-6)


def test_position_and_speed_are_right_on_the_way(free: Board) -> None:
    free.say(b"G1X-100F3000\n", 1.25)
    state, place, speed, *_ = free.say(b"?").strip(b"<>\r\n").split(b"|")
    assert (state, speed) == (b"Run", b"FS:3000,0")
    x, y, z = (float(number) for number in place.removeprefix(b"MPos:").split(b","))
    assert x == pytest.approx(-56.25, abs=0.003)
    assert (y, z) == (0.0, 0.0)
    assert free.emulator.position_mm() == pytest.approx([-206.25, -137.5, -25.0])


def test_the_sixteenth_move_waits_for_a_free_place_in_the_planner(free: Board) -> None:
    # 160 bytes would not fit a waiting buffer
    lines = b"".join(b"G1X-%dF600\n" % (n + 1) for n in range(16))
    answers = free.say(lines)
    assert answers == b"ok\r\n" * 15
    assert free.hear(60.0) == b"ok\r\n"
    assert free.emulator.position_mm()[0] == pytest.approx(-166.0)


def test_slow_fields_come_first_after_a_reset_and_then_in_turn(free: Board) -> None:
    free.say(b"\x18")
    reports = [free.say(b"?") for _ in range(24)]
    assert [i for i, report in enumerate(reports) if b"WCO:" in report] == [0, 10, 20]
    assert [i for i, report in enumerate(reports) if b"Ov:" in report] == [1, 11, 21]


def test_a_fourth_axis_in_the_grblhal_dialect(make_board: Make) -> None:
    board = make_board(dialect=GRBL_HAL, axes=4)
    lines = board.say(b"$$\n").split(b"\r\n")
    text = b"$44=4 $45=3 $46=8 $103=100.000 $113=3600.000 $123=360.000 $133=360.000"
    assert set(text.split()) <= set(lines)
    assert lines == [*sorted(lines[:-2], key=lambda line: int(line[1:].split(b"=")[0])), b"ok", b""]
    assert b"|H:0|TLR:0>" in board.say(b"?")
    while board.state() != b"Idle":
        board.say(b"$H\n", 60.0)
    assert board.say(b"G53G1X-11A-91F6000\nG4P0\n", 60.0) == b"ok\r\nok\r\n"
    report = board.say(b"?")
    assert report.startswith(b"<Idle|MPos:-11.000,-1.000,-1.000,-91.000|FS:0,0|")
    assert report.endswith(b"|H:1|TLR:0>\r\n")
    assert board.emulator.position_mm() == pytest.approx([-11, -1, -1, -91])
    assert board.say(b"G53G1A-361\n", 5.0) == b"ALARM:2\r\n[MSG:Reset to continue]\r\n"
    assert b"|H:0|" in board.say(b"?")


def test_a_rotation_is_in_degrees_whatever_the_units(make_board: Make) -> None:
    board = make_board({20: 0, 13: 1}, dialect=GRBL_HAL, axes=4)
    board.unlock()
    board.say(b"G20G91G1X-1A-90F100\n", 120.0)
    assert board.emulator.position_mm() == pytest.approx([-175.4, -137.5, -25, -270], abs=0.01)
    assert b"MPos:-1.0000,0.0000,0.0000,-90.000|" in board.say(b"?")


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"axes": 4}, "Grbl has 3 to 3 axes, not 4"),
        ({"settings": {77: 1}}, r"\$77"),
        ({"settings": {103: 1}, "dialect": GRBL_HAL}, r"\$103"),
        ({"settings": {100: 0}, "dialect": ZABER}, r"Zaber needs \$100 above 0"),
    ],
)
def test_boards_that_are_not_built_are_refused(more: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        StageEmulator(VirtualClock(), **more)


def test_a_soft_limit_behind_a_move_stops_that_move_without_losing_steps(board: Board) -> None:
    board.answered_at(b"$H\n")
    assert board.say(b"G53G1X-200F3000\n", 1.0) == b"ok\r\n"
    assert board.say(b"G53G1X5\n", 1.0) == b"ALARM:2\r\n[MSG:Reset to continue]\r\n"
    board.say(b"\x18")
    report = board.say(b"?")
    place = float(re.findall(rb"MPos:([-\d.]+)", report)[0])
    assert place == pytest.approx(board.emulator.position_mm()[0], abs=0.005)
    assert -60 < place < -40


def test_grblhal_reports_in_that_alarm_and_knows_its_buffer_and_any_line_number(
    make_board: Make,
) -> None:
    board = make_board({10: 3}, dialect=GRBL_HAL)
    assert board.greeting.startswith(b"\r\nGrblHAL 1.1f ['$' or '$HELP' for help]\r\n")
    assert b"|Bf:35,1023|FS:" in board.say(b"?")
    assert b"[OPT:V,35,1024]" in board.say(b"$I\n")
    board.answered_at(b"$H\n")
    assert board.say(b"N99999999\n") == b"ok\r\n"
    board.say(b"G53G1X-301F1000\n")
    report = board.say(b"?")
    assert report.startswith(b"<Alarm|")
    assert b"|H:" in report


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


def test_the_buffer_holds_exactly_128_bytes(free: Board) -> None:
    free.say(b"!")
    free.say(b"\n" * 127 + b"$I\n")  # of the last line only the first byte finds room
    assert free.say(b"~", 0.01) == b"ok\r\n" * 127
    assert free.say(b"G\n").startswith(b"[GC:G0 ")


RESET_TO_GO_ON = b"[MSG:Reset to continue]\r\n"
HOMED = b"$H\n"
RESTARTED = b"ok\r\n" + WELCOME + LOCK


def _limit_by_lost_steps(board: Board) -> bytes:
    board.answered_at(HOMED)
    board.emulator.inject(StageFault.LOST_STEP, lost_mm=5.0)
    board.say(b"G53G1X-50F3000\n", 10.0)
    return board.say(b"G53G1X-1\n", 10.0)


def _soft_limit(board: Board) -> bytes:
    board.answered_at(HOMED)
    return board.say(b"G53G1Y1F3000\n", 10.0)


def _reset_in_motion(board: Board) -> bytes:
    board.say(b"$X\nG91\n")
    board.say(b"$20=0\nG1X-5F100\n", 0.5)
    return board.say(b"\x18")


def _homing(fault: StageFault | bytes) -> Callable[[Board], bytes]:
    """With a broken switch, or a byte that comes meanwhile."""

    def run(board: Board) -> bytes:
        if isinstance(fault, StageFault):
            board.emulator.inject(fault)
            return board.say(HOMED, 60.0)
        board.say(HOMED, 3.0)
        return board.say(fault)

    return run


def _probe(line: bytes, closed: bool = False) -> Callable[[Board], bytes]:
    def run(board: Board) -> bytes:
        board.answered_at(HOMED)
        if closed:
            board.emulator.inject(StageFault.PROBE_CLOSED)
        return board.say(line, 10.0)

    return run


CASES: list[tuple[int, Callable[[Board], bytes], bytes]] = [
    (1, _limit_by_lost_steps, b"ok\r\nALARM:1\r\n" + RESET_TO_GO_ON),
    (2, _soft_limit, b"ALARM:2\r\n" + RESET_TO_GO_ON),
    (3, _reset_in_motion, b"ALARM:3\r\n" + WELCOME + LOCK),
    (4, _probe(b"G38.2Z-5F100\n", True), b"ALARM:4\r\nok\r\n"),
    (4, _probe(b"G38.4Z-5F100\n"), b"ALARM:4\r\nok\r\n"),
    (5, _probe(b"G38.2Z-5F100\n"), b"ALARM:5\r\n[PRB:0.000,0.000,0.000:0]\r\nok\r\n"),
    (6, _homing(b"\x18"), b"ALARM:6\r\n" + RESTARTED),
    (7, _homing(b"\x84"), b"ALARM:7\r\n" + RESTARTED),
    (8, _homing(StageFault.STUCK_SWITCH), b"ALARM:8\r\n" + RESTARTED),
    (9, _homing(StageFault.NO_SWITCH), b"ALARM:9\r\n" + RESTARTED),
    (10, _homing(StageFault.CROOKED_GANTRY), b"ALARM:10\r\n" + RESTARTED),
]


@pytest.mark.parametrize(
    ("code", "bring_about", "answer"),
    CASES,
    ids=[f"alarm-{code}-{at}" for at, (code, _, _) in enumerate(CASES)],
)
def test_every_alarm_of_the_sheet(
    board: Board, code: int, bring_about: Callable[[Board], bytes], answer: bytes
) -> None:
    assert f"ALARM:{code}\r\n".encode() in answer
    assert bring_about(board) == answer
    if RESET_TO_GO_ON in answer:  # nothing is heard until a reset
        assert board.say(b"?\n$X\n?!~", 10.0) == b""
    assert board.say(b"\x18").endswith(WELCOME + LOCK)
    assert board.state() == b"Alarm"
    for fault in StageFault:
        board.emulator.cure(fault)
    board.answered_at(HOMED)
    assert board.state() == b"Idle"


def test_the_cases_are_the_sheets_and_a_crooked_gantry_is_another_number_in_grblhal(
    make_board: Make,
) -> None:
    assert {code for code, _, _ in CASES} == set(range(1, 11)) == codes()["alarms"].keys()
    board = make_board(dialect=GRBL_HAL)
    board.emulator.inject(StageFault.CROOKED_GANTRY)
    assert board.say(HOMED, 60.0).startswith(b"ALARM:15\r\nok\r\n")


def test_overrides_act_at_once(free: Board) -> None:
    free.say(b"G1X-100F3000\n", 0.5)
    free.say(b"\x92" * 5, 1.0)
    assert b"|FS:1500,0" in free.say(b"?")
    free.say(b"\x90", 1.0)
    assert b"|FS:3000,0" in free.say(b"?")
