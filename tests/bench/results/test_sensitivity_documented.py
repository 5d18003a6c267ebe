"""docs/sensitivity.md: its command is one, its figures are there, of the quantities and the values
that the bench has.
"""

from __future__ import annotations

import csv
import re
import shlex

from bench.cli.main import parser
from bench.report.sensitivity import COLUMNS, PAGE, POINTS
from bench.results.sensitivity import QUANTITIES
from tests.conftest import ROOT

DOCS = ROOT / "docs"
TEXT = (DOCS / "sensitivity.md").read_text(encoding="utf-8")


def test_every_quantity_has_its_figure() -> None:
    assert re.findall(r"\]\(sensitivity/([a-z-]+)\.svg\)", TEXT) == list(QUANTITIES)
    for name, quantity in QUANTITIES.items():
        figure = (DOCS / "sensitivity" / f"{name}.svg").read_text(encoding="utf-8")
        assert quantity.label in figure.replace("&#39;", "'").replace("&apos;", "'")
    assert f"(sensitivity/{PAGE})" in TEXT


def measured() -> list[dict[str, str]]:
    with (DOCS / "sensitivity" / POINTS).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_its_command_made_what_lies_beside_it() -> None:
    (command,) = re.findall(r"^teatbench (scene sensitivity .*)$", TEXT, flags=re.MULTILINE)
    given = parser().parse_args(shlex.split(command))
    rows = measured()
    assert tuple(rows[0]) == COLUMNS
    assert {row["detector"] for row in rows} == set(given.detector)
    for name, quantity in QUANTITIES.items():
        assert sorted({float(row["value"]) for row in rows if row["quantity"] == name}) == list(
            quantity.values
        )
    assert max(int(row["visible"]) for row in rows) == 4 * given.seeds
    page = (DOCS / "sensitivity" / PAGE).read_text(encoding="utf-8")
    assert f"members 0 to {given.seeds - 1} of `ideal`" in page


def found(detector: str, quantity: str) -> list[tuple[float, int, int]]:
    """Value, found, visible."""
    chosen = [
        row for row in measured() if (row["detector"], row["quantity"]) == (detector, quantity)
    ]
    return [(float(row["value"]), int(row["found"]), int(row["visible"])) for row in chosen]


def test_what_the_page_says_of_fused_is_what_was_measured() -> None:
    """Each sentence of "What they show" that a new measurement could belie: then the page has to
    say something else.
    """
    words = " ".join(TEXT.split())
    assert "It loses no end by lean, range, contrast, overlap or noise of the pictures" in words
    for quantity in ("tilt", "range", "contrast", "overlap", "pixel-noise"):
        assert all(seen == visible for _, seen, visible in found("fused", quantity)), quantity
    assert (
        "a few before an arm, and some where the calibration is wrong by 0.4 px and more" in words
    )
    assert all(0.8 * visible < seen <= visible for _, seen, visible in found("fused", "arm-gap"))
    assert [value for value, seen, visible in found("fused", "calibration") if seen < visible] == [
        0.4,
        0.5,
    ]
    assert all(seen == visible for value, seen, visible in found("fused", "netd") if value <= 2.0)
    assert all(
        float(row["median_mm"]) < 1.5 * float(row["disparity_mm"])
        for row in measured()
        if (row["detector"], row["quantity"]) == ("fused", "range")
    )


def test_what_the_page_says_of_the_thesis_is_what_was_measured() -> None:
    assert "`thesis` is 11 to 18 mm off in the median" in TEXT
    medians = [
        float(row["median_mm"])
        for row in measured()
        if row["detector"] == "thesis" and row["median_mm"]
    ]
    assert (round(min(medians)), round(max(medians))) == (11, 18)
    assert not any(seen for _, seen, _ in found("thesis", "arm-gap"))
    assert [value for value, seen, _ in found("thesis", "range") if seen] == [1.0, 1.15]


def test_every_value_stands_beside_what_physics_allows() -> None:
    for row in measured():
        assert float(row["limit_median_mm"]) > 0.0
        assert float(row["disparity_mm"]) > 0.0
        assert bool(row["limit_share"]) == (row["quantity"] == "netd")
