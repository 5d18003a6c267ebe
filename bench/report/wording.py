"""How values become text, tables and ids: once for page, terminal and exports."""

from __future__ import annotations

import hashlib
import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from bench.scoring.decisions import TIMES, Decision, Verdict
from bench.scoring.rates import percent_apart
from reports.page import Cell, Column, KeyValues, Table
from textfiles.text import plural, range_text

LONGEST = 60  # with what stands before it an id has room
NOT_MEASURED = "not measured"
DIGITS = {"s": 3, "%": 1, "": 0, TIMES: 0}  # of a decision's figures by unit; 2 of the others


def id_of(name: str) -> str:
    """A name as a part of an id; where it can't be one, its letters with a few of its hash."""
    plain = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
    if plain == name and len(name) <= LONGEST:
        return name
    return f"{plain[: LONGEST - 7]}-{hashlib.sha256(name.encode()).hexdigest()[:6]}".lstrip("-")


def formatted(value: Any, form: str) -> str:
    """The value by its format; what rounds to zero has no minus, what is small no exponent."""
    text = f"{value:{form.replace('.', 'z.') if form.endswith('f') else form}}"
    if form.endswith("g") and "e" in text:
        return f"{Decimal(text):{form[:-1].rstrip('.0123456789')}f}"
    return text


def number(value: float | None, unit: str = "", digits: int = 2) -> str:
    """``1.23 mm``; ``not measured`` for None. Whole numbers (counts) without decimals."""
    if value is None:
        return NOT_MEASURED
    whole = not unit and float(value).is_integer()
    text = formatted(value, ".0f" if whole else f".{digits}f")
    return f"{text} {unit}".rstrip()


def listed(values: Iterable[float], form: str = ".2f") -> str:
    """``1.00, 2.00, 3.00``."""
    return ", ".join(formatted(value, form) for value in values)


def p_text(p: float | None) -> str:
    """A p-value to three digits; empty for None."""
    return "" if p is None else "<\u00a00.001" if p < 0.001 else f"{p:.3f}"


def xyz(row: Mapping[str, Any], prefix: str = "") -> str:
    """The point of a record's row, mm."""
    return listed((row[f"{prefix}{axis}_mm"] for axis in "xyz"), ".1f")


def spanned(values: Any, form: str = ".2f", unit: str = "") -> str:
    """``1.00 to 2.00 mm``, the least and the greatest; ``not measured`` where there is none."""
    if not len(values):
        return NOT_MEASURED
    low, high = (formatted(one(values), form) for one in (min, max))
    return f"{range_text(low, high)} {unit}".rstrip()


def shown(value: Any, form: str = "") -> str | Cell:
    """A table's value as text, by the format ``form`` or as `number`; several are listed. None is
    ``not measured``, or empty where ``form`` ends with ``?``.
    """
    if isinstance(value, str | Cell):
        return value
    if value is None:
        return "" if form.endswith("?") else NOT_MEASURED
    form = form.removesuffix("?")
    if np.ndim(value):
        return listed(value, form)
    return formatted(value, form) if form else number(value)


@dataclass(frozen=True, slots=True)
class Heading(Column):
    """A column, and the format of its values as `shown` takes it."""

    form: str = ""


@cache
def _described() -> Mapping[str, Any]:
    """What ``tables.toml`` says of each table, its columns as `Heading`."""
    text = (Path(__file__).parent / "tables.toml").read_text(encoding="utf-8")
    tables: dict[str, Any] = tomllib.loads(text)

    def heading(text: str = "", number: str = "", **more: str) -> Heading:
        return Heading(text or number, "left" if text else "right", **more)

    for one in tables.values():
        heads = one["columns"]  # or the name of the table that has the same
        heads = tables[heads]["columns"] if isinstance(heads, str) else heads
        one["columns"] = [heading(**head) if isinstance(head, dict) else head for head in heads]
    return tables


@cache
def hints(of: str) -> Mapping[str, str]:
    """What the scoreboard ``of`` a comparison or calibration says of its rows, by their names."""
    text = (Path(__file__).parent / "hints.toml").read_text(encoding="utf-8")
    return cast(Mapping[str, str], tomllib.loads(text)[of])


MORE = "more"  # in a list of columns: the place of those that a table has by its rows


def table(
    name: str,
    rows: Iterable[Sequence[Any]],
    /,
    *,
    more: Iterable[Heading] = (),
    note: str = "",
    searchable: bool = False,
    **values: Any,
) -> Table:
    """The table ``name`` of ``tables.toml`` with these rows: ``values`` fill its texts, ``more``
    columns have their place in it, and ``note`` follows its own.
    """
    of, heads = _described()[name], list[Heading]()
    for head in of["columns"]:
        heads += more if head == MORE else [head]
    forms = [head.form for head in heads]
    cells = (tuple(shown(*pair) for pair in zip(row, forms, strict=True)) for row in rows)
    caption, said = (of.get(key, "").format(**values) for key in ("caption", "note"))
    found = searchable or of.get("searchable", False)
    return Table(caption, tuple(heads), tuple(cells), said + note, found)


def key_values(title: str, entries: Mapping[str, object]) -> KeyValues:
    """A list of names and values as text."""
    said = (
        value if isinstance(value, Cell) else NOT_MEASURED if value is None else str(value)
        for value in entries.values()
    )
    return KeyValues(title, tuple(zip(entries, said, strict=True)))


def measured(decision: Decision) -> str:
    """The decided figure and the one-sided bound decided on: ``100.0 % (at least 60.7 %)``."""
    value, unit, digits = decision.measured, decision.unit, DIGITS.get(decision.unit, 2)
    text = number(value, unit, digits)
    if unit == TIMES and value is not None:
        return f"{value:.0f} of {plural(decision.n, 'time')}"
    if value is None or not decision.uncertainty:
        return text
    above = (decision.verdict is Verdict.NOT_MET) == (unit == "%")
    bound = value + decision.uncertainty if above else value - decision.uncertainty
    said = number(bound, unit, digits)
    if unit == "%":
        said = percent_apart(bound / 100, decision.limit / 100)
    return f"{text} ({'at most' if above else 'at least'} {said})"


def limit(decision: Decision) -> str:
    """The limit with its unit, and with the digits that it was stated with: ``5 mm``."""
    if decision.unit == TIMES:
        return "each time"
    text = f"{decision.limit:.4g}"
    if not math.isclose(float(text), decision.limit):  # it was worked out, as an arm's
        return number(decision.limit, decision.unit, DIGITS.get(decision.unit, 2))
    return f"{text} {decision.unit}".rstrip()


def margin(decision: Decision) -> str:
    """What is left to the limit; negative beyond it."""
    if decision.margin is None:
        return ""
    text = formatted(decision.margin, f"+.{DIGITS.get(decision.unit, 2)}f")
    return f"{text} {decision.unit}".rstrip()
