"""What one line does to the board: G-code, ``$`` commands, jogs and homing, each as a generator.

Yields the moment at which to resume (``inf``: only after a reset); returns the error code, 0 for
``ok``, or None for a restart.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import Protocol

from instruments.stage.emulator.carriage import Carriage
from instruments.stage.emulator.dialect import Dialect
from instruments.stage.emulator.gcode import Dwell, GcodeError, Modes, Move, Probe, command, jog
from instruments.stage.emulator.homing import Switch
from instruments.stage.emulator.motion import SOON_S, Vector
from instruments.stage.emulator.receiver import OVERFLOW
from instruments.stage.emulator.report import SlowFields, numbers
from instruments.stage.emulator.store import Store

_ANSWERS = {OVERFLOW: 11, "": 0}
Task = Generator[float, None, int | None]
Wait = Generator[float, None, None]
_HELP = "[HLP:$$ $G $I $x=val $J=line $SLP $X $H ~ ! ? ctrl-x]"


class Board(Protocol):
    """The firmware as a line sees it."""

    settings: Store
    dialect: Dialect
    carriage: Carriage
    broken_switches: dict[int, Switch]
    probe_closed: bool
    modes: Modes
    slow: SlowFields
    asked_while_homing: bool
    jogged: bool

    @property
    def now(self) -> float: ...
    @property
    def moving(self) -> bool: ...
    @property
    def jogging(self) -> bool: ...
    @property
    def locked(self) -> bool: ...
    def say(self, text: str) -> None: ...
    def status(self) -> str: ...
    def unlock(self) -> None: ...
    def sleep(self) -> None: ...
    def set_homing(self, on: bool) -> None: ...
    def alarm(self, code: int, *, critical: bool = False) -> None: ...


def execute(board: Board, text: str) -> Task:
    """Run one line (capitals, no blanks)."""
    if text in _ANSWERS:
        return _ANSWERS[text]
    if text.startswith("$J="):
        return (yield from _jog(board, text[3:]))
    if text.startswith("$"):
        return (yield from _system(board, text[1:]))
    if board.locked or board.jogging:
        return 9
    try:
        modes, what = command(
            text, board.modes, board.carriage.target_mm, board.dialect.most_line_number
        )
    except GcodeError as error:
        return error.code
    if modes.offset_mm != board.modes.offset_mm:
        board.slow.wco_changed()
    board.modes = modes
    if isinstance(what, Dwell):
        yield from _dwell(board, what.seconds)
    elif isinstance(what, Probe):
        yield from _probe(board, what)
    elif what:
        yield from _move(board, what)
    return 0


def _dwell(board: Board, seconds: float) -> Wait:
    yield from _until_still(board)
    end = board.now + seconds
    while board.now < end - SOON_S:
        yield end


def _move(board: Board, move: Move) -> Wait:
    if board.settings[20] and board.settings.beyond_travel(move.target_mm):
        yield from _soft_limit(board)
    yield from _plan(board, move)
    board.jogged = False


def _probe(board: Board, probe: Probe) -> Wait:
    """To the end of the way, for nothing ever touches this board's probe."""
    yield from _until_still(board)
    if board.probe_closed is not probe.away:
        board.alarm(4)
        return
    yield from _move(board, probe.move)
    yield from _until_still(board)
    if probe.must:
        board.alarm(5)
    board.say(f"[PRB:{numbers(board.carriage.count_mm(board.now), inches=False)}:0]")


def _soft_limit(board: Board) -> Wait:
    """Come to a stand without losing steps, then be deaf until a reset."""
    board.carriage.cancel(board.now)
    yield from _until_still(board)
    board.alarm(2, critical=True)
    while True:
        yield math.inf


def _plan(board: Board, move: Move) -> Wait:
    while len(board.carriage.blocks(now := board.now)) >= board.dialect.planner_blocks:
        yield board.carriage.due_s(now)
    feed = None if move.feed_mm_min is None else move.feed_mm_min / 60
    board.carriage.go(
        board.settings.whole_steps(move.target_mm), feed, board.settings.rates, board.now
    )


def _until_still(board: Board) -> Wait:
    while board.carriage.moving(now := board.now):
        yield board.carriage.due_s(now)


def _jog(board: Board, text: str) -> Task:
    if board.locked or (board.moving and not board.jogged):
        return 8
    try:
        move = jog(text, board.modes, board.carriage.target_mm, board.dialect.most_line_number)
    except GcodeError as error:
        return error.code
    if move is None:
        return 0
    if board.settings[20] and board.settings.beyond_travel(move.target_mm):
        return 15
    yield from _plan(board, move)
    board.jogged = True
    return 0


def _system(board: Board, text: str) -> Task:
    if text == "X":
        if board.locked:
            board.unlock()
            board.say("[MSG:Caution: Unlocked]")
        return 0
    if text in ("G", ""):
        board.say(board.modes.describe() if text else _HELP)
        return 0
    if board.moving:
        return 8
    if text == "H":
        return (yield from _home(board))
    if text == "SLP":
        board.sleep()
        return 0
    if text in ("$", "I"):
        for line in board.settings.lines() if text == "$" else board.dialect.identity():
            board.say(line)
        return 0
    return _write(board, text)


def _write(board: Board, text: str) -> int:
    """``n=value``."""
    number, equals, value = text.partition("=")
    if not number[:1].isdigit():
        return 2
    try:
        return board.settings.write(float(number), float(value)) if equals else 3
    except ValueError:
        return 2


def _home_mm(board: Board) -> Vector:
    return board.settings.whole_steps(
        board.settings.homing.home_mm(board.carriage.count_mm(board.now))
    )


def _home(board: Board) -> Task:
    if not board.settings[22]:
        return 5
    board.carriage.start_homing(board.settings.homing, board.broken_switches, board.now)
    board.set_homing(True)
    while not board.carriage.homing_over(board.now):
        yield board.carriage.due_s(board.now)
    alarm = board.carriage.finish_homing(_home_mm(board), board.now)
    if alarm:
        board.alarm(alarm)
        return None
    if board.asked_while_homing:
        board.asked_while_homing = False
        board.say(board.status())
    board.set_homing(False)
    return 0
