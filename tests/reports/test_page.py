"""What a page takes and what it refuses: hostile text in every field comes out as text; hostile
addresses and drawings, rows of the wrong length, ids twice, links to nowhere, a verdict on nothing
and a banner that boasts are refused.
"""

import dataclasses
import math
import re
from typing import Any
from unittest.mock import patch

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from markupsafe import escape

from reports import runs
from reports.figures.course import found_bars, latency_strip
from reports.figures.errors import error_histogram, error_scatter
from reports.frames import KNOWN_PLACES, Circle, ImageView, Label, Overlay, Polyline, layers
from reports.page import (
    Banner,
    Cell,
    Code,
    Column,
    Figure,
    KeyValues,
    Notes,
    Page,
    Paragraph,
    Requirement,
    Requirements,
    Result,
    Score,
    Scoreboard,
    Section,
    Table,
    TrialPart,
    Verdict,
)
from reports.render import environment, render
from reports.sanitize import page_text
from reports.trust import PageError
from tests.reports.markup import read

HOSTILE = (
    "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>&amp;{{ 7*7 }}{% raw"
    " %}]]>--></style></svg>\x00\u202e"
)
DRAWING = error_histogram([], 5.0)


def page_of(text: str) -> Page:
    """A page that has `text` in every field that takes a text."""
    cell = Cell(text, "bad", "#trial-001", mono=True)
    columns = (Column(text, "left", text, text), Column(text, "right", text, text))
    table = Table(text, columns, ((text, cell),), text, searchable=True)
    layers = (
        Overlay("truth", text, (Circle(1, 2, 3, text),)),
        Overlay("other", text, (Label(1, 2, text),)),
    )
    image = ImageView(text, "frames/a b#?%.png", 64, 48, text, layers, (1, 2, 30, 20))
    parts = (
        Requirements(text, (Requirement(text, text, 1, text, text, text, "met", text),), text),
        table,
        Figure(DRAWING, text, text),
        KeyValues(text, ((text, text), (text, cell))),
        Paragraph(text, "warn"),
        Notes(text, (text,)),
        Code(text, text),
    )
    shown = ((Result(text, "good"),), ((text, cell),), (image,), (table,), (text,))
    trial = TrialPart("trial-001", text, text, *shown)
    return Page(
        text,
        text,
        Banner("real", "met", text, text, text, text),
        (Section("one", text, parts, folded=True, about=text),),
        (trial,),
        text,
        text,
        detectors=(text, text),
        footer=(text,),
        alarm=text,
    )


def shape(html: str) -> list[tuple[str, tuple[str, ...]]]:
    return [(element.tag, tuple(element.attributes)) for element in read(html).elements]


def test_hostile_text_reaches_the_reader_without_what_would_steer_it() -> None:
    document = read(html := render(page_of(HOSTILE)))
    assert "\x00" not in html
    assert "49" not in document.by_id("one").text
    seen = HOSTILE.replace("\x00", "\ufffd").replace("\u202e", "\ufffd")
    assert document.all("h1")[0].text == seen
    assert document.all("img")[0].attributes["alt"] == seen
    assert [element.text for element in document.all("svg")[-1:]] == [seen + seen]


def test_every_text_field_was_tried() -> None:
    """Each str field of each dataclass of the page holds the marker, but ids and known words."""
    closed = {"id", "trials_in", "src", "href", "original", "tone"}
    closed |= {"verdict", "kind", "align", "svg", "shown_as", "camera"}
    missed: list[str] = []

    def walk(value: Any) -> None:
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            for item in dataclasses.fields(value):
                inner = getattr(value, item.name)
                if isinstance(inner, str) and item.name not in closed and inner != "MARK":
                    missed.append(f"{type(value).__name__}.{item.name}")
                walk(inner)
        elif isinstance(value, tuple):
            for inner in value:
                walk(inner)

    walk(page_of("MARK"))
    assert [name for name in missed if not name.startswith("SvgFacts")] == []


@pytest.mark.slow
@given(st.text(st.characters(exclude_categories=[]), max_size=40))
@example(HOSTILE)
def test_any_text_leaves_the_structure_alone(text: str) -> None:
    marks = patch.dict(KNOWN_PLACES, {text: 3, "calm": 3})  # a detector has its mark by its name
    with marks:
        html, calm = render(page_of(text)), render(page_of("calm"))
    html.encode("utf-8")
    assert read(html).misplaced == []
    assert not text.strip() or shape(html) == shape(calm)
    active = read(html).all("script", "style", "iframe", "object")
    assert [element.tag for element in active] == ["style", "script"]


