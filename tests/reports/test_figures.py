"""The plots: no data, one point, many points; stable bytes; only colours that the style sheet
knows; numbers where they belong.
"""

import re
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from reports import figures
from reports.figures.drawing import COLOURS, legend, plain
from reports.trust import svg_facts

Draw = Callable[[int], str]


def _rng(n: int) -> np.random.Generator:
    return np.random.default_rng(n)


def _bath(n: int) -> str:
    times = np.linspace(0, 3600, n)
    spans = [(600.0, 1200.0)] if n else []
    return figures.bath_curve(
        times, 33 - np.exp(-times / 300), 33.0, 0.1, times[: n // 2], spans, np.zeros((n, 2))
    )


def _scatter(n: int) -> str:
    return figures.error_scatter(
        _rng(n).normal(0, 2, n),
        _rng(n).normal(0, 3, n),
        5.0,
        accept_mm=4.611,
        links=["#trial-001"] * n,
    )


def _places(teat: str, n: int) -> figures.TeatPlaces:
    rng = _rng(n + len(teat))
    links = ("#trial-001",) * n
    return figures.TeatPlaces(
        teat,
        rng.uniform(0, 300, (n, 3)),
        rng.uniform(0, 9, n),
        rng.uniform(0, 300, (n // 2, 3)),
        links,
        links[: n // 2],
    )


def _group(name: str, n: int, outlined: bool = True) -> figures.ErrorGroup:
    turn = np.linspace(0, 2 * np.pi, 9)
    outline = 3.0 * np.column_stack([np.cos(turn), np.sin(turn)])
    points = _rng(n).normal(0, 2, (n, 2))
    return figures.ErrorGroup(
        name, (points, points), (outline, outline) if outlined and n else (), ("#trial-001",) * n
    )


def _slope(against: str, shown: bool) -> figures.Slope:
    return figures.Slope(against, "distance", 0.5, -0.5, 1.5, shown)


DRAWINGS: dict[str, Draw] = {
    "bath": _bath,
    "scatter": _scatter,
    "histogram": lambda n: figures.error_histogram(_rng(n).uniform(0, 9, n), 5.0, accept_mm=4.611),
    "found": lambda n: figures.found_bars(
        [f"situation {k}" for k in range(n)],
        [2] * n,
        [4] * n,
        [None if k % 2 else 3 for k in range(n)],
    ),
    "map": lambda n: figures.error_map(_places("1", n), 5.0),
    "maps": lambda n: figures.error_maps([_places(str(k), n) for k in range(1, 5)], 5.0),
    "regions": lambda n: figures.error_regions(
        [_group(f"teat {k}", n) for k in range(1, 5)], [("x", "y"), ("x", "z")], 5.0
    ),
    "slopes": lambda n: figures.slope_intervals(
        [_slope(f"quantity {k}", k % 2 == 0) for k in range(n)]
    ),
    "latency": lambda n: figures.latency_strip(_rng(n).uniform(0, 1, n), [1.0, 2.0]),
    "change": lambda n: figures.change_scatter(
        _rng(n).uniform(0, 9, n), _rng(n + 1).uniform(0, 9, n), 5.0
    ),
    "drift": lambda n: figures.error_drift(
        np.arange(n), _rng(n).uniform(0, 9, n), 5.0, links=["#trial-001"] * n
    ),
    "teats": lambda n: figures.teat_boxes(
        [str(k) for k in range(min(n, 4))],
        [_rng(k).uniform(0, 9, n) for k in range(min(n, 4))],
        5.0,
    ),
    "axes": lambda n: figures.per_axis_errors(
        [f"s {k}" for k in range(n)], [_rng(k).normal(0, 1, (k, 3)) for k in range(n)], 5.0
    ),
}


@pytest.mark.parametrize("size", [0, 1, 2, 40])
@pytest.mark.parametrize("draw", DRAWINGS.values(), ids=DRAWINGS)
def test_any_amount_of_data_makes_a_sound_and_stable_drawing(draw: Draw, size: int) -> None:
    svg = draw(size)
    assert svg == draw(size)
    assert svg_facts(svg, "drawing").ids == tuple(dict.fromkeys(svg_facts(svg, "drawing").ids))
    assert ("not measured" in svg) == (size == 0 or (draw is DRAWINGS["axes"]))
    assert "nan" not in svg.lower()
    assert "style=" not in svg


@pytest.mark.parametrize("draw", DRAWINGS.values(), ids=DRAWINGS)
def test_every_colour_is_one_that_the_style_sheet_turns_for_the_dark(draw: Draw) -> None:
    svg = draw(7)
    assert set(re.findall(r'(?:fill|stroke)="([^"]*)"', svg)) <= {"none", *COLOURS.values()}
    sheet = (Path(__file__).resolve().parents[2] / "reports/templates/style.css").read_text(
        encoding="utf-8"
    )
    used = {
        name
        for names in re.findall(r'class="((?:fill|stroke)-[^"]*)"', svg)
        for name in names.split()
    }
    assert [name for name in sorted(used) if f".{name}{{" not in sheet] == []
    for tag in re.findall(r"<(?:path|use|text|g)\b[^>]*>", svg):
        for key, colour in re.findall(r'\b(fill|stroke)="(#[^"]*)"', tag):
            role = next(role for role, known in COLOURS.items() if known == colour)
            assert f"{key}-{role}" in tag


def test_two_drawings_share_no_id() -> None:
    first = svg_facts(figures.error_histogram([1.0, 2.0], 5.0), "first").ids
    second = svg_facts(figures.error_histogram([1.0, 2.0], 5.0, name="second"), "second").ids
    assert first
    assert len(first) == len(second)
    assert set(first).isdisjoint(second)


def test_a_user_s_matplotlib_settings_change_nothing_and_are_kept() -> None:
    before = DRAWINGS["latency"](9)
    with matplotlib.rc_context(
        {"lines.linewidth": 9, "font.size": 30, "svg.fonttype": "path", "text.usetex": False}
    ):
        assert DRAWINGS["latency"](9) == before
        assert matplotlib.rcParams["lines.linewidth"] == 9


def test_the_limit_circle_has_the_limit_s_size() -> None:
    """Two points at (0, 0) and (limit, 0) are as far apart as the circle's radius."""
    svg = figures.error_scatter([0.0, 5.0], [0.0, 0.0], 5.0)
    points = [float(x) for x in re.findall(r'<use class="fill-ours[^>]* x="([\d.]+)"', svg)]
    circle = next(
        path
        for path in re.findall(r"<path [^>]*>", svg)
        if "stroke-limit" in path and " C " in path
    )
    xs = [
        float(x)
        for x in re.findall(r"[MLC ]([\d.]+) [\d.]+", re.sub(r".* d=\"([^\"]*)\".*", r"\1", circle))
    ]
    assert (max(xs) - min(xs)) / 2 == pytest.approx(points[1] - points[0], abs=0.05)


def test_points_link_to_their_trials_in_order() -> None:
    svg = figures.error_scatter(
        [0.0, 1.0, 2.0], [0.0, 1.0, 2.0], 5.0, links=["#trial-003", "#trial-001", "#trial-002"]
    )
    assert svg_facts(svg, "scatter").links == ("#trial-003", "#trial-001", "#trial-002")


def test_counts_are_written_beside_the_bars() -> None:
    svg = figures.found_bars(["Overlapping", "Cooler bodies"], [9, 0], [12, 0], [3, None])
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", svg)
    assert [
        text for text in ("9 of 12", "3 of 4", "not measured", "Overlapping") if text not in texts
    ] == []
    assert sum(text.endswith(" of 4") for text in texts) == 1


def test_each_teat_has_a_panel_with_its_own_counts() -> None:
    svg = figures.error_maps(
        [_places("1", 12), figures.TeatPlaces("2", np.zeros((0, 3)), [], [[1.0, 2.0, 3.0]])], 5.0
    )
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", svg)
    told = [text for text in texts if text.startswith("teat") or text.endswith("missed")]
    assert told == ["teat 1", "12 found, 6 missed", "teat 2", "0 found, 1 missed"]
    assert {"x (mm)", "y (mm)", "z (mm)"} <= set(texts)


def test_a_plane_has_no_view_from_the_front() -> None:
    flat = figures.TeatPlaces(
        "1", np.column_stack([np.arange(9.0), np.arange(9.0), np.full(9, 136.0)]), np.ones(9)
    )
    assert ">z (mm)<" not in figures.error_maps([flat], 5.0)


def test_panels_of_teats_far_apart_have_one_scale() -> None:
    """Two ends 20 mm apart are as far apart in either panel, wherever they lie."""
    teats = [
        figures.TeatPlaces(str(k), [[100.0 * k, 0, 0], [100.0 * k + 20.0, 0, 0]], [9.0, 9.0])
        for k in (1, 2)
    ]
    xs = [
        float(x)
        for x in re.findall(
            r'<use class="fill-limit"[^>]* x="([\d.]+)"', figures.error_maps(teats, 5.0)
        )
    ][:4]
    assert xs[1] - xs[0] == pytest.approx(xs[3] - xs[2], abs=0.05)
    assert xs[1] - xs[0] > 20


def test_a_teat_has_a_colour_and_a_marker_and_says_on_how_many_poses_it_is() -> None:
    svg = figures.error_regions(
        [_group("teat 1", 9), _group("teat 2", 3, outlined=False)], [("x", "y"), ("x", "z")], 5.0
    )
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", svg)
    assert [text for text in texts if text.startswith("teat")] == [
        "teat 1, n = 9",
        "teat 2, n = 3 (too few)",
    ]
    outlines = re.findall(
        r'<path class="stroke-(ours|theirs)"[^>]* d="M [^"]*L [^"]*L [^"]*L [^"]*L', svg
    )
    assert outlines == ["ours", "ours"]  # one a view; none of the teat with too few
    first, second = (
        re.search(rf'class="fill-{role}".*?href="(#error-regions-\d+)"', svg)
        for role in ("ours", "theirs")
    )
    assert first is not None
    assert second is not None
    assert first.group(1) != second.group(1)  # markers differ, not only colours
    assert len(svg_facts(svg, "regions").links) == 2 * (9 + 3)


def test_more_teats_than_can_be_told_apart_are_refused() -> None:
    with pytest.raises(ValueError, match=r"7 groups; at most 6 can be told apart"):
        figures.error_regions([_group(str(k), 1) for k in range(7)], [("x", "y"), ("x", "z")], 5.0)
    with pytest.raises(ValueError, match=r"teat 1: 2 clouds and 2 outlines for 1 views"):
        figures.error_regions([_group("teat 1", 5)], [("x", "y")], 5.0)
    with pytest.raises(ValueError, match=r"teat 1: lengths differ: places_mm 1, error_mm 2$"):
        figures.error_maps([figures.TeatPlaces("1", [[0, 0, 0]], [1.0, 2.0])], 5.0)
    with pytest.raises(ValueError, match=r"slope_intervals: tilt is not finite"):
        figures.slope_intervals([figures.Slope("tilt", "distance", np.nan, 0.0, 1.0, False)])


def test_a_cloud_says_once_what_its_marks_share() -> None:
    few, many = (
        figures.error_scatter(np.arange(n), np.zeros(n), 5.0, links=["#trial-001"] * n)
        for n in (3, 300)
    )
    assert few.count('<use class="fill-ours"') == 3
    assert '<use class="fill-ours"' not in many
    cloud = re.search(
        r'<g class="fill-ours" clip-path="url\(#error-scatter-\d+\)" fill="#1d5fa6"'
        r' fill-opacity="0.7">(.*?)</g>',
        many,
    )
    assert cloud is not None
    assert cloud.group(1).count("<a href=") == cloud.group(1).count("<use href=") == 300
    assert len(many) - len(few) < 300 * 130


def test_latency_percentiles_are_those_of_the_times() -> None:
    """Of 0.00, 0.01 ... 1.00 s, half are at most 0.5 and 95 in a hundred at most 0.95."""
    assert "p50 0.5 s · p95 0.95 s · longest 1 s" in figures.latency_strip(
        np.arange(101) / 100, [2.0]
    )


def test_bad_arrays_are_explained() -> None:
    with pytest.raises(
        ValueError, match=r"error_histogram: errors_mm holds 1 of 2 values that are not finite"
    ):
        figures.error_histogram([1.0, np.nan], 5.0)
    with pytest.raises(
        ValueError, match=r"error_scatter: lengths differ: lateral_mm 2, depth_mm 1"
    ):
        figures.error_scatter([1.0, 2.0], [1.0], 5.0)
    with pytest.raises(ValueError, match=r"error_scatter: 1 links for 2 points"):
        figures.error_scatter([1.0, 2.0], [1.0, 2.0], 5.0, links=["#a"])
    with pytest.raises(ValueError, match=r"found_bars: 1 situations, 2 found"):
        figures.found_bars(["a"], [1, 2], [4], [3])
    with pytest.raises(ValueError, match=r"per_axis_errors: 1 situations for 0 arrays"):
        figures.per_axis_errors(["a"], [], 5.0)
    with pytest.raises(ValueError, match=r"bath_curve: teat_temps_c has 1 rows for 2 times"):
        figures.bath_curve([0, 1], [20, 21], 33, 0.1, [], teat_temps_c=[20])
    with pytest.raises(ValueError, match="figure name: 'Two Words'"):
        figures.latency_strip([1.0], [1.0], name="Two Words")


def test_long_and_unprintable_labels_are_made_to_fit() -> None:
    assert plain("a" * 40) == "a" * 29 + "…"
    assert plain("one\ntwo\x00\x1b[31m") == "one two\ufffd\ufffd[31m"


@pytest.mark.parametrize("width_in", [3.6, 4.7, 9.4])
def test_a_legend_stays_within_its_drawing(width_in: float) -> None:
    figure = Figure(figsize=(width_in, 2.4), layout="constrained")
    legend(
        figure,
        [
            ("one teat end", "ours", "o"),
            ("line: +0.12 mm over the run", "ink", "-"),
            ("limit 5 mm", "limit", "-"),
        ],
    )
    (drawn,) = figure.legends
    assert drawn.get_window_extent().width <= figure.bbox.width
