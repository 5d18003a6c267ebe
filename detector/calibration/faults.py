"""What can be wrong with a calibration file, and the checks of single values.

Strategy: a check takes what TOML gave and returns the value or raises `Wrong` with a sentence; it knows neither the key nor the file. The
reader gathers every fault before it complains, keyed by where it is, so that whoever has the text can point at the line.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from difflib import get_close_matches
from pathlib import Path
from typing import Any

Key = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing wrong: the dotted key as a tuple, empty for the file as a whole, and a sentence."""

    key: Key
    message: str

    def __str__(self) -> str:
        return f"{'.'.join(self.key)}: {self.message}" if self.key else self.message


class CalibrationError(ValueError):
    """A calibration file that can't be used, with every fault in it. Raised by `load_calibration` and by nothing else."""

    def __init__(self, path: Path, faults: Sequence[Fault]) -> None:
        self.path = path
        self.faults = tuple(faults)
        count = f"{len(faults)} fault{'' if len(faults) == 1 else 's'}"
        super().__init__("\n".join([f"calibration {path}: {count}", *(f"  {fault}" for fault in faults)]))


class Wrong(Exception):  # noqa: N818 (a check's verdict, caught by the reader; never seen by a caller)
    """A value that fails its check."""


def numbers(length: int, what: str) -> Callable[[Any], tuple[float, ...]]:
    """A check for an array of exactly `length` finite numbers."""

    def check(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list):
            raise Wrong(f"must be an array of {length} numbers ({what}), not {_kind(value)}")
        if len(value) != length:
            raise Wrong(f"must have {length} numbers ({what}), has {len(value)}")
        return tuple(number(v) for v in value)

    return check


def positive_numbers(length: int, what: str) -> Callable[[Any], tuple[float, ...]]:
    """A check for an array of exactly `length` numbers above zero."""
    plain = numbers(length, what)

    def check(value: Any) -> tuple[float, ...]:
        found = plain(value)
        if min(found) <= 0:
            raise Wrong(f"must be above zero ({what}), got {value}")
        return found

    return check


def number(value: Any) -> float:
    """A check for one finite number; true and false are not numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise Wrong(f"must be a number, not {_kind(value)}")
    try:
        found = float(value)
    except OverflowError:
        raise Wrong("must be a finite number, this integer is too large for one") from None
    if not math.isfinite(found):
        raise Wrong(f"must be a finite number, not {value}")
    return found


def positive(value: Any) -> float:
    """A check for one number above zero."""
    if (found := number(value)) <= 0:
        raise Wrong(f"must be above zero, got {value}")
    return found


def size(value: Any) -> tuple[int, int]:
    """A check for [columns, rows]: two whole numbers from 1 to 65535."""
    if not isinstance(value, list) or len(value) != 2 or any(isinstance(v, bool) or not isinstance(v, int) for v in value):
        raise Wrong("must be [columns, rows], two whole numbers of pixels")
    if not all(1 <= v <= 65535 for v in value):
        raise Wrong(f"must be [columns, rows] of 1 to 65535 pixels, got {value}")
    return value[0], value[1]


def flag(value: Any) -> bool:
    """A check for true or false."""
    if not isinstance(value, bool):
        raise Wrong(f"must be true or false, not {_kind(value)}")
    return value


def one_of(allowed: Sequence[str]) -> Callable[[Any], str]:
    """A check for one of a few words."""

    def check(value: Any) -> str:
        if value in allowed and isinstance(value, str):
            return value
        near = get_close_matches(str(value), allowed, n=1)
        raise Wrong(f"must be one of {', '.join(map(repr, allowed))}, got {value!r}" + (f"; did you mean {near[0]!r}?" if near else ""))

    return check


def matrix(value: Any) -> tuple[tuple[float, ...], ...]:
    """A check for an invertible (3, 3) homography, as three rows of three numbers."""
    if not isinstance(value, list) or len(value) != 3:
        raise Wrong("must be three rows of three numbers")
    row = numbers(3, "a row of a homography")
    (a, b, c), (d, e, f), (g, h, i) = rows = tuple(row(r) for r in value)
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if not (i > 0 and math.isfinite(determinant) and determinant > 0):
        raise Wrong(
            "must be a homography that neither mirrors nor flattens, its last entry above zero: "
            f"determinant {determinant:g}, last entry {i:g}"
        )
    return rows


def word(value: Any) -> str:
    """A check for a text."""
    if not isinstance(value, str):
        raise Wrong(f'must be a text in "quotes", not {_kind(value)}')
    return value


def day(value: Any) -> str:
    """A check for a date, year-month-day, as a text."""
    text = word(value)
    try:
        return date.fromisoformat(text).isoformat()
    except ValueError:
        raise Wrong(f'must be a day such as "2026-11-20", not {text!r}') from None


def words(value: Any) -> dict[str, str]:
    """A check for a table of texts."""
    if not isinstance(value, dict):
        raise Wrong(f'must be a table of texts, {{ name = "..." }}, not {_kind(value)}')
    return {name: word(text) for name, text in value.items()}


def parameters(value: Any) -> tuple[tuple[str, str], ...]:
    """A check for names of parameters: an array of "owner name"; a thermal pose's owner has two words."""
    if not isinstance(value, list) or not all(isinstance(v, str) and " " in v for v in value):
        raise Wrong('must be an array of names such as "left fx" or "stereo T1"')
    return tuple((v.rpartition(" ")[0], v.rpartition(" ")[2]) for v in value)


def triangle(value: Any) -> tuple[tuple[float, ...], ...]:
    """A check for the lower triangle of a symmetric matrix: rows of 1, 2, 3 ... numbers."""
    if not isinstance(value, list) or not all(isinstance(row, list) for row in value):
        raise Wrong(f"must be an array of rows, not {_kind(value)}")
    if any(len(row) != n for n, row in enumerate(value, 1)):
        raise Wrong("must be a lower triangle: rows of 1, 2, 3 ... numbers")
    return tuple(tuple(number(v) for v in row) for row in value)


def unknown(key: str, allowed: Sequence[str], what: str) -> str:
    """What to say about a key that nothing knows, with the nearest one that exists."""
    near = get_close_matches(key, allowed, n=1)
    return f"unknown {what}; did you mean {near[0]!r}?" if near else f"unknown {what}; there are: {', '.join(allowed)}"


def _kind(value: Any) -> str:
    names = {bool: "true or false", int: "a number", float: "a number", str: "text", list: "an array", dict: "a table"}
    return names.get(type(value), type(value).__name__)
