"""Points that a person touches with any other measuring arm: from a file that the arm's software
writes (`points:FILE`), or typed from its display (`typed:`), in place of a MicroScribe's driver.

The file is a table of text (CSV) with a row a point. A point counts once, and only if it came after
its touch was asked for. A row that is still being written waits. What can't be used (no row, two,
the row before once more, a row that isn't a point) costs the touch, which is asked for again.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
from urllib.parse import parse_qsl

import numpy as np
import numpy.typing as npt

from instruments.clock import Clock
from instruments.errors import (
    InstrumentError,
    LimitError,
    LinkError,
    ProtocolError,
    TouchAgainError,
)
from instruments.microscribe.configuration import Identity
from instruments.microscribe.driver import ArmView, Reading
from instruments.operators.console import Console
from instruments.operators.operator import Coordinates, Operator
from instruments.operators.prompted import PromptedOperator
from textfiles.tables import number, separator_of, stripped
from textfiles.text import TextError, decoded

Floats = npt.NDArray[np.float64]
FILE, TYPED = "points:", "typed:"
UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}  # in mm
SPELT = {"in": "inch", "inches": "inch", '"': "inch"}
ALLOWED = '"points:FILE" or "points:FILE?unit=mm&columns=name,x,y,z&serial=7001", "typed:"'
WAIT_S = 10.0  # for a row, once the operator goes on
TURN_S = 0.2  # between two looks for a row
BLANK = ' \t;,"\ufeff'  # a row of separators, as spreadsheets end a table
FARTHEST_MM = 20_000.0  # no arm reaches as far: the unit is wrong
_HEAD = re.compile(r'([xyzuijk])[ _]*[\[(]?(mm|cm|m|inch(?:es)?|in|")?[\])]?', re.IGNORECASE)
USB_ARMS = (
    "MicroScribes that have USB alone (G2 without its serial port, MX) aren't read: their protocol"
    " isn't published. Let the maker's software write points to a file and name it: \"points:FILE\""
)


@dataclass(frozen=True, slots=True)
class PointsUrl:
    """Where points come from: a ``path`` (None: typed), their ``unit`` and ``columns``, "" where
    the file's heads have them.
    """

    path: Path | None
    unit: str = ""
    columns: tuple[str, ...] = ()
    serial: str = "not stated"
    wait_s: float = WAIT_S


def points_url(url: str) -> PointsUrl | None:
    """``url`` where it names points, else None. Raises ValueError that says what is allowed."""
    if url.lower().startswith("usb"):
        raise ValueError(USB_ARMS)
    kind = next((kind for kind in (FILE, TYPED) if url.startswith(kind)), None)
    if kind is None:
        return None
    name, _, query = url.removeprefix(kind).partition("?")
    keys = dict(parse_qsl(query, keep_blank_values=True))
    unknown = keys.keys() - {"unit", "serial", *(("columns", "wait_s") if kind == FILE else ())}
    if unknown or (kind == FILE) != bool(name):
        what = f"unknown: {', '.join(sorted(unknown))}" if unknown else "which file?"
        raise ValueError(f"{what} (allowed: {ALLOWED})")
    unit = keys.get("unit", "" if kind == FILE else "mm")
    if unit and unit not in UNITS:
        raise ValueError(f"unit={unit}: there are {', '.join(UNITS)}")
    columns = tuple(filter(None, keys.get("columns", "").lower().split(",")))
    if columns and not {"x", "y", "z"} <= set(columns):
        raise ValueError("columns= has to name x, y and z, as in columns=name,x,y,z,u")
    try:
        wait_s = float(keys.get("wait_s", WAIT_S))
    except ValueError:
        wait_s = math.nan
    if not 0.0 <= wait_s <= 600.0:
        raise ValueError(f"wait_s={keys['wait_s']}: seconds, 0 to 600")
    path = Path(name) if kind == FILE else None
    return PointsUrl(path, unit, columns, keys.get("serial", "not stated"), wait_s)


@dataclass(frozen=True, slots=True)
class _Point:
    """mm; ``written`` to ``digit_mm``; ``u_mm`` and ``axis`` where the row has them."""

    tip_mm: Floats
    written: str
    digit_mm: float
    u_mm: float | None = None
    axis: Floats | None = None


class PointArm:
    """A measuring arm by its points. A point that states more than ``most_u_mm``, or is written to
    less than ``resolution_mm``, is refused.
    """

    moves: ClassVar[bool] = False
    touches: ClassVar[bool] = False
    pedals: ClassVar[bool] = False
    safe_state: ClassVar[str] = "its software's own; the bench only reads points"
    homing: ClassVar[str] = (
        "Reference the measuring arm as its maker says, and have its software ready for points."
    )
    homing_again: ClassVar[str] = homing
    warnings: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        url: PointsUrl,
        folder: Path,
        clock: Clock,
        most_u_mm: float,
        resolution_mm: float = 0.01,
    ) -> None:
        self.who = "arm"
        self._url, self._clock = url, clock
        self._most_u_mm, self._resolution_mm = most_u_mm, resolution_mm
        self._path = None if url.path is None else folder / url.path
        self._taken: list[str] = []  # rows that are there, or were
        self._early = 0  # of these, since the last touch was asked for
        self._open = self._ready = False
        self._operator: Operator | None = None

    def asked_of(self, operator: Operator | None) -> None:
        """Have ``operator`` touch; at a console a new row counts as Enter."""
        self._operator = operator
        if isinstance(operator, PromptedOperator) and self._path is not None:
            operator.before_touch = self._pass_over
            if isinstance(operator, Console):
                operator.watch_pedals(lambda: self._arrives)

    @property
    def identity(self) -> Identity:
        """Whose points these are, as the URL says."""
        source = "typed" if self._path is None else "file"
        return Identity("points of another arm", "", source, self._url.serial, "", "", "")

    @property
    def homed(self) -> bool:
        """Whether the operator has said that it is referenced."""
        return self._ready

    @property
    def live(self) -> bool:
        return self._open

    def record(self) -> dict[str, object]:
        """Where its points come from."""
        return {
            "source": "typed" if self._path is None else str(self._path),
            "serial_number": self._url.serial,
            "unit": self._url.unit or "as the file's heads say",
        }

    def sign_on(self) -> Identity:
        """Pass over the points that are there. Raises LinkError without the file, ProtocolError for
        heads without columns or unit.
        """
        self._ready = False
        if self._path is not None:
            self._taken = self._rows()
            self._heads(self._lines())
        self._open = True
        return self.identity

    def recover(self, timeout_s: float = WAIT_S) -> Identity:  # noqa: ARG002 - it is there or not
        """As `sign_on`."""
        return self.sign_on()

    def confirm_homed(self) -> None:
        """The operator says that it is referenced."""
        self._ready = True

    home = confirm_homed

    def safe(self) -> None:
        """Nothing is to be done."""
        self._open = self._ready = False

    close = safe

    def glance(self) -> Reading | None:
        """None: a point is there once it is touched."""
        return None

    def watch(self, every_s: float) -> Iterator[ArmView]:
        """Raises LimitError: a point is there once it is touched."""
        what = "it can't be watched: the software of another arm does that"
        raise LimitError(self.who, what, asked=f"watch every {every_s:g} s")

    def buttons(self) -> int:
        """No pedals are known of it."""
        return 0

    def touch(self, point_mm: Floats, axis: Floats) -> None:
        """Raises LimitError: it is moved by hand."""
        raise LimitError(self.who, f"it has no motor to go to {point_mm} along {axis}")

    def read(self, n: int = 1, max_spread_mm: float = 0.0) -> Reading:  # noqa: ARG002 - one point
        """The point touched last. Raises TouchAgainError for none, several or an unusable one;
        LinkError and ProtocolError for a file that has gone or was changed.
        """
        point = self._typed() if self._path is None else self._next()
        if not all(abs(v) <= FARTHEST_MM for v in point.tip_mm):
            what = f"the point {tuple(point.tip_mm.tolist())} mm is farther than any arm reaches"
            raise TouchAgainError(self.who, what, hint="Is the unit right (unit=mm)?")
        if point.u_mm is not None and point.u_mm > self._most_u_mm:
            what = f"its software states {point.u_mm:.3f} mm of the point, the rig file"
            raise TouchAgainError(
                self.who,
                f"{what} {self._most_u_mm:.3f} mm",
                hint="Touch it once more, or state what holds: accuracy_mm under [arm]",
            )
        if point.digit_mm > self._resolution_mm * 1.001:
            what = f"{point.written!r} is written to {point.digit_mm:g} mm, the rig file states"
            raise TouchAgainError(
                self.who,
                f"{what} {self._resolution_mm:g} mm",
                hint="Have more decimals written, or state what holds: resolution_mm under [arm]",
            )
        return Reading(point.tip_mm, 0.0, point.axis, 1, written=point.written)

    def _typed(self) -> _Point:
        text = (
            f"Type x, y and z of the arm's display, in {self._url.unit}; after them i, j and k of"
            " its stylus, where it shows them."
        )
        cells = self._operator.ask(Coordinates(text)).point if self._operator else None
        if cells is None:
            raise LimitError(
                self.who, "there is no terminal to type points at", hint="Use a terminal"
            )
        factor = UNITS[self._url.unit]
        tip_mm = np.array(cells[:3], dtype=np.float64) * factor
        digit_mm = min(map(_digit, cells[:3])) * factor
        return _Point(tip_mm, " ".join(cells), digit_mm, axis=_direction(cells[3:]))

    # The file

    def _pass_over(self) -> None:
        """Pass over the points that are there before a touch is asked for."""
        with suppress(InstrumentError):  # reading raises it
            new = self._new_rows()
            self._taken += new
            self._early = len(new)

    def _arrives(self, seconds: float) -> bool:
        """Whether a new row comes within so long. Raises as `read` for a file that is gone."""
        end_s = self._clock.now() + seconds
        while not self._new_rows():
            if self._clock.now() >= end_s:
                return False
            self._clock.sleep(TURN_S)
        return True

    def _next(self) -> _Point:
        if not self._arrives(self._url.wait_s):
            early = f"; {self._early} came before it was asked for" if self._early else ""
            what = f"no new point came in {self._path} within {self._url.wait_s:g} s{early}"
            hint = "Touch the point so that the arm's software writes it, then go on"
            raise TouchAgainError(self.who, what, hint=hint)
        new, before = self._new_rows(), self._taken[-1:]
        self._taken += new
        if len(new) > 1:
            what = f"{len(new)} points came in {self._path} where one was asked for"
            raise TouchAgainError(self.who, what, hint="Touch the point once more, once")
        if new == before:
            what = f"{self._path}: the row before is there once more, to the last digit: {new[0]!r}"
            raise TouchAgainError(self.who, what, hint="Touch the point once more")
        columns, factors, split = self._heads(self._lines())
        try:
            cells = dict(zip(columns, split(new[0]), strict=True))
            tip_mm = np.array([number(cells[key]) * factors[key] for key in "xyz"])
            digit_mm = min(_digit(cells[key]) * factors[key] for key in "xyz")
            u_mm = number(cells["u"]) * factors["u"] if cells.get("u") else None
            axis = _direction([cells[key] for key in "ijk"]) if cells.get("k") else None
        except (KeyError, ValueError):
            what = f"{self._path}: this row isn't a point: {new[0]!r}"
            raise TouchAgainError(self.who, what, hint="Touch the point once more") from None
        return _Point(tip_mm, new[0], digit_mm, u_mm, axis)

    def _new_rows(self) -> list[str]:
        rows = self._rows()
        if rows[: len(self._taken)] != self._taken:
            raise ProtocolError(
                self.who,
                f"{self._path}: rows that were there have changed or are gone",
                hint="The software has to add a row a point; let it write a new file, and start"
                " again with it",
            )
        return rows[len(self._taken) :]

    def _lines(self) -> list[str]:
        """All whole lines with something in them."""
        assert self._path is not None  # noqa: S101 - of a file
        try:
            data = self._path.read_bytes()
        except OSError as error:
            what = f"{self._path}: {error.strerror or error}"
            hint = "Let the arm's software write its first point there, or correct the name"
            raise LinkError(self.who, what, hint=hint) from error
        try:
            whole, _, _ = decoded(data, growing=True).rpartition("\n")
        except TextError as error:
            hint = "Let the software write plain text"
            raise ProtocolError(self.who, f"{self._path} {error}", hint=hint) from error
        return [line for line in whole.split("\n") if line.strip(BLANK) and line[:1] != "#"]

    def _rows(self) -> list[str]:
        """The rows after the heads."""
        lines = self._lines()
        return lines if self._url.columns else lines[_head_at(lines) + 1 :]

    def _heads(
        self, lines: list[str]
    ) -> tuple[tuple[str, ...], Mapping[str, float], Callable[[str], list[str]]]:
        """Names of the columns, what makes mm of each, and how a row is split."""
        at = _head_at(lines)
        if not self._url.columns and at < 0:
            what = f"{self._path} has no row that heads its columns (x_mm, y_mm, z_mm)"
            hint = "Let the software write heads, or name the columns: points:FILE?columns=x,y,z"
            raise ProtocolError(self.who, what, hint=f"{hint}&unit=mm")
        split = _splitter(lines[max(at, 0)] if lines else "")
        heads = split(lines[at]) if not self._url.columns else list(self._url.columns)
        found = [_HEAD.fullmatch(head) for head in heads]
        names = tuple(
            match[1].lower() if match else head for match, head in zip(found, heads, strict=True)
        )
        factors: dict[str, float] = {}
        for name, match in zip(names, found, strict=True):
            if match and name in "xyzu":
                unit = (match[2] or self._url.unit).lower()
                unit = SPELT.get(unit, unit)
                if unit not in UNITS:
                    what = f"{self._path} doesn't say the unit of {name}"
                    raise ProtocolError(self.who, what, hint="Say it: points:FILE?unit=mm")
                factors[name] = UNITS[unit]
        return names, factors, split


def _head_at(lines: list[str]) -> int:
    """The first line that heads columns x, y and z; -1 for none."""
    for at, line in enumerate(lines):
        matches = (_HEAD.fullmatch(cell) for cell in _splitter(line)(line))
        if {"x", "y", "z"} <= {match[1].lower() for match in matches if match}:
            return at
    return -1


def _splitter(line: str) -> Callable[[str], list[str]]:
    """Splits rows as ``line`` is split; a comma between cells is no decimal one."""
    mark = separator_of(line)

    def split(row: str) -> list[str]:
        cells = row.split() if mark is None else next(csv.reader([row], delimiter=mark), [])
        return [stripped(cell) for cell in cells]

    return split


def _digit(cell: str) -> float:
    """What the last digit of a number is worth, in its own unit. Raises ValueError."""
    mantissa, _, exponent = cell.replace(",", ".").lower().partition("e")
    return float(10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2])))


def _direction(cells: Sequence[str]) -> Floats | None:
    """A unit vector (3,); None where it isn't known. Raises ValueError."""
    axis = np.array([number(cell) for cell in cells])
    length = float(np.linalg.norm(axis))
    return axis / length if length else None
