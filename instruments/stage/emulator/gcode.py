"""Grbl 1.1h's G-code: a line to what is to be done, or to the number of its error.

Supported: G0 to G3, G4, G10, G17 to G21, G28, G30 (and .1), G38.2 to G38.5, G40, G43.1, G49,
G53 to G59, G61, G80, G90, G91 (and .1), G92 (and .1), G93, G94, M0 to M5, M8, M9, M30, and the
words A (of boards with four axes) F I J K L N P R S T X Y Z. The table is all of it: what isn't
there is error 20. Spindle, coolant, tool and path do nothing here; arcs are run as chords. Sources:
the firmware's commands document, and its parser's source for the order of its checks.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

from instruments.stage.emulator.motion import Vector

AXES = "XYZA"
INCH_MM = 25.4
MOST_TOOL = 255
CHORD_RAD = math.radians(10)
_WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))?")
_NOT_NEGATIVE = "FNPST"


class GcodeError(Exception):
    """The line is refused with this error number."""


class GroupedCode(NamedTuple):
    """A modal group, the hundredths that a number may have, the error for others, and what a line's
    axis words are for: at most one code of a line has a use for them.
    """

    group: str
    parts: tuple[int, ...] = (0,)
    error: int = 23
    axes: str = ""


CODES: dict[str, dict[int, GroupedCode]] = {
    "G": {
        **dict.fromkeys((0, 1, 2, 3), GroupedCode("motion", axes="motion")),
        4: GroupedCode("other"),
        10: GroupedCode("other", axes="other"),
        **dict.fromkeys((17, 18, 19), GroupedCode("plane")),
        **dict.fromkeys((20, 21), GroupedCode("units")),
        **dict.fromkeys((28, 30, 92), GroupedCode("other", (0, 10), 20, "other")),
        38: GroupedCode("motion", (20, 30, 40, 50), 20, "motion"),
        40: GroupedCode("cutter"),
        43: GroupedCode("tool", (10,), 20, "tool"),
        49: GroupedCode("tool", tuple(range(100)), axes="tool"),
        53: GroupedCode("other"),
        **dict.fromkeys(range(54, 60), GroupedCode("system")),
        61: GroupedCode("path", error=20),
        80: GroupedCode("motion"),
        90: GroupedCode("distance", error=20),
        91: GroupedCode("distance", (0, 10), 20),
        **dict.fromkeys((93, 94), GroupedCode("feed_mode")),
    },
    "M": {
        **dict.fromkeys((0, 1, 2, 30), GroupedCode("program")),
        **dict.fromkeys((3, 4, 5), GroupedCode("spindle")),
        **dict.fromkeys((8, 9), GroupedCode("coolant")),
    },
}


@dataclass(frozen=True, slots=True)
class Modes:
    """What stays for later lines, by modal group; ``tool_mm``: the tool's length."""

    motion: float = 0
    system: float = 54
    plane: float = 17
    units: float = 21
    distance: float = 90
    feed_mode: float = 94
    spindle: float = 5
    coolant: float = 9
    tool_number: int = 0
    feed: float = 0.0
    speed: float = 0.0
    tool_mm: float = 0.0

    def __str__(self) -> str:
        g = (self.motion, self.system, self.plane, self.units, self.distance, self.feed_mode)
        codes = " ".join(f"G{code:g}" for code in g)
        return f"{codes} M{self.spindle:g} M{self.coolant:g} T{self.tool_number}"

    @property
    def unit_mm(self) -> float:
        return INCH_MM if self.units == 20 else 1.0


GROUPS = frozenset(field.name for field in fields(Modes))
# what M2 and M30 set back
PROGRAM_END = {"motion": 1, "plane": 17, "distance": 90, "feed_mode": 94, "system": 54}
PROGRAM_END |= {"spindle": 5, "coolant": 9}


class StraightMove(NamedTuple):
    """A straight move; no ``feed_mm_min`` is as fast as possible."""

    target_mm: Vector
    feed_mm_min: float | None


class Probing(NamedTuple):
    """A straight move to the probe's contact, or ``away`` from it; ``strict``: it has to change."""

    target_mm: Vector
    feed_mm_min: float
    away: bool
    strict: bool


class Dwell(NamedTuple):
    """Once all that is planned is over, wait."""

    seconds: float


class Flow(NamedTuple):
    """Once all that is planned is over, a program's pause, or its end."""

    end: bool


Action = StraightMove | Probing | Dwell | Flow


