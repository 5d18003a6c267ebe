"""A quality page, opened from disk in a real browser without a network."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.chromium import browser_page

pytestmark = pytest.mark.browser


def test_the_first_screen_says_how_good_it_is_and_nothing_is_asked_of_a_network(lab: Path) -> None:
    with browser_page() as seen:
        page = seen.open(lab / "cameras.page" / "index.html")
        top = page.locator("#verdict").inner_text().lower()
        for words in (
            "good to",
            "mm at",
            "12 pairs of views",
            "place the board's points",
            "what to do next",
        ):
            assert words in top, words
        assert seen.network_requests() == []
        assert seen.complaints == []


def test_its_figures_are_drawn_and_its_sections_are_there(lab: Path) -> None:
    with browser_page() as seen:
        page = seen.open(lab / "cameras.page" / "index.html")
        for section in (
            "findings",
            "parameters",
            "residuals",
            "held-out",
            "worth",
            "coverage",
            "pictures",
            "provenance",
        ):
            assert page.locator(f"section#{section}").count() == 1, section
        drawn = page.locator("section svg")
        sizes = [drawn.nth(at).bounding_box() for at in range(drawn.count())]
        assert len([size for size in sizes if size and size["width"] > 200]) == 3, (
            "residuals of both cameras, precision by distance"
        )
        assert "Nothing: no fault left a mark" in page.locator("section#findings").inner_text()
