"""Emulated Zaber devices by entry point: ``url = "emulator:zaber?devices=1,2&microsteps=250,250"``.
The first device moves X, the second Y, the third Z, the fourth A.
"""

from __future__ import annotations

from instruments.clock import Clock
from instruments.errors import LimitError
from instruments.stage.emulator.board import StageEmulator
from instruments.stage.emulator.store import ZABER

LETTERS = "XYZA"
# 100 mm/s and 1 m/s², homing at half of it
SETTINGS = {24: 600.0, 25: 3000.0} | dict.fromkeys((110, 111, 112), 6000.0)
SETTINGS |= dict.fromkeys((120, 121, 122), 1000.0)


class EmulatedZaber(StageEmulator):
    """Of the keys that its driver has too, ``devices`` has to name those that are there."""

    def __init__(
        self, world: object, clock: Clock, devices: str, microsteps: str, axes: str = "XY"
    ) -> None:
        del world  # nothing of the world moves a stage
        numbers = [LETTERS.find(axis) + 1 for axis in axes]
        there = [str(number) for number in numbers]
        if [one.removesuffix(".1") for one in devices.split(",")] != there:
            what = f"the emulated devices of {axes} are {','.join(there)}"
            raise LimitError("emulated Zaber", what, asked=devices, hint="Correct devices.")
        steps = zip(numbers, map(float, microsteps.split(",")), strict=True)
        settings = SETTINGS | {99 + number: each for number, each in steps}
        super().__init__(clock, settings=settings, dialect=ZABER, axes=4 if "A" in axes else 3)
