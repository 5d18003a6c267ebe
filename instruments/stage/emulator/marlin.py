"""An emulated Marlin board with EMERGENCY_PARSER: written from its G-code documentation and source,
apart from the driver.

Lines are answered with ``ok`` in order. M410 and M112 act when their line has come, and M410 is
then answered in its turn. Targets beyond the soft endstops are clipped without a message. Marked as
inferred in the tests' script: how often it says that it is busy.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

from instruments.stage.emulator.controller import Controller, Work
from instruments.stage.emulator.motion import SOON_S

KEEPALIVE_S = 2
_WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))?")
FIRMWARE = (
    "FIRMWARE_NAME:Marlin 2.1.2.4 (Mar  4 2024 12:00:00) SOURCE_CODE_URL:github.com/MarlinFirmware/"
    "Marlin PROTOCOL_VERSION:1.0 MACHINE_TYPE:stage EXTRUDER_COUNT:1"
    " UUID:cede2a2f-41a2-4748-9b12-c55c62f367ff"
)
CAPABILITIES = ("EEPROM:1", "AUTOREPORT_TEMP:1", "EMERGENCY_PARSER:1", "SDCARD:0")
BOOT = (
    "start",
    "echo: External Reset",
    "Marlin 2.1.2.4",
    "echo: Last Updated: 2024-03-04 | Author: (none, default config)",
    "echo: Free Memory: 3769  PlannerBufferBytes: 1152",
    "echo:Hardcoded Default Settings Loaded",
)
KILLED = "Error:Printer halted. kill() called!"


class MarlinController(Controller):
    """One board: X, Y, Z."""

    def power_up(self) -> None:
        super().power_up()
        for line in BOOT:
            self.say(line)
        self.halted = False
        self._keepalive_s = KEEPALIVE_S
        self._relative = False
        self._feed_mm_min = 1500.0

    def alarm(self, code: int, *, critical: bool = False) -> None:  # noqa: ARG002 - as Grbl's
        self.carriage.halt(self.now)
        if code > 1:
            self.say("echo:Homing Failed")
        self.say(KILLED)
        self.drop()
        self.halted = True

    def take(self, data: bytes) -> None:
        if not self.halted:
            super().take(data)

    def seen(self, text: str) -> None:
        if text.startswith("M112"):
            self.say("echo:M112 Shutdown")
            self.alarm(1)
        elif text.startswith("M410"):
            self.carriage.halt(self.now)

    def work(self, text: str) -> Work:
        if self.halted or not text:
            return None
        name, _, rest = text.partition(" ")
        found = _WORD.findall(rest.upper())
        words = {letter: float(number or 0) for letter, number in found}  # no number counts as 0
        match name:
            case "G0" | "G1":
                yield from self._move(words)
            case "G28":
                asked = [axis for axis, letter in enumerate("XYZ") if letter in words]
                yield from self._busy(self.until_still())
                yield from self._busy(self.run_home(asked or [0, 1, 2]))
            case "M400" | "G4":
                yield from self._busy(self.until_still())
            case "G90" | "G91":
                self._relative = name == "G91"
            case "M113" if "S" in words:
                self._keepalive_s = min(60, int(words["S"]) & 0xFF)
            case "M118":
                self.say(re.sub(r"^E1 ", "echo:", rest))
            case "M115" | "M503" | "M211" | "M114" | "M113":
                self._report(name)
            case "G21" | "M17" | "M84" | "M410" | "M112" | "M108":
                pass
            case _:
                self.say(f'echo:Unknown command: "{text}"')
        return None if self.halted else "ok"

    def _report(self, name: str) -> None:
        steps, rates, accels = (
            [self.settings[n + axis] for axis in range(3)] for n in (100, 110, 120)
        )
        match name:
            case "M114":
                counts = [round(at * each) for at, each in zip(self.place_mm(), steps, strict=True)]
                sent = "X:{:.2f} Y:{:.2f} Z:{:.2f} E:0.00".format(*self.target_mm())
                self.say(f"{sent} Count X:{counts[0]} Y:{counts[1]} Z:{counts[2]}")
            case "M115":
                for line in (FIRMWARE, *(f"Cap:{one}" for one in CAPABILITIES)):
                    self.say(line)
            case "M113":
                self.say(f"echo:M113 S{self._keepalive_s}")
            case "M211":
                words = "X{:.2f} Y{:.2f} Z{:.2f}"
                low, high = (words.format(*ends) for ends in self.settings.ends_mm)
                self.say("  M211 S1 ; ON")
                self.say(f"  Min:  {low}   Max:  {high}")
            case "M503":
                self.say("echo:; Linear Units:")
                self.say("echo:  G21 ; (mm)")
                mm_s = [rate / 60 for rate in rates]
                for code, each, e in (
                    ("M92", steps, 93),
                    ("M203", mm_s, 25),
                    ("M201", accels, 10000),
                ):
                    figures = "X{:.2f} Y{:.2f} Z{:.2f} E{:.2f}".format(*each, e)
                    self.say(f"echo:  {code} {figures}")
                self.say("echo:; Home offset:")
                self.say("echo:  M206 X0.00 Y0.00 Z0.00")

    def _move(self, words: dict[str, float]) -> Iterator[float]:
        self._feed_mm_min = words.get("F", self._feed_mm_min)
        axes = [axis for axis, letter in enumerate("XYZ") if letter in words]
        if unhomed := "".join("XYZ"[axis] for axis in axes if axis not in self.homed):
            self.say(f"echo:Home {unhomed} First")
            return
        target = list(self.target_mm())
        low, high = self.settings.ends_mm
        for axis in axes:
            wanted = words["XYZ"[axis]] + (target[axis] if self._relative else 0.0)
            target[axis] = min(max(wanted, low[axis]), high[axis])
        yield from self.plan(target, self._feed_mm_min / 60)

    def _busy(self, work: Iterator[float]) -> Iterator[float]:
        """``work``, with a message every few seconds that it goes on."""
        every_s = self._keepalive_s or math.inf  # 0 is off
        say_s = self.now + every_s
        for due_s in work:
            while self.now < due_s - SOON_S and self.moving:
                yield min(due_s, say_s)
                if self.now >= say_s - SOON_S:
                    self.say("echo:busy: processing")
                    say_s += every_s
