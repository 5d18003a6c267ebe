"""The single file for mail: pictures in it, the worst trials first, never larger than allowed; and
the PDF by a browser.
"""

import dataclasses
import sys
from pathlib import Path

import pytest

from reports.mail import write_single_file
from reports.page import Page
from reports.pdf import find_browser, print_pdf
from reports.render import write_report
from reports.trust import PageError
from tests.chromium import NAMES, browser_page, chromium
from tests.reports.markup import read
from tests.reports.sample import sample_page


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Page, Path]:
    folder = tmp_path_factory.mktemp("mail")
    return dataclasses.replace(sample_page(folder), worst=("trial-005", "trial-002")), folder


def articles(path: Path) -> list[str]:
    return [
        element.attributes["id"]
        for element in read(path.read_text(encoding="utf-8")).all("article")
    ]


def test_everything_is_in_the_one_file(made: tuple[Page, Path], tmp_path: Path) -> None:
    alone = write_single_file(*made, tmp_path / "alone.html")
    document = read(alone.read_text(encoding="utf-8"))
    assert articles(alone) == [f"trial-{number:03}" for number in range(1, 7)]
    assert [
        value for value in document.values("src") if not value.startswith("data:image/png;base64,")
    ] == []
    assert [
        link.attributes["href"]
        for link in document.all("a")
        if not link.attributes["href"].startswith("#")
    ] == []
    assert "trials.csv" in document.by_id("provenance").text


def test_the_worst_trials_go_first_where_there_is_no_room(
    made: tuple[Page, Path], tmp_path: Path
) -> None:
    bare = len(
        write_single_file(
            dataclasses.replace(made[0], trials_note="x" * 200), made[1], tmp_path / "all.html"
        ).read_bytes()
    )
    for most in (bare * 7 // 10, bare * 4 // 5):
        small = write_single_file(*made, tmp_path / "small.html", most)
        kept = articles(small)
        assert small.stat().st_size <= most
        assert 0 < len(kept) < 6
        assert "trial-005" in kept
        assert (
            f"{len(kept)} of 6 trials are in this file"
            in read(small.read_text(encoding="utf-8")).by_id("trials").text
        )


def test_a_page_that_fits_no_way_is_refused(made: tuple[Page, Path], tmp_path: Path) -> None:
    with pytest.raises(PageError, match="the page alone is larger than 1000 bytes"):
        write_single_file(*made, tmp_path / "no.html", 1000)
    assert list(tmp_path.iterdir()) == []


def test_only_jpeg_and_png_travel(made: tuple[Page, Path], tmp_path: Path) -> None:
    trial = made[0].trials[0]
    odd = dataclasses.replace(trial.images[0], src="odd.bmp", original="")
    (made[1] / "odd.bmp").write_bytes(b"BM")
    page = dataclasses.replace(
        made[0], trials=(dataclasses.replace(trial, images=(odd,)), *made[0].trials[1:])
    )
    with pytest.raises(PageError, match=r"odd\.bmp: a file for mail holds JPEG and PNG, no \.bmp"):
        write_single_file(page, made[1], tmp_path / "no.html")


@pytest.mark.browser
def test_it_opens_anywhere_with_its_pictures(made: tuple[Page, Path], tmp_path: Path) -> None:
    alone = write_single_file(*made, tmp_path / "alone.html")
    with browser_page() as seen:
        page = seen.open(alone, "trial-003")
        assert set(seen.image_widths().values()) == {640}
        assert page.locator("#trial-003 .pane").count() == 3
        assert seen.network_requests() == []
        assert seen.complaints == []


@pytest.mark.browser
def test_a_browser_prints_the_page(made: tuple[Page, Path], tmp_path: Path) -> None:
    target = print_pdf(write_report(*made), tmp_path / "report.pdf", chromium())
    assert target.read_bytes().startswith(b"%PDF-")
    assert target.stat().st_size > 100_000  # with its pictures
    assert [path.name for path in tmp_path.iterdir()] == ["report.pdf"]


def test_a_program_that_prints_nothing_is_told(made: tuple[Page, Path], tmp_path: Path) -> None:
    with pytest.raises(
        PageError, match=r"report\.pdf: .* ended with code 2 and printed nothing: .*unknown option"
    ):
        print_pdf(write_report(*made), tmp_path / "report.pdf", sys.executable)
    with pytest.raises(PageError, match="could not print it"):
        print_pdf(write_report(*made), tmp_path / "report.pdf", str(tmp_path / "no-such-browser"))


def test_where_no_browser_is_there_is_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    for root in ("ProgramFiles", "ProgramFiles(x86)", "LOCALAPPDATA"):
        monkeypatch.setenv(root, str(tmp_path))
    assert find_browser(NAMES) is None or sys.platform == "darwin"
