"""The emulated status report and which fields are due in it.

The two slow fields come first after a reset, then every 10 to 30 reports, never together. Source:
the firmware's interface document.
"""

from __future__ import annotations

from typing import Protocol

from instruments.stage.emulator.carriage import Carriage
from instruments.stage.emulator.dialect import Dialect, Mode, state_name
from instruments.stage.emulator.gcode import Modes
from instruments.stage.emulator.motion import Vector
from instruments.stage.emulator.store import Store

_IDLE_EVERY = 10
_BUSY_WCO_EVERY = 30
_BUSY_OV_EVERY = 20


def numbers(place: Vector, inches: bool) -> str:
    """The axes' numbers as reports write them; the rotation A is in degrees whatever the units."""
    return ",".join(
        [
            f"{v / 25.4 + 0.0:.4f}" if inches and axis < 3 else f"{v + 0.0:.3f}"
            for axis, v in enumerate(place)
        ]
    )


class SlowFields:
    """Counts reports and says which slow field is due."""

    def __init__(self) -> None:
        self._until_wco = 0
        self._until_ov = 0

    def wco_changed(self) -> None:
        """The offset goes into the next report."""
        self._until_wco = 0

    def due(self, busy: bool) -> str | None:
        """``WCO`` or ``Ov`` if it is this report's turn."""
        if self._until_wco == 0:
            self._until_wco = (_BUSY_WCO_EVERY if busy else _IDLE_EVERY) - 1
            self._until_ov = max(self._until_ov, 1)
            due = "WCO"
        else:
            self._until_wco -= 1
            due = None
        if self._until_ov > 0:
            self._until_ov -= 1
            return due
        self._until_ov = (_BUSY_OV_EVERY if busy else _IDLE_EVERY) - 1
        return "Ov"


class Reporting(Protocol):
    """The board, as far as a report tells of it."""

    settings: Store
    dialect: Dialect
    carriage: Carriage
    modes: Modes
    slow: SlowFields
    mode: Mode
    homed: bool

    @property
    def now(self) -> float: ...
    @property
    def moving(self) -> bool: ...
    @property
    def jogging(self) -> bool: ...
    @property
    def room(self) -> int: ...


def status_report(board: Reporting) -> str:
    """A status report, as ``?`` gets it."""
    now, bits, moving = board.now, int(board.settings[10]), board.moving
    inches, offset = bool(board.settings[13]), board.modes.offset_mm
    place = board.settings.whole_steps(board.carriage.count_mm(now))
    work = tuple([at - zero for at, zero in zip(place, offset, strict=True)])
    parts = [state_name(board.mode, moving=moving, jogging=board.jogging)]
    parts.append(f"MPos:{numbers(place, inches)}" if bits & 1 else f"WPos:{numbers(work, inches)}")
    if bits & 2:
        parts.append(
            f"Bf:{board.dialect.planner_blocks - len(board.carriage.blocks(now))},{board.room}"
        )
    parts.append(f"FS:{board.carriage.speed_mm_s(now) * 60:.0f},0")
    due = board.slow.due(moving or board.mode in (Mode.HOLD, Mode.DOOR))
    if due == "WCO":
        parts.append(f"WCO:{numbers(offset, inches)}")
    elif due == "Ov":
        parts.append("Ov:{},{},100".format(*board.carriage.percent))
    if board.dialect.more_fields:
        parts += [f"H:{int(board.homed)}", "TLR:0"]
    return f"<{'|'.join(parts)}>"
