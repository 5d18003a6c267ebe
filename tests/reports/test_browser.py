"""The page, and that over many runs, in a real browser, from disk, offline: everything shows, keys
and switches work, and axe-core finds nothing.
"""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from reports.render import write_report
from reports.runs import DetectorResult, Run, Runs, write_runs
from tests.chromium import Seen, violations, weak_texts, window
from tests.examples import few
from tests.reports.sample import sample_page

pytestmark = [pytest.mark.browser, pytest.mark.slow]  # a browser starts for some seconds


@pytest.fixture
def seen(browser: Browser, report: Path) -> Iterator[Seen]:
    """The report in a fresh window, at its top."""
    with window(browser) as fresh:
        fresh.open(report)
        yield fresh


def test_the_policy_stops_what_would_call_out(seen: Seen) -> None:
    """Were text ever to slip through as markup, it still could not run or load anything."""
    seen.page.evaluate(
        """() => { const image = new Image(); image.src = 'http://example.invalid/x.png'; document.body.append(image);
        const script = document.createElement('script'); script.textContent = 'window.slipped = 1'; document.body.append(script); }"""
    )
    seen.page.wait_for_function("() => true")
    assert seen.page.evaluate("() => window.slipped") is None
    assert sum("Content Security Policy" in text for text in seen.complaints) >= 2


def test_deep_link_shows_its_trial(seen: Seen, report: Path) -> None:
    seen.page.goto("about:blank")
    page = seen.open(report, "trial-002")
    expect(page.locator("#trial-002")).to_be_in_viewport()
    top = page.locator("#trial-002").evaluate("element => element.getBoundingClientRect().top")
    covered = page.locator("#layers").evaluate("element => element.getBoundingClientRect().bottom")
    assert covered <= top < 200


def test_overlays_switch_one_by_one_and_all_at_once(seen: Seen) -> None:
    page = seen.page
    truth = page.locator("#trial-001 .pane .layer-truth").first
    region = page.locator("#trial-001 .pane .layer-region").first
    expect(truth).to_be_visible()
    page.get_by_label("truth").uncheck()
    expect(truth).to_be_hidden()
    expect(region).to_be_visible()
    page.keyboard.press("o")
    expect(region).to_be_hidden()
    page.keyboard.press("o")
    expect(region).to_be_visible()
    expect(truth).to_be_hidden()


def test_overlay_lies_over_its_pixel_in_both_views(seen: Seen) -> None:
    """The first teat's truth, pixel (190, 250), is where that pixel of the picture is."""
    gap = """() => { const pane = document.querySelector('#trial-001 .pane'), image = pane.querySelector('img').getBoundingClientRect();
        const mark = pane.querySelector('.layer-truth circle').getBoundingClientRect();
        const x = image.left + (190.5 / 640) * image.width, y = image.top + (250.5 / 480) * image.height;
        return [mark.left + mark.width / 2 - x, mark.top + mark.height / 2 - y, image.width / 640]; }"""
    seen.page.locator("#trial-001").scroll_into_view_if_needed()
    close = seen.page.evaluate(gap)
    seen.page.keyboard.press("z")
    whole = seen.page.evaluate(gap)
    assert close[:2] == pytest.approx([0, 0], abs=0.25)
    assert whole[:2] == pytest.approx([0, 0], abs=0.25)
    assert close[2] == pytest.approx(1.6 * whole[2], rel=0.01)


def test_keys_walk_through_the_trials_and_show_their_help(seen: Seen) -> None:
    page, dialog = seen.page, seen.page.locator("#keys")
    page.keyboard.press("?")
    expect(dialog).to_be_visible()
    page.keyboard.press("Escape")
    expect(dialog).to_be_hidden()
    for key, expected in (("j", "001"), ("j", "002"), ("j", "003"), ("k", "002")):
        page.keyboard.press(key)
        expect(page).to_have_url(re.compile(f"#trial-{expected}$"))
        expect(page.locator(f"#trial-{expected}")).to_be_in_viewport()


def test_filter_narrows_the_list_and_the_trials(seen: Seen) -> None:
    page = seen.page
    page.keyboard.press("/")
    page.keyboard.type("hot ends")
    expect(page.locator("#trial-list tbody tr:visible")).to_have_count(1)
    expect(page.locator(".count")).to_have_text("1 of 6")
    expect(page.locator("article.trial:visible")).to_have_count(1)
    page.keyboard.press("Escape")
    expect(page.locator("article.trial:visible")).to_have_count(6)


def test_columns_sort_by_number_and_back_and_points_open_trials(seen: Seen) -> None:
    head = seen.page.locator("#trial-list th").nth(4).get_by_role("button")
    cells = seen.page.locator("#trial-list tbody tr td:last-child")
    head.click()
    rising = [float(text) for text in cells.all_inner_texts()]
    head.click()
    falling = [float(text) for text in cells.all_inner_texts()]
    assert rising == sorted(rising)
    assert falling == rising[::-1]
    # a point of the plot opens its trial
    seen.page.locator("#accuracy .plot a").first.click()
    expect(seen.page).to_have_url(re.compile("#trial-001$"))


