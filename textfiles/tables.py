"""Tables of text as spreadsheets and instruments write them: comma, semicolon or tab between cells,
decimal point or comma, quotes, empty rows of separators; errors in the words of that file.

A row counts only with as many cells as there are heads: with a decimal comma between commas, or a
separator too few, its values would stand in other columns.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from textfiles.text import TextError, short

SEPARATORS = {";": "semicolons", "\t": "tabs", ",": "commas"}
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?", re.ASCII)
_SEPARATOR_LINE = re.compile(r'"?sep=(.)"?\s*', re.IGNORECASE)  # Excel's own first line


class TableError(TextError):
    """A table that can't be read as it stands: ``line`` from 1, 0 for the whole."""

    def __init__(self, line: int, message: str) -> None:
        self.line = line
        super().__init__(message)


@dataclass(frozen=True, slots=True)
class TextRow:
    """A row of a table: ``line`` of the file where it begins, and ``cells`` by head."""

    line: int
    cells: Mapping[str, str]

    def number(self, head: str, unit: str = "") -> float:
        """A finite number of one cell. Raises TableError."""
        try:
            return number(self.cells[head])
        except ValueError as error:
            of_unit = f" in {unit}" if unit and "number" in str(error) else ""
            what = f"{head} must be {error}{of_unit}, is {_shown(self.cells[head])}"
            raise TableError(self.line, what) from None


@dataclass(frozen=True, slots=True)
class TextTable:
    """``heads`` as they stand, and rows that have something in them."""

    heads: tuple[str, ...]
    rows: tuple[TextRow, ...]


def read_table(
    text: str, needed: Sequence[str] = (), numbers: Sequence[str] | None = None
) -> TextTable:
    """The table of a decoded text, whose first line names its columns; ``numbers`` of ``needed``
    are numbers (None: all). Raises TableError.
    """
    lines = text.split("\n")
    skipped, mark = 0, ""
    if given := _SEPARATOR_LINE.fullmatch(lines[0]):
        mark, skipped = given[1], 1
    mark = mark or separator_of(next((line for line in lines[skipped:] if line.strip()), "")) or ","
    rows = _cells(lines[skipped:], mark, skipped)
    line, heads = rows[0] if rows else (1, [])
    if missing := [name for name in needed if name not in heads]:
        near = f"; it names {_shown(mark.join(heads))}" if heads else "; the file is empty"
        what = f"the column(s) {', '.join(missing)} are missing"
        raise TableError(line, f"{what}; the first line must name {','.join(needed)}{near}")
    if twice := [name for name in heads if name and heads.count(name) > 1]:
        raise TableError(line, f"the column {_shown(twice[0])} is there twice")
    between = SEPARATORS.get(mark, repr(mark))
    found = tuple(_row(line, cells, heads, between) for line, cells in rows[1:])
    _refuse_mixed(found, needed if numbers is None else numbers)
    return TextTable(tuple(heads), found)


def _cells(lines: Sequence[str], mark: str, skipped: int) -> list[tuple[int, list[str]]]:
    """The first line and the cells of each row that has something in it. Raises TableError."""
    reader = csv.reader((f"{line}\n" for line in lines), delimiter=mark, strict=True)
    rows: list[tuple[int, list[str]]] = []
    line = skipped + 1
    try:
        for cells in reader:
            plain = [stripped(cell) for cell in cells]
            if any(plain):
                rows.append((line, plain))
            line = reader.line_num + skipped + 1
    except csv.Error as error:
        between = SEPARATORS.get(mark, mark)
        raise TableError(line, f"is not a table of values between {between}: {error}") from None
    return rows


def _row(line: int, cells: list[str], heads: list[str], between: str) -> TextRow:
    if len(cells) != len(heads):
        what = "has another number of values than the first line has names"
        what += f": {len(cells)} between {between}, not {len(heads)}"
        comma = any("." not in cell for cell in cells) and between == "commas"
        hint = ". Is a decimal comma in it? Then put semicolons or tabs between cells"
        raise TableError(line, f"{what}{hint if comma and len(cells) > len(heads) else ''}")
    if stray := next((c for c, h in zip(cells, heads, strict=True) if c and not h), None):
        raise TableError(line, f"{_shown(stray)} stands in a column without a name")
    return TextRow(line, {head: cell for head, cell in zip(heads, cells, strict=True) if head})


def _refuse_mixed(rows: Sequence[TextRow], heads: Sequence[str]) -> None:
    """Raise TableError for a decimal comma beside a point: one may be a mark of thousands."""
    seen: dict[str, tuple[int, str]] = {}
    for row in rows:
        for cell in (row.cells.get(head, "") for head in heads):
            for mark in ".," if _NUMBER.fullmatch(cell) else "":
                if mark in cell:
                    seen.setdefault(mark, (row.line, cell))
    if len(seen) == 2:
        (line, cell), (_, other) = sorted(seen.values(), reverse=True)
        what = f"{cell!r} and {other!r} in one table: a decimal comma, or one of thousands?"
        raise TableError(line, what)


def separator_of(line: str) -> str | None:
    """What stands between the cells of a line: a semicolon before a tab, a comma last."""
    bare = re.sub(r'"[^"]*"', "", line)
    return next((mark for mark in SEPARATORS if mark in bare), None)


def stripped(cell: str) -> str:
    """Without blanks and quotes around it."""
    return cell.strip().strip('"').strip()


def number(cell: str) -> float:
    """A finite number with a decimal point or comma. Raises ValueError."""
    plain = stripped(cell).replace("\N{MINUS SIGN}", "-")
    if not _NUMBER.fullmatch(plain):
        endless = plain.lstrip("+-").lower() in ("nan", "inf", "infinity")
        raise ValueError("finite" if endless else "a number")
    value = float(plain.replace(",", "."))
    if not math.isfinite(value):
        raise ValueError("finite")
    return value


def _shown(cell: str) -> str:
    return repr(short(cell, 40))