@dataclass(slots=True)
class ParsedLine:
    """A line taken apart: codes by modal group, words by letter, and its axis words' use."""

    codes: dict[str, float]
    words: dict[str, float]
    axes: str = ""

    @property
    def other(self) -> float | None:
        return self.codes.get("other")


def read_line(text: str, axes: str, most_line_number: float) -> ParsedLine:
    """Take a line apart (capitals, no blanks). Raises GcodeError."""
    line, at = ParsedLine({}, {}), 0
    while at < len(text):
        found = _WORD.match(text, at)
        if found is None:
            raise GcodeError(1)
        letter, number, at = found[1], found[2], found.end()
        if number is None:
            raise GcodeError(2)
        if letter in CODES:
            _add_code(line, letter, float(number))
        elif letter in axes or letter in "FIJKLNPRST":
            _add_word(line, letter, float(number))
        else:
            raise GcodeError(20)
    if not line.axes and line.words.keys() & set(axes):
        line.axes = "motion"
    if int(line.words.get("N", 0)) > most_line_number:
        raise GcodeError(27)
    return line


def _add_code(line: ParsedLine, letter: str, value: float) -> None:
    whole = int(value) & 0xFF  # as the firmware, in one byte
    part = round(100 * (value - whole)) & 0xFFFF
    if letter == "M" and part:
        raise GcodeError(23)
    code = CODES[letter].get(whole)
    if code is None:
        raise GcodeError(20)
    if code.axes and (code.axes != "other" or not part):
        if line.axes:
            raise GcodeError(24)
        line.axes = code.axes
    if part not in code.parts:
        raise GcodeError(code.error)
    group = "arc distance" if whole == 91 and part else code.group
    if group in line.codes:
        raise GcodeError(21)
    line.codes[group] = whole + (part / 100 if whole != 49 else 0)


def _add_word(line: ParsedLine, letter: str, value: float) -> None:
    if letter == "T" and value > MOST_TOOL:
        raise GcodeError(38)
    if letter in line.words:
        raise GcodeError(25)
    if letter in _NOT_NEGATIVE and value < 0:
        raise GcodeError(4)
    line.words[letter] = value


