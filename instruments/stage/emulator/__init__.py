"""The motion stage's other end: a controller with a carriage, as far as a driver can tell."""

from __future__ import annotations

from instruments.stage.emulator.board import StageEmulator, StageFault
from instruments.stage.emulator.carriage import Mounting
from instruments.stage.emulator.store import (
    CLASSIC,
    EMULATED,
    FLUIDNC,
    GRBL_HAL,
    MARLIN,
    ZABER,
    Dialect,
)

__all__ = [
    "CLASSIC",
    "EMULATED",
    "FLUIDNC",
    "GRBL_HAL",
    "MARLIN",
    "ZABER",
    "Dialect",
    "Mounting",
    "StageEmulator",
    "StageFault",
]
