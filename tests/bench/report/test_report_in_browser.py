"""A real run's report, opened from disk in a real browser without a network."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from playwright.sync_api import expect

from bench.cli.main import main
from tests.axe import violations
from tests.chromium import Scheme, browser_page

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory, short_script: Path) -> Path:
    out = tmp_path_factory.mktemp("browsed")
    assert main(["run", str(short_script), "--out", str(out)]) in (0, 1, 4)
    (folder,) = out.iterdir()
    return folder / "report" / "index.html"


def test_the_first_screen_says_what_and_why_and_what_next(report: Path) -> None:
    with browser_page() as seen:
        page = seen.open(report)
        top = page.locator("#verdict").inner_text().lower()
        assert "emulated instruments" in page.locator("body").inner_text().lower()
        for words in (
            "not met",
            "error below 5 mm",
            "what to do next",
            "how sure",
            "detector thesis on 6 frame sets",
        ):
            assert words in top, words
        assert seen.network_requests() == []
        assert seen.complaints == []


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
def test_what_to_do_next_is_on_the_first_screen(report: Path, width: int, height: int) -> None:
    with browser_page(width=width, height=height) as seen:
        page = seen.open(report)
        for part in (
            "header .kind",
            "h1",
            "#top-verdict",
            "#verdict .why",
            "#verdict .next dt",
            "#verdict .next dd",
        ):
            box = page.locator(part).bounding_box()
            assert box is not None, part
            assert box["y"] + min(box["height"], 24) <= height, part
        links = page.locator("#verdict .looks a")
        expect(links).to_have_count(3)
        links.first.click()
        expect(page.locator("article.trial.here")).to_be_in_viewport()


def test_every_picture_is_there_and_nothing_is_asked_of_a_network(report: Path) -> None:
    with browser_page() as seen:
        seen.open(report)
        widths = seen.image_widths()
        assert len(widths) == 6 * 4
        assert all(width > 0 for width in widths.values()), widths
        assert sorted(set(widths.values())) == [640, 1360]
        assert seen.network_requests() == []
        assert not [url for url in seen.requests if url.startswith("http")]
        assert seen.complaints == []


def test_a_deep_link_opens_its_trial(report: Path) -> None:
    with browser_page() as seen:
        page = seen.open(report, "trial-004")
        part = page.locator("#trial-004")
        box = part.bounding_box()
        assert box is not None
        assert -5 <= box["y"] < 500
        assert "hot-body-at-base" in part.inner_text()
        assert part.locator("img").count() == 4
        assert part.locator("svg").count() >= 3


def test_links_of_the_trial_list_lead_to_the_trials(report: Path) -> None:
    with browser_page() as seen:
        page = seen.open(report)
        links = page.locator("#trial-list tbody a[href^='#trial-']")
        assert links.count() == 6
        links.nth(2).click()
        expect(page).to_have_url(re.compile("#trial-003$"))


def test_it_fits_a_telephone_and_the_dark(report: Path) -> None:
    with browser_page(width=390, height=800, scheme="dark") as seen:
        page = seen.open(report)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert seen.complaints == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_in_it(report: Path, scheme: Scheme) -> None:
    with browser_page(scheme=scheme) as seen:
        assert violations(seen.open(report)) == []


def test_the_worst_trials_are_linked_before_the_list(report: Path) -> None:
    with browser_page() as seen:
        page = seen.open(report)
        first = page.locator("#trial-list .entries a").first
        anchor = str(first.get_attribute("href"))
        first.click()
        expect(page).to_have_url(re.compile(re.escape(anchor) + "$"))
        assert "missed" in page.locator(anchor).inner_text()
