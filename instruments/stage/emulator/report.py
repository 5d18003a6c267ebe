"""How the emulated controller writes a status report, and which fields are due in it.

The two slow fields come with the first report after a reset, then every 10 to 30 reports, never together. It
may not know why anything is so. Source: the firmware's interface document, section on status reports.
"""

from __future__ import annotations

from instruments.stage.emulator.phases import Vector

_IDLE_EVERY = 10
_BUSY_WCO_EVERY = 30
_BUSY_OV_EVERY = 20


def numbers(place: Vector, inches: bool) -> str:
    """Three numbers as reports write them."""
    return ",".join(f"{value / 25.4 + 0.0:.4f}" if inches else f"{value + 0.0:.3f}" for value in place)


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
