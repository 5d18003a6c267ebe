"""The plots: no data, one point, many points, a hundred thousand; stable bytes; only colours that
the style sheet knows; numbers where they belong; what they refuse.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from reports.figures.course import Slope, bath_curve, found_bars, latency_strip, slope_intervals
from reports.figures.drawing import (
    COLOURS,
    MOST_POINTS,
    detector_look,
    envelope,
    legend,
    plain,
    subsample,
)
from reports.figures.errors import (
    change_scatter,
    error_drift,
    error_histogram,
    error_scatter,
    per_axis_errors,
    teat_boxes,
)
from reports.figures.plane import ErrorGroup, TeatPlaces, error_map, error_maps, error_regions
from reports.figures.situations import error_spreads, failure_map, rate_intervals
from reports.frames import MOST_DETECTORS, Cross, Polyline, Rect, answer_mark, places_of
from reports.trust import svg_facts
from tests.examples import few

Draw = Callable[[int], str]
SHEET = Path(__file__).resolve().parents[2] / "reports/templates/style.css"
VIEWS = [("x", "y"), ("x", "z")]


def _rng(n: int) -> np.random.Generator:
    return np.random.default_rng(n)


def texts_of(svg: str) -> list[str]:
    return re.findall(r"<text[^>]*>([^<]*)</text>", svg)


def _bath(n: int) -> str:
    times = np.linspace(0, 3600, n)
    spans = [(600.0, 1200.0)] if n else []
    temps = 33 - np.exp(-times / 300)
    return bath_curve(times, temps, 33.0, 0.1, times[: n // 2], spans)


def _scatter(n: int) -> str:
    across, along, links = _rng(n).normal(0, 2, n), _rng(n).normal(0, 3, n), ["#trial-001"] * n
    return error_scatter(across, along, 5.0, accept_mm=4.611, links=links)


def _places(teat: str, n: int) -> TeatPlaces:
    rng = _rng(n + len(teat))
    at, errors, missed = (rng.uniform(0, 300, (n, 3)), rng.uniform(0, 9, n), n // 2)
    links, gone = ("#trial-001",) * n, rng.uniform(0, 300, (missed, 3))
    return TeatPlaces(teat, at, errors, gone, links, links[:missed])


def _group(name: str, n: int, outlined: bool = True) -> ErrorGroup:
    turn = np.linspace(0, 2 * np.pi, 9)
    outline = 3.0 * np.column_stack([np.cos(turn), np.sin(turn)])
    points, outlines = _rng(n).normal(0, 2, (n, 2)), (outline, outline) if outlined and n else ()
    return ErrorGroup(name, (points, points), outlines, ("#trial-001",) * n)


def _slope(against: str, shown: bool) -> Slope:
    return Slope(against, "distance", 0.5, -0.5, 1.5, shown)


def _found(n: int) -> str:
    names, theirs = [f"situation {k}" for k in range(n)], [None if k % 2 else 3 for k in range(n)]
    return found_bars(names, [2] * n, [4] * n, theirs)


def _axes(n: int) -> str:
    """Of the first situation no error."""
    names = [f"s {k}" for k in range(min(n, 7))]
    errors = [_rng(k).normal(0, 1, (min(k, 2) * n, 3)) for k in range(len(names))]
    return per_axis_errors(names, errors, 5.0)


DRAWINGS: dict[str, Draw] = {
    "bath": _bath,
    "scatter": _scatter,
    "histogram": lambda n: error_histogram(_rng(n).uniform(0, 9, n), 5.0, accept_mm=4.611),
    "found": _found,
    "map": lambda n: error_map(_places("1", n), 5.0),
    "maps": lambda n: error_maps([_places(str(k), n) for k in range(1, 5)], 5.0),
    "regions": lambda n: error_regions([_group(f"teat {k}", n) for k in range(1, 5)], VIEWS, 5.0),
    "slopes": lambda n: slope_intervals([_slope(f"quantity {k}", k % 2 == 0) for k in range(n)]),
    "latency": lambda n: latency_strip(_rng(n).uniform(0, 1, n), [1.0, 2.0]),
    "change": lambda n: change_scatter(_rng(n).uniform(0, 9, n), _rng(n + 1).uniform(0, 9, n), 5.0),
    "drift": lambda n: error_drift(np.arange(n), _rng(n).uniform(0, 9, n), 5.0, links=["#trial-001"] * n),
    "teats": lambda n: teat_boxes([str(k) for k in range(min(n, 4))], [_rng(k).uniform(0, 9, n) for k in range(min(n, 4))], 5.0),
    "axes": _axes,
    "rates": lambda n: rate_intervals([f"family {k}" for k in range(n)], {"a": [(0.0, 0.0, 0.1)] * n, "b": [(0.5, 0.4, 0.6)] * n}),
    "spreads": lambda n: error_spreads([f"family {k}" for k in range(n)], {"a": [(0.1, 0.2, 0.3, 1.0, 9.0)] * n}, 5.0),
    "failures": lambda n: failure_map(("x (mm)", "y (mm)"), ((0.0, 5.0), (-1.0, 1.0)), [[n, n], [0, n]], [[n, 0], [0, n // 2]]),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("size", [0, *few([40, 1], 2)])
@pytest.mark.parametrize("draw", DRAWINGS.values(), ids=DRAWINGS)
def test_any_amount_of_data_makes_a_sound_drawing_that_turns_for_the_dark(
    draw: Draw, size: int
) -> None:
    svg, sheet = draw(size), SHEET.read_text(encoding="utf-8")
    assert svg_facts(svg, "drawing").ids == tuple(dict.fromkeys(svg_facts(svg, "drawing").ids))
    assert ("not measured" in svg) == (size == 0 or (draw is DRAWINGS["axes"]))
    assert "nan" not in svg.lower()
    assert "style=" not in svg
    assert set(re.findall(r'(?:fill|stroke)="([^"]*)"', svg)) <= {"none", *COLOURS.values()}
    used = " ".join(re.findall(r'class="((?:fill|stroke)-[^"]*)"', svg)).split()
    assert [name for name in sorted(set(used)) if f".{name}{{" not in sheet] == []
    for tag in re.findall(r"<(?:path|use|text|g)\b[^>]*>", svg):
        for key, colour in re.findall(r'\b(fill|stroke)="(#[^"]*)"', tag):
            role = next(role for role, known in COLOURS.items() if known == colour)
            assert f"{key}-{role}" in tag


@pytest.mark.slow
def test_a_user_s_matplotlib_settings_change_nothing_and_are_kept() -> None:
    before = DRAWINGS["latency"](9)
    with matplotlib.rc_context({"lines.linewidth": 9, "font.size": 30, "svg.fonttype": "path"}):
        assert DRAWINGS["latency"](9) == before
        assert matplotlib.rcParams["lines.linewidth"] == 9


def test_the_limit_circle_has_the_limit_s_size() -> None:
    """Two points at (0, 0) and (limit, 0) are as far apart as the circle's radius."""
    svg = error_scatter([0.0, 5.0], [0.0, 0.0], 5.0)
    points = [float(x) for x in re.findall(r'<use class="fill-ours[^>]* x="([\d.]+)"', svg)]
    paths = re.findall(r"<path [^>]*>", svg)
    circle = next(path for path in paths if "stroke-limit" in path and " C " in path)
    drawn = re.sub(r".* d=\"([^\"]*)\".*", r"\1", circle)
    xs = [float(x) for x in re.findall(r"[MLC ]([\d.]+) [\d.]+", drawn)]
    assert (max(xs) - min(xs)) / 2 == pytest.approx(points[1] - points[0], abs=0.05)


