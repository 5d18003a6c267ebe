"""Every alarm and error that the fact sheet lists, made to come from the emulated board, with the
bytes around it.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from instruments.stage.alarm_texts import ALARMS, ERRORS
from instruments.stage.emulator import CLASSIC, GRBL_HAL, Dialect, Fault
from tests.instruments.stage.board import LOCK, WELCOME, Board

Make = Callable[..., Board]
RESET_TO_GO_ON = b"[MSG:Reset to continue]\r\n"
HOMED = b"$H\n"
RESTARTED = b"ok\r\n" + WELCOME + LOCK


def _limit_by_lost_steps(board: Board) -> bytes:
    board.answered_at(HOMED)
    board.say(b"G53G1X-50F3000\n", 10.0)
    board.emulator.lose_steps((5.0, 0.0, 0.0))
    return board.say(b"G53G1X-1\n", 10.0)


def _soft_limit(board: Board) -> bytes:
    board.answered_at(HOMED)
    return board.say(b"G53G1Y1F3000\n", 10.0)


def _reset_in_motion(board: Board) -> bytes:
    board.say(b"$X\nG91\n")
    board.say(b"$20=0\nG1X-5F100\n", 0.5)
    return board.say(b"\x18")


def _probe(line: bytes, closed: bool) -> Callable[[Board], bytes]:
    def run(board: Board) -> bytes:
        board.answered_at(HOMED)
        if closed:
            board.emulator.inject(Fault.PROBE_CLOSED)
        return board.say(line, 10.0)

    return run


def _homing(fault: Fault) -> Callable[[Board], bytes]:
    def run(board: Board) -> bytes:
        board.emulator.inject(fault)
        return board.say(HOMED, 60.0)

    return run


def _while_homing(byte: bytes) -> Callable[[Board], bytes]:
    def run(board: Board) -> bytes:
        board.say(HOMED, 3.0)
        return board.say(byte)

    return run


CASES: list[tuple[int, Callable[[Board], bytes], bytes]] = [
    (1, _limit_by_lost_steps, b"ok\r\nALARM:1\r\n" + RESET_TO_GO_ON),
    (2, _soft_limit, b"ALARM:2\r\n" + RESET_TO_GO_ON),
    (3, _reset_in_motion, b"ALARM:3\r\n" + WELCOME + LOCK),
    (4, _probe(b"G38.2Z-5F100\n", True), b"ALARM:4\r\nok\r\n"),
    (4, _probe(b"G38.4Z-5F100\n", False), b"ALARM:4\r\nok\r\n"),
    (5, _probe(b"G38.2Z-5F100\n", False), b"ALARM:5\r\n[PRB:-1.000,-1.000,-5.000:0]\r\nok\r\n"),
    (6, _while_homing(b"\x18"), b"ALARM:6\r\n" + RESTARTED),
    (7, _while_homing(b"\x84"), b"ALARM:7\r\n" + RESTARTED),
    (8, _homing(Fault.STUCK_SWITCH), b"ALARM:8\r\n" + RESTARTED),
    (9, _homing(Fault.NO_SWITCH), b"ALARM:9\r\n" + RESTARTED),
    (10, _homing(Fault.CROOKED_GANTRY), b"ALARM:10\r\n" + RESTARTED),
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
    assert board.say(b"\x18").endswith(WELCOME + LOCK)
    assert board.state() == b"Alarm"
    for fault in Fault:
        board.emulator.cure(fault)
    board.answered_at(HOMED)
    assert board.state() == b"Idle"


def test_the_cases_are_all_that_the_sheet_lists() -> None:
    assert {code for code, _, _ in CASES} == set(range(1, 11)) == ALARMS.keys()


def test_a_crooked_gantry_is_another_number_in_grblhal(make_board: Make) -> None:
    board = make_board(dialect=GRBL_HAL)
    board.emulator.inject(Fault.CROOKED_GANTRY)
    assert board.say(HOMED, 60.0).startswith(b"ALARM:15\r\nok\r\n")


ERROR_CASES: list[tuple[int, bytes]] = [
    (1, b"1X5\n"),
    (2, b"G1X\n"),
    (3, b"$999=1\n"),
    (5, b"$H\n"),
    (8, b"G1X-20F100\n$132=5\n"),
    (9, b"$J=G91X-20F100\nG1X1\n"),
    (10, b"$20=1\n"),
    (11, b"G1X" + b"1" * 80 + b"\n"),
    (15, b"$J=G91X999F100\n"),
    (20, b"G2X1Y1I1\n"),
    (22, b"G1X1\n"),
    (33, b"G38.2X0F100\n"),
]


@pytest.mark.parametrize("dialect", [CLASSIC, GRBL_HAL], ids=["grbl", "grblHAL"])
@pytest.mark.parametrize(("code", "lines"), ERROR_CASES)
def test_every_error_of_the_sheet(
    make_board: Make, dialect: Dialect, code: int, lines: bytes
) -> None:
    board = make_board({22: int(code == 15), 20: int(code == 15)}, dialect=dialect)
    if code == 15:
        board.answered_at(HOMED)
    assert board.say(lines).split(b"\r\n")[-2] == b"error:%d" % code
    assert code in ERRORS


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        (b"G38.2F100\n", b"error:26\r\n"),
        (b"G38.2X-5\n", b"error:22\r\n"),
        (b"G53G38.2X-5F100\n", b"error:30\r\n"),
        (b"G38.3X-1F600\n", b"[PRB:-1.000,0.000,0.000:0]\r\nok\r\n"),
        (b"G38.5X-1F600\n", b"ALARM:4\r\nok\r\n"),
        (b"G1A5F100\n", b"error:20\r\n"),
    ],
)
def test_probing_and_axes(free: Board, line: bytes, answer: bytes) -> None:
    assert free.say(line, 5.0) == answer
