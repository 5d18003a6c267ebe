"""What the firmware is in, beside moving or not, and what it calls that. Tables only."""

from __future__ import annotations

from enum import Enum


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
STUBBORN = frozenset({Mode.LOCKED, Mode.CRITICAL, Mode.HOMING, Mode.SLEEP})  # holds, resumes and overrides are ignored
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