def test_points_link_to_their_trials_in_order() -> None:
    links = ["#trial-003", "#trial-001", "#trial-002"]
    svg = error_scatter([0.0, 1.0, 2.0], [0.0, 1.0, 2.0], 5.0, links=links)
    assert svg_facts(svg, "scatter").links == tuple(links)


def test_counts_are_written_beside_the_bars() -> None:
    svg = found_bars(["Overlapping", "Cooler bodies"], [9, 0], [12, 0], [3, None])
    texts = texts_of(svg)
    assert {"9 of 12", "3 of 4", "not measured", "Overlapping"} <= set(texts)
    assert sum(text.endswith(" of 4") for text in texts) == 1


def test_a_plane_has_no_view_from_the_front() -> None:
    at = np.column_stack([np.arange(9.0), np.arange(9.0), np.full(9, 136.0)])
    flat = TeatPlaces("1", at, np.ones(9))
    assert ">z (mm)<" not in error_maps([flat], 5.0)


@pytest.mark.slow
def test_panels_of_teats_far_apart_have_one_scale() -> None:
    """Two ends 20 mm apart are as far apart in either panel, wherever they lie."""
    teats = [
        TeatPlaces(str(k), [[100.0 * k, 0, 0], [100.0 * k + 20.0, 0, 0]], [9.0, 9.0])
        for k in (1, 2)
    ]
    svg = error_maps(teats, 5.0)
    xs = [float(x) for x in re.findall(r'<use class="fill-limit"[^>]* x="([\d.]+)"', svg)][:4]
    assert xs[1] - xs[0] == pytest.approx(xs[3] - xs[2], abs=0.05)
    assert xs[1] - xs[0] > 20


