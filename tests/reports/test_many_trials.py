"""Many trials: each has a file of its own, the list leads to them with and without a script, and
the page stays small.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from reports.glossary import Term
from reports.page import Page, Part, Section, Table
from reports.render import IN_PAGE, render, write_report
from reports.trust import PageError
from tests.chromium import Seen, window
from tests.reports.markup import Document, read
from tests.reports.sample import sample_page

pytestmark = pytest.mark.slow

REPEATS = 8
COUNT = 6 * REPEATS


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> tuple[Page, Path]:
    folder = tmp_path_factory.mktemp("many")
    made = sample_page(folder, REPEATS)
    write_report(made, folder)
    return made, folder


@pytest.fixture(scope="module")
def document(page: tuple[Page, Path]) -> Document:
    return read((page[1] / "index.html").read_text(encoding="utf-8"))


@pytest.fixture
def seen(browser: Browser, page: tuple[Page, Path]) -> Iterator[Seen]:
    with window(browser) as fresh:
        fresh.open(page[1] / "index.html")
        yield fresh


def test_the_page_has_the_list_and_no_trial(document: Document) -> None:
    assert COUNT > IN_PAGE
    assert document.all("article") == []
    assert document.all("img") == []
    rows = [row.attributes["id"] for row in document.all("tr") if "id" in row.attributes]
    assert rows == [f"trial-{number:03}" for number in range(1, COUNT + 1)]
    links = [value for value in document.values("href") if value.startswith("trials/")]
    assert links == [f"trials/{name}.html" for name in rows]


def test_each_trial_has_a_file_whose_pictures_and_neighbours_are_there(
    page: tuple[Page, Path],
) -> None:
    folder = page[1] / "trials"
    assert len(list(folder.iterdir())) == COUNT
    for name, steps in (
        ("trial-001", ["trial-002.html"]),
        ("trial-020", ["trial-019.html", "trial-021.html"]),
    ):
        alone = read((folder / f"{name}.html").read_text(encoding="utf-8"))
        assert alone.misplaced == []
        assert [element.attributes["id"] for element in alone.all("article")] == [name]
        references = [*alone.values("src"), *alone.values("href")]
        files = [value.split("#")[0] for value in references if not value.startswith("#")]
        assert [value for value in files if not (folder / value).is_file()] == []
        links = [link.attributes for link in alone.all("a")]
        near = [link["href"] for link in links if link.get("rel") in ("prev", "next")]
        assert [link.removeprefix("../trials/") for link in near] == steps
        assert len(alone.all("h1")) == 1


def test_a_trial_that_no_list_begins_a_row_with_is_refused(page: tuple[Page, Path]) -> None:
    sections = tuple(section for section in page[0].sections if section.id != "trial-list")
    bare = dataclasses.replace(page[0], sections=(*sections, Section("trial-list", "x", ())))
    said = r"no searchable table begins a row with a link to \['trial-001'"
    with pytest.raises(PageError, match=said):
        render(bare)


def test_a_trial_with_two_rows_has_one_id_and_the_filter_keeps_both(
    page: tuple[Page, Path],
) -> None:
    """As where two detectors were run."""

    def twice(part: Part) -> Part:
        if not isinstance(part, Table):
            return part
        return dataclasses.replace(part, rows=tuple(row for row in part.rows for _ in "ab"))

    sections = tuple(
        dataclasses.replace(s, parts=tuple(map(twice, s.parts))) for s in page[0].sections
    )
    both = read(render(dataclasses.replace(page[0], sections=sections)))
    ids = both.values("id")
    assert len(ids) == len(set(ids))
    assert len([value for value in both.values("href") if value == "trials/trial-007.html"]) == 2


def test_worst_trials_have_to_be_trials_of_the_page(page: tuple[Page, Path]) -> None:
    with pytest.raises(PageError, match=r"\['trial-999'\] in 'worst' are no trials of it"):
        dataclasses.replace(page[0], worst=("trial-999",))


def test_a_large_page_s_folded_chapters_get_files_that_lead_to_each_other(
    page: tuple[Page, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_report(sample_page(tmp_path, REPEATS), tmp_path)
    for name in ("index.html", "trials/trial-007.html"):
        assert (tmp_path / name).read_bytes() == (page[1] / name).read_bytes(), "the same again"
    monkeypatch.setattr("reports.render.MOST_BYTES", 1)
    write_report(page[0], tmp_path)
    assert not (tmp_path / "whole.html").exists(), "nothing is folded"
    folded = {"trial-list", "accuracy"}
    sections = tuple(dataclasses.replace(one, folded=one.id in folded) for one in page[0].sections)
    terms = (Term("rms", "Root mean square."),)
    made = dataclasses.replace(page[0], sections=sections, trials_in="trial-list", glossary=terms)
    write_report(made, tmp_path)
    names = {"index.html", "trial-list.html", "accuracy.html", "glossary.html"}
    assert {path.name for path in tmp_path.glob("*.html")} == names | {"whole.html"}
    for path in [*map(tmp_path.joinpath, names), tmp_path / "trials" / "trial-007.html"]:
        text = read(path.read_text(encoding="utf-8"))
        assert text.misplaced == []
        links = [value.partition("#") for value in text.values("href")]
        for file, _, fragment in links:
            if file.endswith((".csv", ".json")):
                continue  # the bench writes them
            there = path.parent / file if file else path
            assert there.is_file(), (path.name, file)
            known = not fragment or f'id="{fragment}"' in there.read_text(encoding="utf-8")
            assert known, (path.name, fragment)
    monkeypatch.undo()
    write_report(made, tmp_path)
    assert [path.name for path in tmp_path.glob("*.html")] == ["index.html"]
    alone = read((tmp_path / "trials" / "trial-007.html").read_text(encoding="utf-8"))
    pages = {value.partition("#")[0] for value in alone.values("href") if "#" in value}
    assert pages - {""} == {"../index.html"}


def test_files_of_trials_wait_for_no_figure(page: tuple[Page, Path], tmp_path: Path) -> None:
    def finished(waiting: Page) -> Page:
        there.extend(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.html"))
        return dataclasses.replace(waiting, title="Finished")

    there = list[str]()
    made = sample_page(tmp_path, REPEATS)
    html = write_report(made, tmp_path, finished=finished).read_text(encoding="utf-8")
    assert sorted(there) == [f"trials/trial-{number:03}.html" for number in range(1, COUNT + 1)]
    assert "<h1>Finished</h1>" in html


@pytest.mark.browser
def test_a_link_opens_a_trial_and_escape_comes_back_to_its_row(seen: Seen) -> None:
    page = seen.page
    page.locator("#trial-005 a").click()
    expect(page.locator("article#trial-005")).to_be_visible()
    assert set(seen.image_widths().values()) == {640}
    page.get_by_label("truth").uncheck()
    expect(page.locator(".pane .layer-truth").first).to_be_hidden()
    page.keyboard.press("Escape")
    page.wait_for_url("**/index.html#trial-005")
    expect(page.locator("tr#trial-005")).to_be_in_viewport()
    assert seen.network_requests() == []
    assert seen.complaints == []


@pytest.mark.browser
def test_keys_follow_the_filter_into_the_files(seen: Seen) -> None:
    page = seen.page
    page.keyboard.press("/")
    page.keyboard.type("spurious")
    page.keyboard.press("Enter")
    expect(page.locator("#trial-list tbody tr:visible")).to_have_count(REPEATS)
    page.locator("#trial-list tbody tr:visible a").first.click()
    page.wait_for_url(f"**/trials/trial-{2 * REPEATS + 1:03}.html")
    page.keyboard.press("j")
    page.wait_for_url(f"**/trials/trial-{2 * REPEATS + 2:03}.html")
    page.keyboard.press("k")
    page.wait_for_url(f"**/trials/trial-{2 * REPEATS + 1:03}.html")
    page.keyboard.press("/")
    page.wait_for_url("**/index.html#filter")
    expect(page.locator(".filter input")).to_be_focused()


@pytest.mark.browser
def test_points_and_keys_open_a_trial_s_file(seen: Seen) -> None:
    page = seen.page
    link = page.locator("#accuracy .plot a").first
    anchor = str(link.get_attribute("href"))
    link.click()
    page.wait_for_url(f"**/trials/{anchor[1:]}.html")
    page.go_back()
    page.wait_for_url("**/index.html")
    for _ in "jj":
        page.keyboard.press("j")
    expect(page.locator("tr.here")).to_have_id("trial-002")
    page.keyboard.press("Enter")
    page.wait_for_url("**/trials/trial-002.html")


@pytest.mark.weekly
@pytest.mark.browser
def test_without_a_script_the_list_still_leads_to_the_trials(
    browser: Browser, page: tuple[Page, Path]
) -> None:
    with window(browser, javascript=False) as seen:
        opened = seen.open(page[1] / "index.html", "trial-040")
        expect(opened.locator("tr#trial-040")).to_be_in_viewport()
        opened.locator("#trial-040 a").click()
        expect(opened.locator("article#trial-040 .pane .layer-truth").first).to_be_visible()
        opened.get_by_role("link", name="next").click()
        expect(opened.locator("article#trial-041")).to_be_visible()
