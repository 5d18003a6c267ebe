"""How many statements a page makes that each err by chance in some cases, counted from the page."""

from __future__ import annotations

import re
from collections.abc import Sequence

from bench.report.wording import NOT_MEASURED
from bench.script.model import (
    ErrorRequirement,
    FalseRequirement,
    Rules,
    SuccessRequirement,
    TimeRequirement,
)
from reports.page import Cell, Notes, Part, Table, unfolded
from textfiles.text import plural

CHANCE = 0.05  # of an interval, or a p-value, to mislead


def note_on_statements(parts: Sequence[Part], rules: Rules, detectors: int) -> Notes:
    """Says it once: the decisions on chance, the intervals and the p-values of these parts."""
    chances = [
        1.0 - rule.confidence
        for rule in rules.requirements
        if isinstance(rule, ErrorRequirement | SuccessRequirement | FalseRequirement)
        or (isinstance(rule, TimeRequirement) and rule.rate is not None)
    ] * detectors
    intervals, p_values = _cells(parts, ".*interval.*"), _cells(parts, "p|p-value.*")
    decided = f"{plural(len(chances), 'decision')} and bounds, one-sided"
    sums = f"{decided}, {plural(intervals, 'interval')}, two-sided, {plural(p_values, 'p-value')}"
    wrong = sum(chances) + CHANCE * (intervals + p_values)
    made = (
        f"This page makes {plural(len(chances) + intervals + p_values, 'statement')} that chance"
        f" makes wrong in at most {100 * CHANCE:g} % of cases each (a requirement: 1 - its"
        f" confidence): {sums}. Each holds by itself; of all of them some {wrong:.1f} may be wrong."
    )
    planned = f"of {rules.looks} planned" if rules.looks > 1 else "the only one planned"
    first = (
        f"The verdicts are the first look at these poses, {planned}. Poses that are added"
        " afterwards are a further look ('teatbench compare --together'), which has only what the"
        " first one left of that chance, and needs more of them."
    )
    return Notes("How often chance alone misleads", (made, first))


def _cells(parts: Sequence[Part], wanted: str) -> int:
    """The filled cells of the columns with such titles, or units, by a regular expression."""
    return sum(
        bool(_text(row[at]).strip()) and _text(row[at]) != NOT_MEASURED
        for table in unfolded(parts)
        if isinstance(table, Table)
        for at, column in enumerate(table.columns)
        if any(re.fullmatch(wanted, text, re.DOTALL) for text in (column.title, column.unit))
        for row in table.rows
    )


def _text(cell: Cell | str) -> str:
    return cell if isinstance(cell, str) else cell.text
