"""What can be made to go wrong with the emulated stage. Names and units only."""

from __future__ import annotations

from enum import Enum

from instruments.stage.emulator.homing import Switch


class Fault(Enum):
    """Faults by name. Those of a motion strike in the running motion, or in the next one."""

    SILENT = "silent"  # nothing is answered any more
    LOST_OK = "lost ok"  # the next answer to a line is swallowed
    LATE_OK = "late ok"  # the next answer to a line comes late
    GARBAGE = "garbage"  # noise on the line before the next answer to a line
    LIMIT_HIT = "limit hit"  # a limit switch closes in a motion
    DISCONNECT = "disconnect"  # the cable comes out in a motion
    # the motor stalls in a motion and the carriage stands; the controller counts on
    STALL = "stall"
    LOST_STEP = "lost step"  # the motor loses steps in a motion; the controller counts on
    RESTART = "restart"  # the power dips in a motion, and the controller starts anew
    NO_SWITCH = "no switch"  # X's homing switch never closes
    STUCK_SWITCH = "stuck switch"  # X's homing switch never opens again
    CROOKED_GANTRY = "crooked gantry"  # Y's two motors find their switches too far apart
    PROBE_CLOSED = "probe closed"  # the probe's contact is closed


IN_MOTION = frozenset(
    {Fault.LIMIT_HIT, Fault.DISCONNECT, Fault.STALL, Fault.LOST_STEP, Fault.RESTART}
)
# homing is there to hit switches, and heals lost steps
NOT_WHILE_HOMING = frozenset({Fault.LIMIT_HIT, Fault.LOST_STEP})
BROKEN_SWITCHES = {
    Fault.NO_SWITCH: (0, Switch.MISSING),
    Fault.STUCK_SWITCH: (0, Switch.STUCK),
    Fault.CROOKED_GANTRY: (1, Switch.CROOKED),
}
NOISE = b"\xff\x00<Ru|\x1b\r\n"
LOST_MM = 1.0  # lost by a lost step of which no amount is said
LATE_S = 3.0  # how late a late answer is of which no amount is said
_INTO = "s into the motion"
AMOUNTS = {  # what an amount of a fault is; others have none
    Fault.LOST_STEP: "mm lost",
    Fault.LATE_OK: "s late",
    Fault.LIMIT_HIT: _INTO,
    Fault.DISCONNECT: _INTO,
    Fault.STALL: _INTO,
    Fault.RESTART: _INTO,
}
