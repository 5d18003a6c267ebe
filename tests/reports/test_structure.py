"""The page as text: headings, ids, references, the policy, where parts stand, and that the same
page gives the same bytes.
"""

import base64
import dataclasses
import hashlib
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

from reports.figures.course import bath_curve
from reports.figures.errors import error_histogram
from reports.frames import Label, Overlay
from reports.page import VERDICTS, Banner, Figure, KeyValues, Page, Paragraph, Part, Section
from reports.render import render, write_report
from reports.trust import PageError
from tests.reports.markup import Document, read
from tests.reports.sample import sample_page

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> tuple[Page, Path]:
    folder = tmp_path_factory.mktemp("report")
    return sample_page(folder), folder


@pytest.fixture(scope="module")
def html(sample: tuple[Page, Path]) -> str:
    return render(sample[0])


@pytest.fixture(scope="module")
def document(html: str) -> Document:
    return read(html)


def test_elements_close_where_they_opened_and_headings_descend_level_by_level(
    document: Document,
) -> None:
    assert document.misplaced == []
    levels = [int(element.tag[1]) for element in document.all("h1", "h2", "h3", "h4")]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after - before <= 1 for before, after in pairwise(levels))


def test_chapters_stand_in_the_page_s_order_and_in_the_contents(document: Document) -> None:
    chapters = "verdict requirements trial-list rates accuracy bath provenance trials"
    assert " ".join(part.attributes["id"] for part in document.all("section")) == chapters
    contents = document.by_id("contents").text
    for title in ("Requirements", "Rates, beside the thesis", "Trial by trial"):
        assert title in contents


def test_ids_are_unique_and_every_fragment_leads_to_one(document: Document) -> None:
    trials = [element.attributes["id"] for element in document.all("article")]
    assert trials == [f"trial-{number:03}" for number in range(1, 7)]
    ids = document.values("id")
    assert sorted(ids) == sorted(set(ids))
    fragments = {value[1:] for value in document.values("href") if value.startswith("#")}
    fragments |= {value[5:-1] for value in document.values("clip-path")}
    assert fragments - set(ids) == set()


def test_images_are_relative_lazy_sized_described_and_there(
    sample: tuple[Page, Path], document: Document
) -> None:
    images = document.all("img")
    assert len(images) == 18
    for image in images:
        assert (sample[1] / image.attributes["src"]).is_file()
        assert image.attributes["loading"] == "lazy"
        assert (image.attributes["width"], image.attributes["height"]) == ("640", "480")
        assert image.attributes["alt"].startswith("Four")


def test_tables_name_their_columns_and_rows(document: Document) -> None:
    assert len(document.all("table")) == len(document.all("caption")) == 9
    assert all(element.attributes.get("scope") in {"col", "row"} for element in document.all("th"))


def test_overlays_are_drawn_on_pixel_centres(document: Document) -> None:
    pane = next(element for element in document.all("svg") if "data-whole" in element.attributes)
    assert pane.attributes["viewbox"] == "139.5 99.5 400 240"
    assert pane.attributes["data-whole"] == "-0.5 -0.5 640 480"
    rings = [ring.attributes for ring in document.all("circle")]
    truth = [ring for ring in rings if ring["r"] == "9"]
    assert (truth[0]["cx"], truth[0]["cy"]) == ("190", "250")


def test_a_number_by_the_right_edge_of_a_view_stands_on_the_other_side_of_its_mark(
    sample: tuple[Page, Path],
) -> None:
    """The sample's view ends at column 540."""
    (first, *more) = sample[0].trials
    numbers = Overlay("truth", "truth", (Label(300, 50, "1", 9), Label(525, 50, "2", 9)))
    image = dataclasses.replace(first.images[0], overlays=(numbers,))
    trial = dataclasses.replace(first, images=(image,))
    page = read(render(dataclasses.replace(sample[0], trials=(trial, *more))))
    texts = [one for one in page.all("text") if one.attributes.get("y") == "50"][:2]
    assert [(one.text, one.attributes["x"]) for one in texts] == [("1", "309"), ("2", "516")]
    assert texts[1].attributes["text-anchor"] == "end"


def test_policy_allows_exactly_this_style_and_script(html: str, document: Document) -> None:
    metas = [meta.attributes for meta in document.all("meta")]
    policy = next(meta for meta in metas if "http-equiv" in meta)["content"]
    assert policy.startswith("default-src 'none'; ")
    assert "unsafe" not in policy
    for tag in ("style", "script"):
        texts = re.findall(rf"<{tag}>(.*?)</{tag}>", html, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(texts[0].encode()).digest()).decode()
        assert len(texts) == 1
        assert f"{tag}-src 'sha256-{digest}'" in policy
    assert document.values("style") == []