class GCode:
    """The parser's state on a board with ``axes``: modes, and parameters that survive a reset."""

    def __init__(self, axes: str, most_line_number: float) -> None:
        self.axes = axes
        self.most_line_number = most_line_number
        self.restore()
        self.reset()

    def restore(self) -> None:
        """Set all parameters back: the origins of G54 to G59, and the places of G28 and G30."""
        zero = (0.0,) * len(self.axes)
        self.stored: dict[float, Vector] = dict.fromkeys((*range(54, 60), 28, 30), zero)

    def reset(self) -> None:
        """As after a reset: parameters stay."""
        self.modes = Modes()
        self.g92_mm: Vector = (0.0,) * len(self.axes)
        self.at_mm: Vector = self.g92_mm  # where the last line leads to, machine coordinates
        self.offset_changed = True

    def offset_mm(self, modes: Modes | None = None) -> Vector:
        """Work zero in machine coordinates."""
        modes = modes or self.modes
        pairs = zip(self.stored[modes.system], self.g92_mm, strict=True)
        offset = [origin + more for origin, more in pairs]
        offset[2] += modes.tool_mm
        return tuple(offset)

    def take(self, text: str) -> list[Action]:
        """What a line asks for, and its modes and offsets set. Raises GcodeError."""
        line = read_line(text, self.axes, self.most_line_number)
        modes = self._after(line)
        modes = replace(modes, feed=self._feed(line, modes))
        target = self._checked(line, modes)
        self._check_unused(line, modes, "FNST")
        actions: list[Action] = []
        before, words = self.modes, self._words(line)
        if line.other == 4:
            actions.append(Dwell(line.words["P"]))
        elif (before.spindle, before.coolant) != (modes.spindle, modes.coolant):
            actions.append(Dwell(0.0))
        if line.axes == "tool":
            modes = replace(modes, tool_mm=target[2] if line.codes["tool"] == 43.1 else 0.0)
        self.offset_changed |= before.tool_mm != modes.tool_mm or before.system != modes.system
        self.modes = modes
        if line.other in (28, 30):
            actions += self._homewards(line, target)
        elif line.other is not None:
            actions += self._set(line, target)
        if line.axes == "motion" and words and modes.motion != 80:
            actions += self._motion(line, target)
            self.at_mm = target
        program = line.codes.get("program", 1)
        if program != 1:
            actions.append(Flow(end=program != 0))
        if program > 1:
            self.modes, self.offset_changed = replace(modes, **PROGRAM_END), True
        return actions

    def jog(self, text: str) -> StraightMove | None:
        """A jog's move. It leaves no mode behind. Raises GcodeError."""
        line = read_line(text, self.axes, self.most_line_number)
        modes = replace(self._after(line), motion=line.codes.get("motion", 1), feed_mode=94)
        if "F" not in line.words:
            raise GcodeError(22)
        feed = line.words["F"] * modes.unit_mm
        target = self._checked(line, replace(modes, feed=feed))
        self._check_unused(line, modes, "FN")
        if line.codes.keys() - {"units", "distance", "other"} or line.other not in (None, 53):
            raise GcodeError(16)
        return StraightMove(target, feed) if self._words(line) else None

    def _after(self, line: ParsedLine) -> Modes:
        modes = {group: code for group, code in line.codes.items() if group in GROUPS}
        number = int(line.words.get("T", 0))
        speed = line.words.get("S", self.modes.speed)
        return replace(self.modes, tool_number=number, speed=speed, **modes)

    def _feed(self, line: ParsedLine, modes: Modes) -> float:
        """mm/min, or moves a minute with G93, which each move states anew."""
        given = line.words.get("F")
        if modes.feed_mode == 93:
            if given is None and line.axes == "motion" and modes.motion not in (0, 80):
                raise GcodeError(22)
            return given or 0.0
        if self.modes.feed_mode == 93:
            return given or 0.0
        return self.modes.feed if given is None else given * modes.unit_mm

    def _words(self, line: ParsedLine) -> dict[int, float]:
        """The line's axis words, by axis."""
        return {at: line.words[axis] for at, axis in enumerate(self.axes) if axis in line.words}

    def _checked(self, line: ParsedLine, modes: Modes) -> Vector:
        """Where the axis words lead to, with the firmware's checks in its order."""
        words = self._words(line)
        if line.other == 4 and "P" not in line.words:
            raise GcodeError(28)
        if line.codes.get("tool") == 43.1 and words.keys() != {2}:
            raise GcodeError(37)
        target = self._target(line, modes, words)
        if line.other == 10:
            self._check_system(line, words)
        elif line.other == 92 and not words:
            raise GcodeError(26)
        elif line.other == 53 and modes.motion not in (0, 1):
            raise GcodeError(30)
        if modes.motion == 80 and words:
            raise GcodeError(31)
        if modes.motion != 80 and line.axes == "motion" and modes.motion != 0:
            self._check_motion(line, modes, words, target)
        return target

    def _target(self, line: ParsedLine, modes: Modes, words: dict[int, float]) -> Vector:
        """Words in mm; of G10, G43.1 and G92 as they stand, else in machine coordinates."""
        plain = line.axes == "tool" or line.other in (10, 53, 92)
        offset, target = self.offset_mm(modes), list(self.at_mm)
        for axis, value in words.items():
            value *= modes.unit_mm if axis < 3 else 1.0  # a rotation is in degrees
            if plain:
                target[axis] = value
            else:
                target[axis] = value + (self.at_mm if modes.distance == 91 else offset)[axis]
        return tuple(target)

    def _check_system(self, line: ParsedLine, words: dict[int, float]) -> None:
        if not words:
            raise GcodeError(26)
        if not line.words.keys() & {"P", "L"}:
            raise GcodeError(28)
        if int(line.words.get("P", 0)) > 6:
            raise GcodeError(29)
        kind = int(line.words.get("L", 0))
        if kind not in (2, 20) or (kind == 2 and "R" in line.words):
            raise GcodeError(20)

    def _check_motion(
        self, line: ParsedLine, modes: Modes, words: dict[int, float], target: Vector
    ) -> None:
        if not modes.feed:
            raise GcodeError(22)
        if modes.motion == 1:
            return
        if not words:
            raise GcodeError(26)
        if modes.motion in (2, 3):
            plane = _plane(modes)
            if not words.keys() & set(plane):
                raise GcodeError(32)
            self._centre(line, modes, target)
        elif target == self.at_mm:
            raise GcodeError(33)

    def _centre(self, line: ParsedLine, modes: Modes, target: Vector) -> tuple[float, float]:
        """The arc's centre in its plane, less where it begins. Raises GcodeError."""
        first, second = _plane(modes)
        x, y = target[first] - self.at_mm[first], target[second] - self.at_mm[second]
        if "R" in line.words:
            if target == self.at_mm:
                raise GcodeError(33)
            radius = line.words["R"] * modes.unit_mm
            square = 4 * radius**2 - x * x - y * y
            if square < 0:
                raise GcodeError(34)
            side = math.sqrt(square) / (math.hypot(x, y) or math.inf) / 2
            side = side if (modes.motion == 2) == (radius < 0) else -side
            return x / 2 - side * y, y / 2 + side * x
        i, j = (line.words.get("IJK"[axis]) for axis in (first, second))
        if i is None and j is None:
            raise GcodeError(35)
        i, j = (i or 0.0) * modes.unit_mm, (j or 0.0) * modes.unit_mm
        radius = math.hypot(i, j)
        off = abs(math.hypot(x - i, y - j) - radius)
        if off > 0.5 or off > max(0.005, 0.001 * radius):
            raise GcodeError(33)
        return i, j

    def _check_unused(self, line: ParsedLine, modes: Modes, single: str) -> None:
        used = set(single) | (set(self.axes) if line.axes else set())
        if line.other in (4, 10):
            used |= {"P", "L"} if line.other == 10 else {"P"}
        if line.axes == "motion" and modes.motion in (2, 3):
            used |= {"R"} if "R" in line.words else set("IJK")
        if line.words.keys() - used:
            raise GcodeError(36)

    def _homewards(self, line: ParsedLine, target: Vector) -> list[Action]:
        """By way of the target, on its axes only, to where G28.1 or G30.1 was."""
        words, home = self._words(line), self.stored[line.codes["other"]]
        ends = tuple(
            [home[at] if not words or at in words else x for at, x in enumerate(self.at_mm)]
        )
        self.at_mm = ends
        return [StraightMove(place, None) for place in ([target, ends] if words else [ends])]

    def _set(self, line: ParsedLine, target: Vector) -> list[Action]:
        """Set a parameter or G92's offset."""
        words, modes = self._words(line), self.modes
        if line.other in (28.1, 30.1):
            self.stored[int(line.codes["other"])] = self.at_mm
        elif line.other == 10:
            number = int(line.words.get("P", 0))
            system = 53 + number if number else modes.system
            origin = list(self.stored[system])
            for axis in words:
                origin[axis] = target[axis]
                if int(line.words["L"]) == 20:
                    length = modes.tool_mm if axis == 2 else 0.0
                    origin[axis] = self.at_mm[axis] - self.g92_mm[axis] - target[axis] - length
            self.stored[system] = tuple(origin)
            self.offset_changed |= system == modes.system
        elif line.other in (92, 92.1):
            self.offset_changed = True
            old, self.g92_mm = self.g92_mm, (0.0,) * len(self.axes)
            if line.other == 92:
                zero = self.offset_mm()
                self.g92_mm = tuple(
                    [
                        self.at_mm[at] - zero[at] - target[at] if at in words else old[at]
                        for at in range(len(self.axes))
                    ]
                )
        return [] if line.other in (4, 53, 92, 92.1) else [Dwell(0.0)]

    def _motion(self, line: ParsedLine, target: Vector) -> list[Action]:
        modes = self.modes
        if modes.motion == 0:
            return [StraightMove(target, None)]
        if modes.motion > 38:
            return [Probing(target, modes.feed, modes.motion > 38.35, modes.motion in (38.2, 38.4))]
        path = [target] if modes.motion == 1 else self._chords(line, target)
        feed = modes.feed
        if modes.feed_mode == 93:
            feed *= sum(map(math.dist, [self.at_mm, *path], path))
        return [StraightMove(place, feed) for place in path]

    def _chords(self, line: ParsedLine, target: Vector) -> list[Vector]:
        """Places along an arc, its other axes in step."""
        first, second = _plane(self.modes)
        i, j = self._centre(line, self.modes, target)
        here, way = self.at_mm, [end - at for at, end in zip(self.at_mm, target, strict=True)]
        x, y = way[first] - i, way[second] - j
        turn = math.atan2(j * x - i * y, -i * x - j * y)
        if self.modes.motion == 2 and turn > -5e-7:
            turn -= 2 * math.pi
        elif self.modes.motion == 3 and turn < 5e-7:
            turn += 2 * math.pi
        count = math.ceil(abs(turn) / CHORD_RAD)
        path = []
        for n in range(1, count):
            place = [at + by * n / count for at, by in zip(here, way, strict=True)]
            cos, sin = math.cos(turn * n / count), math.sin(turn * n / count)
            place[first] = here[first] + i - i * cos + j * sin
            place[second] = here[second] + j - i * sin - j * cos
            path.append(tuple(place))
        return [*path, target]


def _plane(modes: Modes) -> tuple[int, int]:
    return {17: (0, 1), 18: (2, 0)}.get(int(modes.plane), (1, 2))
