"""What a page refuses to be: rows of the wrong length, ids twice, links to nowhere, a verdict on
nothing, a banner that boasts.
"""

import dataclasses
import math
import re

import pytest

from reports.figures.course import latency_strip
from reports.figures.errors import error_scatter
from reports.frames import Circle, ImageView, Overlay, Polyline, layers
from reports.page import (
    Banner,
    Cell,
    Column,
    Figure,
    KeyValues,
    Page,
    Requirement,
    Requirements,
    Score,
    Scoreboard,
    Section,
    Table,
    TrialPart,
)
from reports.trust import PageError

BANNER = Banner("recorded", "met", "t", "s", "c", "n")


def row(verdict: str, n: int = 5) -> Requirement:
    return Requirement("speed", "rule", n, "1 s", "2 s", "1 s", verdict)  # type: ignore[arg-type]


def section(*parts: object, name: str = "one") -> Section:
    return Section(name, "One", parts)  # type: ignore[arg-type]


def test_values_are_frozen_and_slotted() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        BANNER.verdict = "not met"  # type: ignore[misc]
    assert not hasattr(BANNER, "__dict__")


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
