"""TOML and JSON as plain values, through one door: whatever is wrong leaves it as a DocumentError
with its place, and what comes through can be walked, printed and stored.

What can't: integers of thousands of digits, half a surrogate pair, tables in tables without end.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Iterator
from typing import Any

from textfiles.text import TextError, decoded

DEEPEST = 60  # tables and arrays in each other
MOST_VALUES = 2_000_000
MOST_BITS = 3000  # of an integer: Python refuses to print one of 4300 digits
_PLACE = re.compile(r"\(at line (\d+), column (\d+)\)|: line (\d+) column (\d+)")


class DocumentError(TextError):
    """A text that is no document: ``line`` and ``column`` from 1, 0 where it has no place."""

    def __init__(self, message: str, line: int = 0, column: int = 0) -> None:
        self.line, self.column = line, column
        super().__init__(message)


def read_toml(text: str) -> dict[str, Any]:
    """The table of a TOML text. Raises DocumentError."""
    found: dict[str, Any] = _read("TOML", tomllib.loads, text)
    return found


def read_json(text: str | bytes) -> Any:
    """The value of a JSON text, its numbers finite. Raises DocumentError."""
    return _read("JSON", _FINITE.decode, text if isinstance(text, str) else decoded(text))


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no finite number")


_FINITE = json.JSONDecoder(parse_constant=_refuse_constant)


def _read(kind: str, parse: Callable[[Any], Any], text: str | bytes) -> Any:
    try:
        found = parse(text)
    except RecursionError:
        raise DocumentError(f"not {kind}: tables in tables without end") from None
    # int() refuses 4300 digits with a ValueError of its own; a library's others are as foreign
    except Exception as error:
        said = str(error)
        place = _PLACE.search(said)
        line, column = map(int, filter(None, place.groups())) if place else (0, 0)
        if "integer string conversion" in said:
            said = "an integer has thousands of digits"
        raise DocumentError(f"not {kind}: {_PLACE.split(said)[0].strip()}", line, column) from error
    refuse_unusable(found, kind)
    return found


def refuse_unusable(document: Any, kind: str) -> None:
    """Raise DocumentError for a value that can't be walked, printed or stored."""
    for _, value in _values(document, kind):
        if type(value) is int and value.bit_length() > MOST_BITS:
            raise DocumentError(f"not usable {kind}: an integer has thousands of bits")
        if isinstance(value, str) and not value.isascii():
            try:
                value.encode("utf-8")
            except UnicodeEncodeError:
                what = f"{value[:20].encode('ascii', 'backslashreplace').decode()!r}"
                raise DocumentError(f"not usable {kind}: {what} is no text") from None


def _values(document: Any, kind: str) -> Iterator[tuple[int, Any]]:
    """Every key and value with its depth, without recursion. Raises DocumentError."""
    left: list[tuple[int, Any]] = [(0, document)]
    count = 0
    while left:
        depth, value = left.pop()
        yield depth, value
        count += 1
        if depth > DEEPEST or count > MOST_VALUES:
            most = f"{DEEPEST} tables in each other" if depth > DEEPEST else f"{MOST_VALUES} values"
            raise DocumentError(f"not usable {kind}: more than {most}")
        if isinstance(value, dict):
            left += [(depth + 1, part) for pair in value.items() for part in pair]
        elif isinstance(value, list | tuple):
            left += [(depth + 1, part) for part in value]