def test_nothing_sticks_out_of_the_page(seen: Seen) -> None:
    for width in (1440, 1153, 1150, 961, 820, 390, 320):
        seen.page.set_viewport_size({"width": width, "height": 844})
        assert seen.page.evaluate("() => document.documentElement.scrollWidth") <= width, width
        expect(seen.page.locator("#verdict .next")).to_be_visible()


def test_coordinates_stay_on_one_line_of_a_tablet(browser: Browser, report: Path) -> None:
    with window(browser, width=768) as seen:
        page = seen.open(report, "trial-002")
        cells, place = page.locator("#trial-002 .scroll tbody td"), "-110.2, 284.5, 134.2"
        cells.evaluate_all("(all, text) => all.forEach((one) => one.replaceChildren(text))", place)
        assert max(cells.evaluate_all("(all) => all.map((one) => one.offsetHeight)")) < 40


def test_readable_without_javascript(browser: Browser, report: Path) -> None:
    with window(browser, javascript=False) as seen:
        page = seen.open(report, "trial-003")
        expect(page.locator("#trial-003")).to_be_in_viewport()
        expect(page.locator("#trial-003 .pane .layer-point").first).to_be_visible()
        expect(page.locator(".filter")).to_be_hidden()
        page.get_by_label("final point").uncheck()
        expect(page.locator("#trial-003 .pane .layer-point").first).to_be_hidden()
        assert seen.network_requests() == []


def test_prints_in_light_colours_without_the_controls(seen: Seen) -> None:
    seen.page.emulate_media(media="print", color_scheme="dark")
    expect(seen.page.locator("#contents")).to_be_hidden()
    expect(seen.page.locator("#layers")).to_be_hidden()
    assert seen.page.evaluate("() => getComputedStyle(document.body).color") == "rgb(27, 39, 51)"
    assert seen.page.pdf().startswith(b"%PDF-")


def test_a_frame_is_enlarged_and_back(seen: Seen) -> None:
    frame, width = seen.page.locator("#trial-001 .frame").first, "e => e.clientWidth"
    small = frame.locator("img").evaluate(width)
    button = frame.get_by_role("button", name="Enlarge Left camera")
    button.click()
    assert frame.locator("img").evaluate(width) > 2.5 * small
    expect(button).to_have_attribute("aria-pressed", "true")
    button.click()
    assert frame.locator("img").evaluate(width) == pytest.approx(small)


@pytest.fixture(scope="module")
def folders(report: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    many = tmp_path_factory.mktemp("many")
    listed = write_report(sample_page(many, 7), many)
    return {"page": report, "list": listed, "trial": many / "trials" / "trial-004.html"}


@pytest.mark.parametrize(
    ("which", "width"), few([("page", 1440), ("page", 390), ("trial", 390), ("list", 1440)], 2)
)
def test_axe_is_content(browser: Browser, folders: dict[str, Path], which: str, width: int) -> None:
    """A page in the dark differs by its colours only."""
    with window(browser, width=width) as seen:
        page = seen.open(folders[which])
        assert violations(page) == []
        assert weak_texts(page) == []
        page.emulate_media(color_scheme="dark")
        assert weak_texts(page) == []


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
        for weak in ("color: rgb(120 120 120)", "opacity: 0.4"):
            page.evaluate(f"() => document.querySelector('h1').style.cssText = '{weak}'")
            assert len(weak_texts(page)) == 1, weak


NAME = '<img src=x onerror="document.title=1">'
FOUND = (
    DetectorResult(NAME, "1", "met", 4, 4, 0, 0.5, 1.0),
    DetectorResult("a", "", "aborted", 0, 0, 0, None, None),
)
RUN = Run(
    folder=Path("20261122-101500-demo"),
    started="2026-11-22T10:15:00+00:00",
    title=NAME,
    script="demo",
    kind="emulated",
    ending="aborted",
    status={"state": "aborted", "done": 3, "planned": 60},
    results=FOUND,
    damage=(),
    report="20261122-101500-demo/report/index.html",
    note="Aborted: 3 of 60 trials.",
    thumbnails=(("left, trial 001", "/9j/4AAQ"),),
)


@pytest.mark.parametrize("width", [1440, 390])
def test_the_page_over_runs_takes_hostile_names_and_axe_is_content(
    browser: Browser, tmp_path: Path, width: int
) -> None:
    runs = (RUN, dataclasses.replace(RUN, report="", note=""))
    path = write_runs(Runs(tmp_path, runs, (("old", "why"),)), "2 runs.")
    with window(browser, width=width) as seen:
        page = seen.open(path)
        assert violations(page) == []
        page.emulate_media(color_scheme="dark")
        assert weak_texts(page) == []
        assert page.title() == "Runs"
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
