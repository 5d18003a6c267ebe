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

from reports import figures
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
def document(sample: tuple[Page, Path]) -> Document:
    return read(render(sample[0]))


def test_every_element_is_closed_where_it_was_opened(document: Document) -> None:
    assert document.misplaced == []


def test_headings_descend_one_level_at_a_time(document: Document) -> None:
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


def test_trials_have_their_anchors(document: Document) -> None:
    assert [element.attributes["id"] for element in document.all("article")] == [
        f"trial-{number:03}" for number in range(1, 7)
    ]


def test_ids_are_unique_and_every_fragment_leads_to_one(document: Document) -> None:
    ids = document.values("id")
    assert sorted(ids) == sorted(set(ids))
    fragments = {value[1:] for value in document.values("href") if value.startswith("#")}
    fragments |= {value[5:-1] for value in document.values("clip-path")}
    assert fragments - set(ids) == set()


def test_nothing_points_to_a_network(sample: tuple[Page, Path]) -> None:
    html = render(sample[0])
    addresses = set(re.findall(r'[\w:-]*="?[^"\s]*https?://[^"\s]*', html))
    assert addresses <= {'xmlns="http://www.w3.org/2000/svg'}
    document, names = read(html), ("href", "src", "srcset", "action", "data")
    references = [value for name in names for value in document.values(name)]
    assert [value for value in references if ":" in value or value.startswith("/")] == []


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


def test_policy_allows_exactly_this_style_and_script(sample: tuple[Page, Path]) -> None:
    html = render(sample[0])
    metas = [meta.attributes for meta in read(html).all("meta")]
    policy = next(meta for meta in metas if "http-equiv" in meta)["content"]
    assert policy.startswith("default-src 'none'; ")
    assert "unsafe" not in policy
    for tag in ("style", "script"):
        texts = re.findall(rf"<{tag}>(.*?)</{tag}>", html, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(texts[0].encode()).digest()).decode()
        assert len(texts) == 1
        assert f"{tag}-src 'sha256-{digest}'" in policy
    assert read(html).values("style") == []


def test_first_screen_says_what_whether_how_sure_and_what_next(
    sample: tuple[Page, Path], document: Document
) -> None:
    banner = sample[0].banner
    said = document.by_id("verdict").text
    for text in (banner.tested, banner.sentence, banner.confidence, banner.next_action, "not met"):
        assert text in said
    assert "EMULATED INSTRUMENTS" in document.all("header")[0].text
    assert document.all("title")[0].text == "Six situations: not met"


@pytest.mark.parametrize("word", VERDICTS)
def test_verdict_words_are_written_out(word: str) -> None:
    page = read(render(Page("A run", "", Banner("real", word, "t", "s", "c", "n"), ())))  # type: ignore[arg-type]
    assert word in page.by_id("top-verdict").text
    assert "REAL INSTRUMENTS" in page.all("header")[0].text


def test_two_renderings_and_two_processes_give_the_same_bytes(
    sample: tuple[Page, Path], tmp_path: Path
) -> None:
    here = write_report(sample[0], sample[1]).read_bytes()
    assert render(sample[0]).encode() == here
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


def half(name: str) -> Figure:
    return Figure(figures.error_histogram([1.0, 2.0], 5.0, name=name), name, name)


def wide(name: str) -> Figure:
    return dataclasses.replace(half(name), wide=True)


def classes(*parts: Part) -> list[str]:
    """What the page's figures are, in order: half, alone over the page, or wide."""
    found = read(render(Page("p", "", BANNER, (Section("s", "s", parts),)))).all("figure")
    names = (figure.attributes["class"].removeprefix("part drawn") for figure in found)
    return [name.strip() or "half" for name in names]


TEXT = Paragraph("text")
ALONE = "wide lone"


def test_two_halves_share_a_row_and_a_third_has_one_of_its_own() -> None:
    assert classes(half("a"), half("b")) == ["half", "half"]
    assert classes(half("a"), half("b"), half("c")) == ["half", "half", ALONE]
    assert classes(half("a"), half("b"), half("c"), half("d")) == ["half"] * 4


def test_a_half_beside_nothing_gets_the_row() -> None:
    assert classes(half("a")) == [ALONE]
    parts = (half("a"), TEXT, half("b"), half("c"), TEXT, half("d"))
    assert classes(*parts) == [ALONE, "half", "half", ALONE]


def test_a_drawing_made_for_half_a_page_is_not_blown_up() -> None:
    assert classes(half("a"), wide("b"), half("c")) == [ALONE, ALONE, ALONE]
    bath = figures.bath_curve([0.0, 1.0], [33.0, 33.0], 33.0, 0.1, [], [])
    assert classes(Figure(bath, "bath", "bath", wide=True)) == ["wide"]


@pytest.mark.parametrize(("value", "expected"), [("short", "entry"), ("x" * 61, "entry long")])
def test_a_long_value_has_a_line_of_its_own(value: str, expected: str) -> None:
    page = Page("p", "", BANNER, (Section("s", "s", (KeyValues("k", (("name", value),)),)),))
    assert expected in [div.attributes.get("class") for div in read(render(page)).all("div")]


def test_the_first_screen_leads_to_the_worst_three(tmp_path: Path) -> None:
    worst = ("trial-005", "trial-002", "trial-006", "trial-001")
    page = dataclasses.replace(sample_page(tmp_path), worst=worst)
    spans = read(render(page)).all("span")
    looks = [span.text for span in spans if span.attributes.get("class") == "looks"]
    assert looks == ["Look first at Trial 5, Trial 2, Trial 6."]
    assert '<a href="#trial-005">Trial 5</a>, <a href="#trial-002">' in render(page)
    aborted = dataclasses.replace(page, banner=dataclasses.replace(page.banner, verdict="aborted"))
    assert "Look first at" not in render(aborted)
    assert "Look first at" not in render(dataclasses.replace(page, worst=()))
