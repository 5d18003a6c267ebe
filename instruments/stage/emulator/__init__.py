"""The motion stage's other end: a GRBL board with a carriage, as far as a driver can tell."""

from __future__ import annotations

from instruments.stage.emulator.board import Fault, StageEmulator
from instruments.stage.emulator.carriage import Mounting
from instruments.stage.emulator.store import CLASSIC, GRBL_HAL, Dialect

__all__ = ["CLASSIC", "GRBL_HAL", "Dialect", "Fault", "Mounting", "StageEmulator"]
