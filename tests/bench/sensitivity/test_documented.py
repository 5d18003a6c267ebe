"""docs/sensitivity.md: its command is one, its figures are there, of the quantities and the values that the bench has."""

from __future__ import annotations

import csv
import re
import shlex

from bench.cli import parser
from bench.sensitivity.output import COLUMNS, PAGE, POINTS
from bench.sensitivity.quantities import QUANTITIES
from tests.conftest import ROOT

DOCS = ROOT / "docs"
TEXT = (DOCS / "sensitivity.md").read_text(encoding="utf-8")


def test_every_quantity_has_its_figure() -> None:
    assert re.findall(r"\]\(sensitivity/([a-z-]+)\.svg\)", TEXT) == list(QUANTITIES)
    for name, quantity in QUANTITIES.items():
        figure = (DOCS / "sensitivity" / f"{name}.svg").read_text(encoding="utf-8")
        assert quantity.label in figure.replace("&#39;", "'").replace("&apos;", "'")
    assert f"(sensitivity/{PAGE})" in TEXT


def test_its_command_made_what_lies_beside_it() -> None:
    (command,) = re.findall(r"^teatbench (scene sensitivity .*)$", TEXT, flags=re.MULTILINE)
    given = parser().parse_args(shlex.split(command))
    with (DOCS / "sensitivity" / POINTS).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert {row["detector"] for row in rows} == set(given.detector)
    for name, quantity in QUANTITIES.items():
        assert sorted({float(row["value"]) for row in rows if row["quantity"] == name}) == list(quantity.values)
    assert max(int(row["visible"]) for row in rows) == 4 * given.seeds
    page = (DOCS / "sensitivity" / PAGE).read_text(encoding="utf-8")
    assert f"members 0 to {given.seeds - 1} of `ideal`" in page