@pytest.mark.slow
def test_a_teat_has_a_colour_and_a_marker_and_says_on_how_many_poses_it_is() -> None:
    groups = [_group("teat 1", 9), _group("teat 2", 3, outlined=False)]
    svg = error_regions(groups, VIEWS, 5.0)
    note = [text for text in texts_of(svg) if text.startswith("teat")]
    assert note == ["teat 1, n = 9", "teat 2, n = 3 (too few)"]
    line = r'<path class="stroke-(ours|theirs)"[^>]* d="M [^"]*L [^"]*L [^"]*L [^"]*L'
    assert re.findall(line, svg) == ["ours", "ours"]  # one a view; none of the teat with too few
    first, second = (
        re.search(rf'class="fill-{role}".*?href="(#error-regions-\d+)"', svg)
        for role in ("ours", "theirs")
    )
    assert first is not None
    assert second is not None
    assert first.group(1) != second.group(1)  # markers differ, not only colours
    assert len(svg_facts(svg, "regions").links) == 2 * (9 + 3)


@pytest.mark.slow
def test_a_cloud_says_once_what_its_marks_share() -> None:
    few, many = (
        error_scatter(np.arange(n), np.zeros(n), 5.0, links=["#trial-001"] * n) for n in (3, 200)
    )
    assert few.count('<use class="fill-ours"') == 3 + 1  # and the legend's
    assert many.count('<use class="fill-ours"') == 1
    cloud = re.search(
        r'<g class="fill-ours" clip-path="url\(#error-scatter-\d+\)" fill="#1d5fa6"'
        r' fill-opacity="0.7">(.*?)</g>',
        many,
    )
    assert cloud is not None
    assert cloud.group(1).count("<a href=") == cloud.group(1).count("<use href=") == 200
    assert len(many) - len(few) < 200 * 131  # 130 a mark, and the list of what is drawn


def test_latency_percentiles_are_those_of_the_times() -> None:
    """Of 0.00, 0.01 ... 1.00 s, half are at most 0.5 and 95 in a hundred at most 0.95."""
    svg = latency_strip(np.arange(101) / 100, [2.0])
    assert "p50 0.5 s · p95 0.95 s · longest 1 s" in svg


