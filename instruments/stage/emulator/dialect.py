"""How the two firmwares differ, as far as a driver meets it. Facts only.

The classic firmware's are recorded. Of grblHAL, welcome, buffer size, more fields and the answer to ``?`` in alarm 2 are;
the number of planner blocks is that firmware's default.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Dialect:
    """A firmware: what it says after a reset, its buffers, and what it adds to a status report."""

    welcome: str
    build: str
    planner_blocks: int
    receive_bytes: int
    more_fields: str
    always_reports: bool

    def identity(self) -> list[str]:
        """As ``$I`` prints it."""
        return [f"[VER:{self.build}:]", f"[OPT:V,{self.planner_blocks},{self.receive_bytes}]"]


CLASSIC = Dialect("Grbl 1.1h ['$' for help]", "1.1h.20190830", 15, 128, "", False)
GRBL_HAL = Dialect("GrblHAL 1.1f ['$' or '$HELP' for help]", "1.1f.20240101", 35, 1024, "|H:0|TLR:0", True)
