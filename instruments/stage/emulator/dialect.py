"""Differences between the two firmwares, and the names of their states. Tables only.

Classic GRBL's are recorded. Of grblHAL, welcome, buffer size, report fields and the answer to ``?``
in alarm 2 are recorded; planner blocks, fourth axis, homing passes and the out-of-square alarm are
from its source.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum


@dataclass(frozen=True, slots=True)
class Dialect:
    """A firmware's welcome, buffers, report fields and options (as `$I` prints them). grblHAL's
    receive buffer holds a byte less than it states.
    """

    name: str
    welcome: str
    build: str
    options: str
    planner_blocks: int
    receive_bytes: int
    more_fields: bool  # grblHAL's H: (homed) and TLR: (tool length reference)
    always_reports: bool  # also while homing and in a critical alarm
    most_axes: int
    homing_passes: bool  # whether settings say which axes are homed in which pass
    crooked_alarm: int  # two motors of one axis found their switches too far apart
    most_line_number: float

    def identity(self) -> list[str]:
        """As ``$I`` prints it."""
        return [f"[VER:{self.build}:]", f"[OPT:{self.options}]"]


CLASSIC = Dialect(
    name="Grbl",
    welcome="Grbl 1.1h ['$' for help]",
    build="1.1h.20190830",
    options="V,15,128",
    planner_blocks=15,
    receive_bytes=128,
    more_fields=False,
    always_reports=False,
    most_axes=3,
    homing_passes=False,
    crooked_alarm=10,
    most_line_number=10_000_000,
)
GRBL_HAL = Dialect(
    name="grblHAL",
    welcome="GrblHAL 1.1f ['$' or '$HELP' for help]",
    build="1.1f.20240101",
    options="V,35,1024",
    planner_blocks=35,
    receive_bytes=1023,
    more_fields=True,
    always_reports=True,
    most_axes=4,
    homing_passes=True,
    crooked_alarm=15,
    most_line_number=math.inf,
)


class Mode(Enum):
    """What the firmware is in, beside moving or not."""

    READY = "ready"
    LOCKED = "locked"
    CRITICAL = "critical"  # a limit alarm: nothing is heard until a reset
    HOMING = "homing"
    HOLD = "hold"
    DOOR = "door"
    SLEEP = "sleep"


DEAF = frozenset({Mode.CRITICAL, Mode.HOLD, Mode.DOOR, Mode.SLEEP})  # lines wait
# holds, resumes and overrides are ignored
STUBBORN = frozenset({Mode.LOCKED, Mode.CRITICAL, Mode.HOMING, Mode.SLEEP})
_NAMES: dict[Mode, tuple[str, str]] = {  # at rest, and while moving
    Mode.READY: ("Idle", "Run"),
    Mode.LOCKED: ("Alarm", "Alarm"),
    Mode.CRITICAL: ("Alarm", "Alarm"),
    Mode.HOMING: ("Home", "Home"),
    Mode.HOLD: ("Hold:0", "Hold:1"),
    Mode.DOOR: ("Door:0", "Door:2"),
    Mode.SLEEP: ("Sleep", "Sleep"),
}


def state_name(mode: Mode, *, moving: bool, jogging: bool) -> str:
    """As a status report names it."""
    return "Jog" if mode is Mode.READY and jogging else _NAMES[mode][moving]
