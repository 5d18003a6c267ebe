"""The emulated boards' G-code: straight moves and dwells, with Grbl 1.1h's errors. The table is all
of it: any other code or word is error 20. Sources: the firmware's commands document, and its
parser's source for the order of its checks.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from instruments.stage.emulator.motion import Vector

AXES = "XYZA"
INCH_MM = 25.4
# each code's modal group; a line has at most one code of a group
CODES = {
    0: "motion", 1: "motion", 4: "once", 53: "once", 54: "system", 17: "plane",
    20: "units", 21: "units", 90: "distance", 91: "distance", 94: "feed mode",
}  # fmt: skip
_WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))?")


class RefusedError(Exception):
    """The line is refused with this error number."""


@dataclass(frozen=True, slots=True)
class Modes:
    """What stays for later lines."""

    motion: int = 0
    units: int = 21
    distance: int = 90
    feed_mm_min: float = 0.0

    @property
    def unit_mm(self) -> float:
        return INCH_MM if self.units == 20 else 1.0


class Move(NamedTuple):
    """A straight move; no ``feed_mm_min`` is as fast as possible."""

    target_mm: Vector
    feed_mm_min: float | None


class Dwell(NamedTuple):
    """Once all that is planned is over, wait."""

    seconds: float


class Line(NamedTuple):
    """A line taken apart: codes by modal group, words by letter."""

    codes: dict[str, int]
    words: dict[str, float]

    def modes(self, before: Modes) -> Modes:
        """What it leaves, but for its feed."""
        kept = self.codes.keys() & {"motion", "units", "distance"}
        changes: dict[str, Any] = {group: self.codes[group] for group in kept}
        return replace(before, **changes)


class GCode:
    """The parser's state on a board with ``axes``."""

    def __init__(self, axes: str, most_line_number: float) -> None:
        self.axes = axes
        self.most_line_number = most_line_number
        self.at_mm: Vector = (0.0,) * len(axes)  # where the last line leads to
        self.modes = Modes()

    def reset(self, at_mm: Vector) -> None:
        self.at_mm, self.modes = at_mm, Modes()

    def take(self, text: str) -> list[Move | Dwell]:
        """What a line asks for, and its modes set. Raises RefusedError."""
        line = self._read(text)
        modes, words = line.modes(self.modes), line.words
        if "F" in words:
            modes = replace(modes, feed_mm_min=words["F"] * modes.unit_mm)
        dwells, moves = line.codes.get("once") == 4, bool(words.keys() & set(self.axes))
        if dwells and "P" not in words:
            raise RefusedError(28)
        if modes.motion == 1 and (moves or "motion" in line.codes) and not modes.feed_mm_min:
            raise RefusedError(22)
        if "P" in words and not dwells:
            raise RefusedError(36)
        self.modes = modes
        actions: list[Move | Dwell] = [Dwell(words["P"])] if dwells else []
        if moves:
            self.at_mm = self._target(line, modes)
            actions.append(Move(self.at_mm, modes.feed_mm_min if modes.motion else None))
        return actions

    def jog(self, text: str) -> Move | None:
        """A jog's move. It leaves no mode behind. Raises RefusedError."""
        line = self._read(text)
        modes, feed = line.modes(self.modes), line.words.get("F")
        if not feed:
            raise RefusedError(22)
        if "P" in line.words and line.codes.get("once") != 4:
            raise RefusedError(36)
        if line.codes.keys() - {"units", "distance", "once"} or line.codes.get("once") == 4:
            raise RefusedError(16)
        moves = line.words.keys() & set(self.axes)
        return Move(self._target(line, modes), feed * modes.unit_mm) if moves else None

    def _target(self, line: Line, modes: Modes) -> Vector:
        """Machine coordinates; a rotation is in degrees."""
        target = list(self.at_mm)
        for at, axis in enumerate(self.axes):
            if (way := line.words.get(axis)) is not None:
                way *= modes.unit_mm if axis != "A" else 1.0
                target[at] = way + (target[at] if modes.distance == 91 else 0.0)
        return tuple(target)

    def _read(self, text: str) -> Line:
        """Take a line apart (capitals, no blanks). Raises RefusedError."""
        line, at = Line({}, {}), 0
        while at < len(text):
            found = _WORD.match(text, at)
            if found is None:
                raise RefusedError(1)
            letter, number, at = found[1], found[2], found.end()
            if number is None:
                raise RefusedError(2)
            if letter in "GM":
                _add_code(line, letter, float(number))
            elif letter not in self.axes + "FNP":
                raise RefusedError(20)
            elif letter in line.words:
                raise RefusedError(25)
            elif letter in "FNP" and float(number) < 0:
                raise RefusedError(4)
            else:
                line.words[letter] = float(number)
        if int(line.words.get("N", 0)) > self.most_line_number:
            raise RefusedError(27)
        return line


def _add_code(line: Line, letter: str, value: float) -> None:
    whole = int(value) & 0xFF  # as the firmware, in one byte
    group = CODES.get(whole) if letter == "G" else None
    part = round(100 * (value - whole)) & 0xFFFF
    if part and (group or letter == "M"):
        raise RefusedError(23)
    if group is None:
        raise RefusedError(20)
    if group in line.codes:
        raise RefusedError(24 if group == "motion" else 21)
    line.codes[group] = whole
