"""How many statements a page makes that each err by chance in some cases, counted from the page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from bench.report.wording import NOT_MEASURED
from bench.scoring.rates import plural
from bench.script.model import Rules
from reports.page import Cell, Notes, Table

CHANCE = 0.05  # of each to be wrong


def note_on_statements(parts: Sequence[Any], rules: Rules, detectors: int) -> Notes:
    """Says it once: the decisions on chance, the intervals and the p-values of these parts."""
    decided = detectors * sum(_by_chance(rule) for rule in rules.requirements)
    counts = {
        plural(decided, "decision or bound") + ", one-sided": decided,
        plural(found := _cells(parts, _is_interval), "interval") + ", two-sided": found,
        plural(found := _cells(parts, _is_p), "p-value"): found,
    }
    total = sum(counts.values())
    told = ", ".join(text for text, count in counts.items() if count)
    made = (
        f"This page makes {plural(total, 'statement')} that chance makes wrong in at most"
        f" {CHANCE:.0%} of cases each{f': {told}' if told else ''}. Each holds by itself; of all of"
        f" them some {CHANCE * total:.1f} may be wrong."
    )
    planned = f"of {rules.looks} planned" if rules.looks > 1 else "the only one planned"
    first = (
        f"The verdicts are the first look at these poses, {planned}. Poses that are added"
        " afterwards are a further look ('teatbench compare --together'), which has only what the"
        " first one left of that chance, and needs more of them."
    )
    return Notes("How often chance alone misleads", (made, first))


def _by_chance(rule: Any) -> bool:
    """Whether a requirement is decided, or bounded, with a confidence."""
    return hasattr(rule, "confidence") and getattr(rule, "rate", True) is not None


def _is_interval(title: str) -> bool:
    return "interval" in title


def _is_p(title: str) -> bool:
    return title == "p" or title.startswith("p-value")


def _cells(parts: Sequence[Any], wanted: Any) -> int:
    """The filled cells of the columns with such titles, or units."""
    return sum(
        bool(_text(row[at]).strip()) and _text(row[at]) != NOT_MEASURED
        for part in parts
        for table in _tables(part)
        for at, column in enumerate(table.columns)
        if wanted(column.title) or wanted(column.unit)
        for row in table.rows
    )


def _text(cell: Cell | str) -> str:
    return cell if isinstance(cell, str) else cell.text


def _tables(part: Any) -> Iterator[Table]:
    if isinstance(part, Table):
        yield part
    elif isinstance(part, tuple | list):
        for one in part:
            yield from _tables(one)
    elif is_dataclass(part) and not isinstance(part, type):
        for field in fields(part):
            yield from _tables(getattr(part, field.name))