@pytest.mark.parametrize("word", VERDICTS)
def test_verdict_words_are_written_out(word: str) -> None:
    page = read(render(Page("A run", "", Banner("real", word, "t", "s", "c", "n"), ())))  # type: ignore[arg-type]
    assert word in page.by_id("top-verdict").text
    assert "REAL INSTRUMENTS" in page.all("header")[0].text


def test_two_renderings_and_two_processes_give_the_same_bytes(
    sample: tuple[Page, Path], html: str, tmp_path: Path
) -> None:
    here = write_report(sample[0], sample[1]).read_bytes()
    assert html.encode() == here
    code = (
        "import sys; from pathlib import Path; from tests.reports.sample import sample_page; from"
        " reports.render import write_report\nfolder = Path(sys.argv[1]);"
        " write_report(sample_page(folder), folder)"
    )
    root = Path(__file__).resolve().parents[2]
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True, cwd=root)
    assert (tmp_path / "index.html").read_bytes() == here


def test_the_file_is_written_whole_or_not_at_all(sample: tuple[Page, Path], tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("the last report", encoding="utf-8")
    said = r"18 images are not there: frames/trial-001/left\.png.* and 13 more; write the images"
    with pytest.raises(PageError, match=said):
        write_report(sample[0], tmp_path)
    assert (tmp_path / "index.html").read_text(encoding="utf-8") == "the last report"
    written = write_report(sample[0], sample[1])
    assert b"\r" not in written.read_bytes()
    assert list(sample[1].glob("*.part")) == []


def test_the_page_can_be_described_without_matplotlib_or_jinja() -> None:
    code = (
        "import sys, reports, reports.page; sys.exit(any(name in sys.modules for name in"
        " ('matplotlib', 'jinja2', 'numpy')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


BANNER = Banner("real", "met", "", "", "", "")


def page_of(*parts: Part) -> Document:
    return read(render(Page("p", "", BANNER, (Section("s", "s", parts),))))


def classes(*parts: Part) -> str:
    """What the page's figures are, in order: half, lone (wide and alone), or wide."""
    found = (figure.attributes["class"] for figure in page_of(*parts).all("figure"))
    names = (name.removeprefix("part drawn").removeprefix(" wide ") for name in found)
    return " ".join(name.strip() or "half" for name in names)


HALF = '<svg viewBox="0 0 338.4 302.4"/>'


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ("half half", "half half"),
        ("half half half", "half half lone"),
        ("half half half half", "half half half half"),
        ("half", "lone"),
        ("half text half half text half", "lone half half lone"),
        ("half wide half", "lone lone lone"),
    ],
)
def test_two_halves_share_a_row_and_one_beside_nothing_has_its_own(
    parts: str, expected: str
) -> None:
    known = {"half": Figure(HALF, "c", "a"), "wide": Figure(HALF, "c", "a", wide=True)}
    assert classes(*(known.get(word, Paragraph("text")) for word in parts.split())) == expected


def test_a_drawing_made_for_half_a_page_is_not_blown_up() -> None:
    bath = bath_curve([0.0, 1.0], [33.0, 33.0], 33.0, 0.1, [], [])
    half = error_histogram([1.0, 2.0], 5.0)
    assert (
        classes(Figure(bath, "b", "b", wide=True), Figure(half, "h", "h", wide=True)) == "wide lone"
    )


@pytest.mark.parametrize(("value", "expected"), [("short", "entry"), ("x" * 61, "entry long")])
def test_a_long_value_has_a_line_of_its_own(value: str, expected: str) -> None:
    page = page_of(KeyValues("k", (("name", value),)))
    assert expected in [div.attributes.get("class") for div in page.all("div")]


def test_the_first_screen_leads_to_the_worst_three(sample: tuple[Page, Path], html: str) -> None:
    worst = ("trial-005", "trial-002", "trial-006", "trial-001")
    page = dataclasses.replace(sample[0], sections=(), worst=worst)
    shown = render(page)
    spans = read(shown).all("span")
    looks = [span.text for span in spans if span.attributes.get("class") == "looks"]
    assert looks == ["Look first at Trial 5, Trial 2, Trial 6."]
    together = '<a href="#trial-005">Trial 5</a>,</span> <span><a href="#trial-002">'
    assert together in shown, "a comma doesn't begin a line"
    assert "Look first at" not in html
    aborted = dataclasses.replace(page, banner=dataclasses.replace(page.banner, verdict="aborted"))
    assert "Look first at" not in render(aborted)
