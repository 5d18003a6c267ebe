"""Emulated Zaber devices on one chain, one an axis of the stage: written from the maker's ASCII
protocol manual, apart from the driver.

Unlike the real ones, whose axes go at once, planned moves here run one after the other. Marked as
inferred in the tests' script: the order of flags.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from instruments.stage.emulator.controller import Controller, Work

_COMMAND = re.compile(r"/(?:(\d+) ?)?(?:(\d+) ?)?(?:(\d+) ?)?([a-z][^:]*)?(?::([0-9A-F]{2}))?")
_MOVE = re.compile(r"move (?:(min|max)|(?:(abs|rel) (-?\d+)))(?: (\d+))?")
# the most serious first
ORDER = ("FE", "FS", "WL", "WM", "WR", "WH", "NI")
SPEED = 1.6384
VERSION, SERIAL = "7.38", 65000
OWN_SPEEDS = (7, 25)  # the firmware from which a move may have one
DEVICE_ID = 99_999  # of no product: what this emulates is in no data base of the maker's


class ZaberController(Controller):
    """A device an axis: the first moves X. Steps ($100 to $103) are microsteps."""

    def power_up(self) -> None:
        super().power_up()
        self._flags: list[set[str]] = [{"WR"} for _ in range(self.settings.axes)]
        # mm by axis: a parked one keeps its position without power
        self._parked: dict[int, float] = getattr(self, "_parked", {})
        for axis, place_mm in self._parked.items():
            self.offset_mm[axis] = place_mm
            self.homed.add(axis)
            self._flags[axis].clear()
        self._to_home: list[int] = []
        self._homing: Iterator[float] | None = None
        # the usual one: settings have mm/min
        self._maxspeed = [
            round(self.settings[110 + axis] / 60 * self.settings[100 + axis] * SPEED)
            for axis in range(self.settings.axes)
        ]

    def alarm(self, code: int, *, critical: bool = False) -> None:  # noqa: ARG002 - as Grbl's
        self.carriage.halt(self.now)
        self._to_home.clear()
        for flags in self._flags:
            flags.add("FE" if code == 1 else "FS")
        self.homed.clear()
        self.drop()

    def work(self, text: str) -> Work:
        """A command is answered at once; homing goes on behind the answers."""
        if text.isascii() and (found := _COMMAND.fullmatch(text)):
            device, axis, number, words, check = found.groups()
            head = text[1:].partition(":")[0]
            if check in (None, f"{-sum(head.encode('ascii')) & 0xFF:02X}"):
                for at in range(self.settings.axes):
                    if int(device or 0) in (0, at + 1):
                        self._command(at, int(axis or 0), number, (words or "").strip())
        yield from ()
        return None

    def pump(self) -> None:
        super().pump()
        if self._homing is None and self._to_home:
            self._homing = self.run_home([self._to_home[0]])
        if self._homing is not None:
            try:
                self._due_s = next(self._homing)
            except StopIteration:
                self._homing = None
                if self._to_home:
                    axis = self._to_home.pop(0)
                    self._flags[axis] -= {"WR", "WH", "FS", "FE"} if axis in self.homed else set()
                    self.pump()

    def _command(self, at: int, axis: int, number: str | None, words: str) -> None:
        taken, data = (False, "BADAXIS") if axis > 1 else self._do(at, words)
        sent = f" {int(number):02d}" if number else ""
        here, there = self.place_mm(), self.target_mm()
        moving = self.carriage.motion.moving(self.now) and here[at] != there[at]
        busy = "BUSY" if moving or at in self._to_home else "IDLE"
        flag = next((one for one in ORDER if one in self._flags[at]), "--")
        self._answer(f"@{at + 1:02d} {axis}{sent} {'OK' if taken else 'RJ'} {busy} {flag} {data}")

    def _do(self, at: int, words: str) -> tuple[bool, str]:
        match words.split():
            case []:
                return True, "0"
            case ["get", name]:
                said = self._get(at, name)
                return said is not None, said or "BADCOMMAND"
            case ["set", "maxspeed", value] if value.isdigit() and int(value):
                self._maxspeed[at] = int(value)
            case ["move", *_] if moves := _MOVE.fullmatch(words):
                return self._move(at, *moves.groups())
            case ["tools", "parking", "park" | "unpark" as how]:
                return self._park(at, how)
            case ["home"]:
                self._parked.pop(at, None)
                self._to_home.append(at)
                self._flags[at] -= {"NI"}
            case ["stop"]:
                self._stop(at)
            case ["warnings", "clear"]:
                self._flags[at] &= {"WR", "WH"}
            case ["warnings"]:
                flags = [one for one in ORDER if one in self._flags[at]]
                return True, " ".join([f"{len(flags):02d}", *flags])
            case _:
                return False, "BADCOMMAND"
        return True, "0"

    def _move(
        self, at: int, end: str | None, way: str | None, by: str | None, speed: str | None
    ) -> tuple[bool, str]:
        """To an end, or so many microsteps, perhaps at a speed of its own."""
        if at in self._parked:
            return False, "PARKED"
        (low, high), steps, target = self._ends(at), self.settings[100 + at], [*self.target_mm()]
        starts = {"abs": 0, "rel": round(target[at] * steps), "min": low, "max": high}
        place, pace = starts[end or way or ""] + int(by or 0), int(speed or self._maxspeed[at])
        if speed and tuple(map(int, VERSION.split("."))) < OWN_SPEEDS:
            return False, "BADDATA"
        if not (low <= place <= high and pace > 0):
            return False, "BADDATA"
        target[at] = place / steps
        self._flags[at] -= {"NI"}
        self.go(tuple(target), pace / SPEED / steps)
        return True, "0"

    def _park(self, at: int, how: str) -> tuple[bool, str]:
        """Keep the position of an axis that stands; all moves but homing are refused then."""
        if how == "unpark":
            self._parked.pop(at, None)
            return True, "0"
        if self._flags[at] & {"WR", "WH"}:
            return False, "BADDATA"
        if self.moving or self._homing is not None:
            return False, "STATUSBUSY"
        self._parked[at] = self.place_mm()[at]
        return True, "0"

    def _stop(self, at: int) -> None:
        if self._homing is not None:
            self.carriage.halt(self.now)
            self._homing = None
        elif self.carriage.moving(self.now):
            self.carriage.follow(self.now).cancel(self.now)
        self._to_home.clear()
        self._flags[at].add("NI")

    def _get(self, at: int, name: str) -> str | None:
        low, high = self._ends(at)
        steps = self.settings[100 + at]
        figures = {
            "pos": round(self.place_mm()[at] * steps),
            "limit.min": low,
            "limit.max": high,
            "maxspeed": self._maxspeed[at],
            "accel": round(self.settings[120 + at] * steps * SPEED / 10_000),
            "deviceid": DEVICE_ID,
            "device.id": DEVICE_ID,
            "parking.state": int(at in self._parked),
            "system.axiscount": 1,
            "system.serial": SERIAL + at,
            "version": VERSION,
        }
        return str(figures[name]) if name in figures else None

    def _ends(self, at: int) -> tuple[int, int]:
        low, high = (round(ends[at] * self.settings[100 + at]) for ends in self.settings.ends_mm)
        return low, high