def test_file_names_are_percent_encoded() -> None:
    assert read(render(page_of("x"))).all("img")[0].attributes["src"] == "frames/a%20b%23%3F%25.png"


SCRIPTS = ("javascript:alert(1)", "JaVaScRiPt:alert(1)", " javascript:alert(1)")
ADDRESSES = (
    *(*SCRIPTS, "java\nscript:alert(1)", "\x01javascript:alert(1)", "data:text/html,x"),
    *("http://example.com/", "//example.com/x", "/etc/passwd", "C:\\runs\\x.png"),
    *("\\\\server\\share", "#no spaces allowed", '#"onclick=', "a\tb"),
)


@pytest.mark.parametrize("address", ADDRESSES)
def test_addresses_that_leave_the_disk_are_refused(address: str) -> None:
    with pytest.raises(PageError, match="use "):
        Cell("x", href=address)
    with pytest.raises(PageError):
        ImageView("x", address, 4, 4, "x")
    with pytest.raises(PageError):
        ImageView("x", "a.png", 4, 4, "x", original=address)


DRAWINGS = (
    *("", "<p>no drawing</p>", "<svg><script>alert(1)</script></svg>", "<svg><g></svg>"),
    *("<svg onload='alert(1)'></svg>", "<svg><g onclick='alert(1)'/></svg>", "<svg><g>"),
    *("<svg><a href='javascript:alert(1)'><text>x</text></a></svg>", "<svg></svg><svg></svg>"),
    *("<svg><a href='http://example.com'></a></svg>", "<svg><use href='other.svg#x'/></svg>"),
    *("<svg><image href='http://example.com/x.png'/></svg>", "<svg></svg>text after"),
    *("<svg><foreignObject><p>x</p></foreignObject></svg>", "<svg>loose text</svg>"),
    *("<svg><style>*{display:none}</style></svg>", "<svg><g style='color:red'/></svg>"),
    *("<svg><rect fill='url(http://example.com/#x)'/></svg>", "<svg><!-- <script> --></svg>"),
    *("<svg><![CDATA[<script>]]></svg>", "<svg></svg><script>alert(1)</script>"),
    "<svg><?xml-stylesheet href='x'?></svg>",
)


@pytest.mark.parametrize("svg", DRAWINGS)
def test_drawings_with_more_than_a_plot_are_refused(svg: str) -> None:
    with pytest.raises(PageError, match=r"figure 'a plot': the drawing"):
        Figure(svg, "a plot", "words")


def test_hostile_names_in_a_plot_are_text() -> None:
    names = ["<script>x</script>", "$\\frac{1}$ & more", '"quoted" \x00\n牛🐄', "_hidden"]
    svg = found_bars(names, [1, 2, 3, 4], [4, 4, 4, 4], [None] * 4)
    banner, section = page_of("t").banner, Section("s", "s", (Figure(svg, "c", "a"),))
    document = read(render(Page("t", "", banner, (section,))))
    drawn = next(svg for svg in document.all("svg") if "plot" in svg.attributes["class"]).text
    seen = (*names[:2], '"quoted" \ufffd 牛🐄', names[3])
    assert [text for text in seen if text not in drawn] == []
    assert len(document.all("script")) == 1


BANNER = Banner("recorded", "met", "t", "s", "c", "n")


def row(verdict: str, n: int = 5) -> Requirement:
    return Requirement("speed", "rule", n, "1 s", "2 s", "1 s", verdict)  # type: ignore[arg-type]


def section(*parts: object, name: str = "one") -> Section:
    return Section(name, "One", parts)  # type: ignore[arg-type]


def test_a_row_has_a_cell_for_every_column() -> None:
    with pytest.raises(PageError, match="table 'Errors', row 2: 1 cells for 2 columns"):
        Table("Errors", (Column("a"), Column("b")), (("1", "2"), ("1",)))


@pytest.mark.parametrize("verdict", ["met", "not met"])
def test_a_verdict_on_nothing_is_refused(verdict: str) -> None:
    with pytest.raises(PageError, match="a verdict on nothing is 'not measured'"):
        row(verdict, n=0)
    assert row("not measured", n=0).n == 0


def test_unknown_words_are_refused_with_the_known_ones() -> None:
    said = r"verdict: 'passed' is none of 'met', 'not met', 'inconclusive'"
    with pytest.raises(PageError, match=said):
        row("passed")
    with pytest.raises(PageError, match="banner, kind"):
        dataclasses.replace(BANNER, kind="simulated")  # type: ignore[arg-type]


