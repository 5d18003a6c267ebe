"""G-code of the emulated controller: one line to one command, and the modes that stay.

Straight moves, dwell, units, distance mode, machine coordinates, G92, jogs and probing; spindle,
coolant and program words do nothing. Arcs, tool offsets and more work coordinates are error 20.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from instruments.stage.emulator.motion import Vector

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)")
_GROUPS = {
    "motion": {0.0, 1.0, 38.2, 38.3, 38.4, 38.5, 80.0},
    "other": {4.0, 53.0, 92.0, 92.1},
    "plane": {17.0},
    "units": {20.0, 21.0},
    "distance": {90.0, 91.0},
    "feed mode": {94.0},
    "coordinates": {54.0},
    "tool": {40.0, 49.0},
    "path": {61.0},
    "arc distance": {91.1},
}
_M_GROUPS = {
    "program": {0.0, 1.0, 2.0, 30.0},
    "spindle": {3.0, 4.0, 5.0},
    "coolant": {7.0, 8.0, 9.0},
}
_JOG_GROUPS = {"units", "distance", "other"}
_INCH_MM = 25.4
_AXES = "XYZA"


class GcodeError(Exception):
    """The line is refused with ``code``."""

    def __init__(self, code: int) -> None:
        super().__init__(f"error:{code}")
        self.code = code


@dataclass(frozen=True, slots=True)
class Modes:
    """What stays for later lines. ``offset_mm``: work zero in machine coordinates."""

    offset_mm: Vector
    motion: float = 0.0
    inches: bool = False
    relative: bool = False
    feed_mm_min: float = 0.0

    def describe(self) -> str:
        """As ``$G`` prints them."""
        return (
            f"[GC:G{self.motion:g} G54 G17 G{20 if self.inches else 21}"
            f" G{91 if self.relative else 90} G94 M5 M9 T0 F{self.feed_mm_min:.0f} S0]"
        )


@dataclass(frozen=True, slots=True)
class Move:
    """Go to ``target_mm`` (machine coordinates); no feed is a rapid move."""

    target_mm: Vector
    feed_mm_min: float | None


@dataclass(frozen=True, slots=True)
class Probe:
    """Move until the probe closes (``away``: opens); if it ``must`` and doesn't, an alarm."""

    move: Move
    away: bool
    must: bool


@dataclass(frozen=True, slots=True)
class Dwell:
    """Let all moves finish, then wait."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Words:
    """A line taken apart: G and M numbers by modal group, and the other letters' values."""

    groups: dict[str, float]
    values: dict[str, float]


def words(text: str, axes: int, most_line_number: float) -> Words:
    """Take a line apart (capitals, no spaces) for a board of so many axes. Raises GcodeError."""
    groups: dict[str, float] = {}
    values: dict[str, float] = {}
    at = 0
    while at < len(text):
        letter = text[at]
        if not "A" <= letter <= "Z":
            raise GcodeError(1)
        number = _NUMBER.match(text, at + 1)
        if not number:
            raise GcodeError(2)
        at = number.end()
        _place(letter, float(number[0]), _AXES[:axes], groups, values)
    if int(values.get("N", 0)) > most_line_number:
        raise GcodeError(27)
    return Words(groups, values)


def _place(
    letter: str, value: float, axes: str, groups: dict[str, float], values: dict[str, float]
) -> None:
    if letter in "GM":
        known = _GROUPS if letter == "G" else _M_GROUPS
        group = next((name for name, members in known.items() if value in members), None)
        if group is None:
            raise GcodeError(20)
        if group in groups:
            raise GcodeError(21)
        groups[group] = value
    elif letter not in axes + "FPNST":
        raise GcodeError(20)
    elif letter in values:
        raise GcodeError(25)
    elif letter in "FNPST" and value < 0:
        raise GcodeError(4)
    else:
        values[letter] = value


def command(
    text: str, modes: Modes, at_mm: Vector, most_line_number: float
) -> tuple[Modes, Move | Probe | Dwell | None]:
    """What ``text`` asks for after a move to ``at_mm``. Raises GcodeError; then nothing changes."""
    line = words(text, len(at_mm), most_line_number)
    after = _new_modes(line, modes)
    axes = _axes(line, after.inches)
    other = line.groups.get("other")
    if other == 4.0:
        if "P" not in line.values:
            raise GcodeError(28)
        return after, Dwell(line.values["P"])
    if other == 92.1:
        return replace(after, offset_mm=tuple(0.0 for _ in at_mm)), None
    if other == 92.0:
        if not axes:
            raise GcodeError(26)
        offset = (
            at_mm[i] - axes[i] if i in axes else after.offset_mm[i] for i in range(len(at_mm))
        )
        return replace(after, offset_mm=tuple(offset)), None
    move = _move(line, after, axes, at_mm)
    return after, _probe(line, move, after.motion, at_mm) if 38.0 < after.motion < 39.0 else move


def _probe(line: Words, move: Move | None, kind: float, at_mm: Vector) -> Probe | None:
    if move is None:
        if "motion" in line.groups:
            raise GcodeError(26)
        return None
    if move.target_mm == at_mm:
        raise GcodeError(33)
    return Probe(move, away=kind in (38.4, 38.5), must=kind in (38.2, 38.4))


def jog(text: str, modes: Modes, at_mm: Vector, most_line_number: float) -> Move | None:
    """The move that ``$J=`` asks for, if any; it leaves no mode behind. Raises GcodeError."""
    line = words(text, len(at_mm), most_line_number)
    if "F" not in line.values:
        raise GcodeError(22)
    after = replace(_new_modes(line, modes), motion=1.0)
    move = _move(line, after, _axes(line, after.inches), at_mm)
    if set(line.groups) - _JOG_GROUPS or line.groups.get("other", 53.0) != 53.0:
        raise GcodeError(16)
    return move


def _new_modes(line: Words, modes: Modes) -> Modes:
    inches = line.groups.get("units", 20.0 if modes.inches else 21.0) == 20.0
    relative = line.groups.get("distance", 91.0 if modes.relative else 90.0) == 91.0
    feed = (
        line.values["F"] * (_INCH_MM if inches else 1.0)
        if "F" in line.values
        else modes.feed_mm_min
    )
    return replace(
        modes,
        motion=line.groups.get("motion", modes.motion),
        inches=inches,
        relative=relative,
        feed_mm_min=feed,
    )


def _axes(line: Words, inches: bool) -> dict[int, float]:
    """By number; the rotation A is in degrees whatever the units."""
    values = {
        _AXES.index(letter): value for letter, value in line.values.items() if letter in _AXES
    }
    return {
        axis: value * (_INCH_MM if inches and axis < 3 else 1.0) for axis, value in values.items()
    }


def _move(line: Words, modes: Modes, axes: dict[int, float], at_mm: Vector) -> Move | None:
    machine = line.groups.get("other") == 53.0
    if machine and modes.motion not in (0.0, 1.0):
        raise GcodeError(30)
    if not axes:
        return None
    if modes.motion == 80.0:
        raise GcodeError(31)
    if modes.motion != 0.0 and modes.feed_mm_min == 0:
        raise GcodeError(22)
    target = list(at_mm)
    for axis, value in axes.items():
        if machine:
            target[axis] = value
        elif modes.relative:
            target[axis] += value
        else:
            target[axis] = value + modes.offset_mm[axis]
    return Move(tuple(target), modes.feed_mm_min if modes.motion != 0.0 else None)
