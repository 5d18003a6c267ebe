"""What can be made to go wrong with the emulated stage. Names only."""

from __future__ import annotations

from enum import Enum


class Fault(Enum):
    """Faults by name. Those of a motion strike in the running motion, or in the next one."""

    SILENT = "silent"  # nothing is answered any more
    LOST_OK = "lost ok"  # the next answer to a line is swallowed
    LATE_OK = "late ok"  # the next answer to a line comes late
    GARBAGE = "garbage"  # noise on the line before the next answer to a line
    LIMIT_HIT = "limit hit"  # a limit switch closes in a motion
    DISCONNECT = "disconnect"  # the cable comes out in a motion
    STALL = "stall"  # the motor stalls in a motion and the carriage stands; the controller counts on
    RESTART = "restart"  # the power dips in a motion, and the controller starts anew
    NO_SWITCH = "no switch"  # X's homing switch never closes
    STUCK_SWITCH = "stuck switch"  # X's homing switch never opens again


IN_MOTION = frozenset({Fault.LIMIT_HIT, Fault.DISCONNECT, Fault.STALL, Fault.RESTART})
NOISE = b"\xff\x00<Ru|\x1b\r\n"
