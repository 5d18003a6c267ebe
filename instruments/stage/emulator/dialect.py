"""How the two firmwares differ, as far as a driver meets it. Facts only.

The classic firmware's are recorded. Of grblHAL, welcome, buffer size, more fields and the answer to ``?`` in alarm 2 are
recorded; the number of planner blocks, the fourth axis, the homing passes and the alarm of two motors out of square are from
that firmware's source.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Dialect:
    """A firmware: what it says after a reset, its buffers, what it adds to a status report, and what it can have."""

    name: str
    welcome: str
    build: str
    planner_blocks: int
    receive_bytes: int
    more_fields: bool  # grblHAL's H: (homed) and TLR: (tool length reference)
    always_reports: bool  # also while homing and in a critical alarm
    most_axes: int
    homing_passes: bool  # whether settings say which axes are homed in which pass
    crooked_alarm: int  # two motors of one axis found their switches too far apart

    def identity(self) -> list[str]:
        """As ``$I`` prints it."""
        return [f"[VER:{self.build}:]", f"[OPT:V,{self.planner_blocks},{self.receive_bytes}]"]


CLASSIC = Dialect("Grbl", "Grbl 1.1h ['$' for help]", "1.1h.20190830", 15, 128, False, False, 3, False, 10)
GRBL_HAL = Dialect("grblHAL", "GrblHAL 1.1f ['$' or '$HELP' for help]", "1.1f.20240101", 35, 1024, True, True, 4, True, 15)