@pytest.mark.parametrize("verdict", ["not met", "aborted"])
def test_a_banner_claims_no_more_than_its_rows(verdict: str) -> None:
    part = Requirements("r", (row("met"), row(verdict)))
    with pytest.raises(PageError, match=r"the banner says 'met', but \['speed'\] is not"):
        Page("p", "", BANNER, (section(part),))
    honest = dataclasses.replace(BANNER, verdict="not met")
    assert Page("p", "", honest, (section(part),)).banner.verdict == "not met"
    board = Scoreboard("s", ("a", "b"), (("speed", "", (None, Score("not met", "9 s", ""))),))
    with pytest.raises(PageError, match=r"the banner says 'met', but \['speed'\] is not"):
        Page("p", "", BANNER, (section(board),))


@pytest.mark.slow
def test_ids_stand_for_one_thing() -> None:
    trial = TrialPart("trial-001", "Trial 1", "")
    with pytest.raises(PageError, match=r"'one'.*stand for two things"):
        Page("p", "", BANNER, (section(), section()))
    with pytest.raises(PageError, match=r"'trial-001'.*stand for two things"):
        Page("p", "", BANNER, (), (trial, trial))
    with pytest.raises(PageError, match="'trials'"):
        Page("p", "", BANNER, (section(name="trials"),))
    twice = Figure(latency_strip([0.5], [1.0]), "c", "a")
    with pytest.raises(PageError, match="latency-strip-"):
        Page("p", "", BANNER, (section(twice, twice),))
    other = Figure(latency_strip([0.5], [1.0], name="latency-again"), "c", "a")
    assert len(Page("p", "", BANNER, (section(twice, other),)).sections[0].parts) == 2


@pytest.mark.parametrize("name", ["", "Trial-1", "1-trial", "a b", 'a"', "ä", "a" * 81])
def test_ids_are_plain_words(name: str) -> None:
    with pytest.raises(PageError, match="can't be an id"):
        section(name=name)


def test_links_lead_somewhere() -> None:
    lost = Cell("x", href="#trial-009")
    figure = Figure(error_scatter([1], [1], 5, links=["#trial-009"]), "c", "a")
    for part in (Table("t", (Column("a"),), ((lost,),)), KeyValues("k", (("a", lost),)), figure):
        with pytest.raises(PageError, match="'#trial-009' leads nowhere"):
            Page("p", "", BANNER, (section(part),))
    with pytest.raises(PageError, match="'#trial-009' leads nowhere"):
        Page("p", "", BANNER, (), (TrialPart("trial-001", "h", "", summary=(("a", lost),)),))


@pytest.mark.parametrize("box", [(0, 0, 641, 10), (-1, 0, 10, 10), (0, 471, 10, 10), (0, 0, 0, 10)])
def test_a_view_stays_inside_its_image(box: tuple[int, int, int, int]) -> None:
    said = re.escape(f"view_box {box} leaves the image of 640 x 480 pixels")
    with pytest.raises(PageError, match=said):
        ImageView("left", "a.png", 640, 480, "alt", view_box=box)


def test_shapes_have_finite_coordinates_and_layers_one_name() -> None:
    with pytest.raises(PageError, match="not finite; leave the shape out"):
        Overlay("truth", "truth", (Circle(1, math.nan),))
    with pytest.raises(PageError, match="not finite"):
        Overlay("model", "edge", (Polyline(((0, 0), (math.inf, 1))),))
    views = tuple(
        ImageView("v", "a.png", 4, 4, "", (Overlay("truth", name, ()),))
        for name in ("truth", "touch")
    )
    said = "layer 'truth' is called 'touch' here and 'truth' elsewhere"
    with pytest.raises(PageError, match=said):
        layers(views)


@pytest.mark.parametrize(
    ("verdict", "visible", "step"),
    [("met", 8, "75 %"), ("tripped", 8, "tripped"), ("inconclusive", 0, "inconclusive")],
)
def test_a_row_of_runs_has_the_word_of_one_that_was_not_judged(
    verdict: Verdict, visible: int, step: str
) -> None:
    assert (
        runs.DetectorResult("a", "1", verdict, visible, 6 * bool(visible), 0, 0.5, 1.0).step == step
    )


def test_a_message_s_temperatures_are_written_as_a_page_does_and_a_file_s_own_are_not() -> None:
    said, file = "the bath is at 36.10 degC, above 36 degC", 'unit = "degC"  # 33 degC'
    assert page_text(said) == "the bath is at 36.10 °C, above 36 °C"
    made = environment().from_string("{{ said }} {{ file | verbatim }}")
    assert made.render(said=said, file=file) == f"{page_text(said)} {escape(file)}"