NAN = np.nan
REFUSED: dict[str, Callable[[], str]] = {
    "error_histogram: errors_mm holds 1 of 2 values that are not finite": lambda: error_histogram(
        [1.0, NAN], 5.0
    ),
    "figure name: 'Two Words'": lambda: latency_strip([1.0], [1.0], name="Two Words"),
    "slope_intervals: tilt holds 1 of 3 values that are not finite": lambda: slope_intervals(
        [replace(_slope("tilt", False), value=NAN)]
    ),
}


@pytest.mark.parametrize(("said", "draw"), REFUSED.items())
def test_bad_arrays_are_explained(said: str, draw: Callable[[], str]) -> None:
    with pytest.raises(ValueError, match=said):
        draw()


def test_long_and_unprintable_labels_are_made_to_fit() -> None:
    assert plain("a" * 40) == "a" * 29 + "…"
    assert plain("one\ntwo\x00\x1b[31m") == "one two\ufffd\ufffd[31m"


@pytest.mark.parametrize("width_in", [3.6, 4.7, 9.4])
def test_a_legend_stays_within_its_drawing(width_in: float) -> None:
    figure = Figure(figsize=(width_in, 2.4), layout="constrained")
    line = "line: +0.12 mm over the run"
    legend(
        figure, [("one teat end", "ours", "o"), (line, "ink", "-"), ("limit 5 mm", "limit", "-")]
    )
    (drawn,) = figure.legends
    assert drawn.get_window_extent().width <= figure.bbox.width


@given(st.lists(st.floats(0, 100), max_size=300), st.integers(2, 50))
def test_the_heaviest_are_kept_and_no_more_than_asked(values: list[float], most: int) -> None:
    weight = np.array(values)
    kept = subsample(weight, most)
    assert len(kept) == len(set(kept.tolist())) == min(most, len(values))
    assert list(kept) == sorted(kept)
    if len(values):
        assert weight[kept].max() == weight.max()


@given(st.lists(st.floats(-50, 50), min_size=1, max_size=400), st.integers(2, 40))
def test_a_curve_keeps_its_ends_and_its_extremes(values: list[float], most: int) -> None:
    curve = np.array(values)
    kept = envelope(curve, most)
    assert len(kept) <= 2 * most + 2
    assert (kept[0], kept[-1]) == (0, len(values) - 1)
    assert curve[kept].max() == curve.max()
    assert curve[kept].min() == curve.min()


@pytest.mark.slow
@pytest.mark.parametrize(
    "which",
    few(["bath", "scatter", "histogram", "map", "regions", "latency", "drift", "teats", "axes"], 3),
)
def test_a_hundred_thousand_points_weigh_no_more_than_a_few(which: str) -> None:
    few, many = (DRAWINGS[which](n) for n in (MOST_POINTS, 100_000))
    assert len(many) < max(2.5 * len(few), 60_000)
    assert len(many) < 150_000


@pytest.mark.slow
def test_a_plot_says_that_it_doesn_t_draw_all() -> None:
    assert f"{MOST_POINTS} of 5000 drawn, the worst among them" in _scatter(5000)
    assert "drawn" not in _scatter(50)
    note = "120 of 20000 found ends drawn, the worst among them, and 120 of 10000 missed"
    assert note in DRAWINGS["maps"](5000)
    assert "120 of 20000 drawn, the worst among them" in DRAWINGS["regions"](5000)


def test_a_detector_has_one_mark_and_colour_by_its_name_in_figures_and_over_frames() -> None:
    alone = places_of(["mine"])["mine"]
    assert places_of(["thesis", "mine", "fused"]) == {"thesis": 2, "mine": alone, "fused": 1}
    shapes = {"X": Cross, "s": Rect, "^": Polyline, "D": Polyline}
    looks = [detector_look(who) for who in range(1, MOST_DETECTORS + 1)]
    for who, (_, form) in enumerate(looks, 1):
        assert isinstance(answer_mark(who, 0.0, 0.0, 1.0), shapes[str(form)])
    assert len({*looks}) == MOST_DETECTORS
