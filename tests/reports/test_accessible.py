"""axe-core finds nothing: in the page, in a trial's own file, light and dark, wide and narrow."""

from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from reports.render import write_report
from tests.axe import violations
from tests.chromium import Scheme, window
from tests.reports.sample import sample_page

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    few, many = tmp_path_factory.mktemp("few"), tmp_path_factory.mktemp("many")
    write_report(sample_page(few), few)
    write_report(sample_page(many, 7), many)
    return {
        "page": few / "index.html",
        "list": many / "index.html",
        "trial": many / "trials" / "trial-004.html",
    }


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(
    ("which", "width"), [("page", 1440), ("page", 390), ("list", 1440), ("trial", 390)]
)
def test_axe_is_content(
    browser: Browser, folders: dict[str, Path], which: str, width: int, scheme: Scheme
) -> None:
    with window(browser, width=width, scheme=scheme) as seen:
        assert violations(seen.open(folders[which])) == []


def test_axe_is_content_with_a_zoomed_frame_and_the_list_of_keys(
    browser: Browser, folders: dict[str, Path]
) -> None:
    with window(browser, width=390, scheme="dark") as seen:
        page = seen.open(folders["page"], "trial-002")
        page.keyboard.press("+")
        expect(page.locator("#trial-002 .pane.moved")).to_have_count(3)
        page.keyboard.press("?")
        expect(page.locator("#keys")).to_be_visible()
        assert violations(page) == []


def test_axe_would_have_seen_a_fault(browser: Browser, folders: dict[str, Path]) -> None:
    with window(browser) as seen:
        page = seen.open(folders["trial"])
        page.evaluate("() => document.querySelector('.pane img').removeAttribute('alt')")
        assert [rule for rule, _ in violations(page)] == ["image-alt"]
