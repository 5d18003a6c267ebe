"""Where parts stand: figures of half a page alone in their row, values that need a line of their
own, links of the first screen.
"""

import dataclasses
from pathlib import Path

import pytest

from reports import figures
from reports.page import Banner, Figure, KeyValues, Page, Paragraph, Part, Section
from reports.render import render
from tests.reports.markup import read
from tests.reports.sample import sample_page

BANNER = Banner("real", "met", "", "", "", "")


def half(name: str) -> Figure:
    return Figure(figures.error_histogram([1.0, 2.0], 5.0, name=name), name, name)


def wide(name: str) -> Figure:
    return dataclasses.replace(half(name), wide=True)


def classes(*parts: Part) -> list[str]:
    """What the page's figures are, in order: half, alone over the page, or wide."""
    found = read(render(Page("p", "", BANNER, (Section("s", "s", parts),)))).all("figure")
    return [
        element.attributes["class"].removeprefix("part drawn").strip() or "half"
        for element in found
    ]


TEXT = Paragraph("text")
ALONE = "wide lone"


def test_two_halves_share_a_row_and_a_third_has_one_of_its_own() -> None:
    assert classes(half("a"), half("b")) == ["half", "half"]
    assert classes(half("a"), half("b"), half("c")) == ["half", "half", ALONE]
    assert classes(half("a"), half("b"), half("c"), half("d")) == ["half"] * 4


def test_a_half_beside_nothing_gets_the_row() -> None:
    assert classes(half("a")) == [ALONE]
    assert classes(half("a"), TEXT, half("b"), half("c"), TEXT, half("d")) == [
        ALONE,
        "half",
        "half",
        ALONE,
    ]


def test_a_drawing_made_for_half_a_page_is_not_blown_up() -> None:
    assert classes(half("a"), wide("b"), half("c")) == [ALONE, ALONE, ALONE]
    bath = figures.bath_curve([0.0, 1.0], [33.0, 33.0], 33.0, 0.1, [], [], None)
    assert classes(Figure(bath, "bath", "bath", wide=True)) == ["wide"]


@pytest.mark.parametrize(("value", "expected"), [("short", "entry"), ("x" * 61, "entry long")])
def test_a_long_value_has_a_line_of_its_own(value: str, expected: str) -> None:
    page = Page("p", "", BANNER, (Section("s", "s", (KeyValues("k", (("name", value),)),)),))
    assert expected in [
        element.attributes.get("class") for element in read(render(page)).all("div")
    ]


def test_the_first_screen_leads_to_the_worst_three(tmp_path: Path) -> None:
    page = dataclasses.replace(
        sample_page(tmp_path), worst=("trial-005", "trial-002", "trial-006", "trial-001")
    )
    looks = next(
        element
        for element in read(render(page)).all("span")
        if element.attributes.get("class") == "looks"
    )
    assert looks.text == "Look first at Trial 5, Trial 2, Trial 6."
    assert '<a href="#trial-005">Trial 5</a>, <a href="#trial-002">' in render(page)
    aborted = dataclasses.replace(page, banner=dataclasses.replace(page.banner, verdict="aborted"))
    assert "Look first at" not in render(aborted)
    assert "Look first at" not in render(dataclasses.replace(page, worst=()))
