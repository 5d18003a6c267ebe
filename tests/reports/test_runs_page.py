"""The page over many runs in a real browser: axe-core finds nothing, hostile names change nothing."""

from pathlib import Path

import pytest
from playwright.sync_api import Browser

from reports.runs import History, Result, RunCard, RunsPage, Step, write_runs
from tests.axe import violations
from tests.chromium import Scheme, window

pytestmark = pytest.mark.browser
HOSTILE = '<img src=x onerror="document.title=1">'
RUN = RunCard(
    "20261122-101500-demo",
    "20261122-101500-demo/report/index.html",
    "2026-11-22 10:15",
    HOSTILE,
    "demo",
    "emulated",
    "Aborted: 3 of 60 trials.",
    (Result(HOSTILE, "met", "4 of 4 found."), Result("thesis", "not met", "1 of 4 found.")),
    (("left, trial 001", "/9j/4AAQ"),),
)
STEPS = (Step("met", "100 %", RUN.href, "2026-11-22: met"), Step("aborted", "–", "", "aborted"))
PAGE = RunsPage("Runs", "1 run.", (RUN,), (History(HOSTILE, "demo", STEPS),), (("old", "why"),))


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1440, 390])
def test_axe_is_content(browser: Browser, tmp_path: Path, width: int, scheme: Scheme) -> None:
    path = write_runs(PAGE, tmp_path / "index.html")
    with window(browser, width=width, scheme=scheme) as seen:
        page = seen.open(path)
        assert violations(page) == []
        assert page.title() == "Runs"
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
