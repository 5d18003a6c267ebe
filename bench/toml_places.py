"""Where the keys of a TOML text stand: line and column, so that a fault can be shown in its place.

`tomllib` gives values without places, so this reads the lines once more: headers, keys and how far a value
reaches. It may not judge anything; what it can't place (an inline table's inside) falls to the key around it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

_HEADER = re.compile(r"\s*(\[\[?)\s*([^\[\]=]+?)\s*\]\]?\s*(#.*)?$")
_KEY = re.compile(r"""\s*((?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*'))*)\s*=\s*""")
_STRINGS = re.compile(r'"""|\'\'\'|"(?:\\.|[^"\\])*"|\'[^\']*\'|#.*|[\[\]{}]')

KeyPath = tuple[str | int, ...]


@dataclass(frozen=True, slots=True)
class Place:
    """``line`` from 1; columns from 0; the key spans ``key_end - key_start``, the value starts at ``value_start``."""

    line: int
    key_start: int
    key_end: int
    value_start: int


def find_places(text: str) -> Mapping[KeyPath, Place]:
    """The place of each table header and key in ``text``, which must be valid TOML."""
    places: dict[KeyPath, Place] = {(): Place(1, 0, 0, 0)}
    table: KeyPath = ()
    counts: dict[KeyPath, int] = {}
    for number, line in _logical_lines(text):
        header = _HEADER.match(line)
        if header:
            table = _open_table(_split(header[2]), is_array=header[1] == "[[", counts=counts)
            place = Place(number, header.start(2), header.end(2), header.start(2))
            places.setdefault(table, place)
            if isinstance(table[-1], int):
                places.setdefault(table[:-1], place)
        elif key := _KEY.match(line):
            path = table + _split(key[1])
            places[path] = Place(number, key.start(1), key.end(1), key.end())
    return places


def nearest(places: Mapping[KeyPath, Place], path: KeyPath) -> tuple[Place, bool]:
    """The place of ``path``, or of what holds it; True when it is the exact one."""
    for length in range(len(path), -1, -1):
        if path[:length] in places:
            return places[path[:length]], length == len(path)
    return places[()], False


def _split(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip().strip("\"'") for part in dotted.split("."))


def _open_table(names: tuple[str, ...], *, is_array: bool, counts: dict[KeyPath, int]) -> KeyPath:
    path: KeyPath = ()
    for name in names[:-1]:
        path = (*path, name)
        if path in counts:
            path = (*path, counts[path])
    path = (*path, names[-1])
    if is_array:
        counts[path] = counts.get(path, -1) + 1
        return (*path, counts[path])
    return path


def _logical_lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines on which a header or key may start: those inside a long string, array or inline table are left out."""
    depth, quote = 0, ""
    for number, line in enumerate(text.split("\n"), 1):
        if depth == 0 and not quote:
            yield number, line
        header = depth == 0 and not quote and _HEADER.match(line)
        depth, quote = (0, "") if header else _scan(line, depth, quote)


def _scan(line: str, depth: int, quote: str) -> tuple[int, str]:
    at = 0
    while at < len(line):
        if quote:
            end = line.find(quote, at)
            if end < 0:
                return depth, quote
            at, quote = end + 3, ""
            continue
        token = _STRINGS.search(line, at)
        if token is None:
            break
        at = token.end()
        quote = token[0] if token[0] in ('"""', "'''") else ""
        depth += (token[0] in "[{") - (token[0] in "]}")
    return depth, quote
