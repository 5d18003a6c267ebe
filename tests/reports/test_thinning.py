"""Plots of many points stay light and keep the worst; a curve keeps its peaks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reports import figures
from reports.figures.drawing import MOST_POINTS, Floats, envelope, telling


@given(st.lists(st.floats(0, 100), max_size=300), st.integers(2, 50))
def test_the_heaviest_are_kept_and_no_more_than_asked(values: list[float], most: int) -> None:
    weight = np.array(values)
    kept = telling(weight, most)
    assert len(kept) == len(set(kept.tolist())) <= max(most, 0)
    assert len(kept) == min(most, len(values))
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


def places(e: Floats, t: Floats) -> figures.TeatPlaces:
    links = ("#trial-001",) * e.size
    at = np.column_stack([e, t, 20.0 * e])
    return figures.TeatPlaces("1", at, np.abs(e), at, links, links)


@pytest.mark.parametrize(
    "draw",
    [
        lambda e, t: figures.error_scatter(e, t, 5.0, links=["#trial-001"] * e.size),
        lambda e, t: figures.per_axis_errors(["a", "b"], [np.column_stack([e, t, e])] * 2, 5.0),
        lambda e, t: figures.error_histogram(np.abs(e), 5.0),
        lambda e, t: figures.latency_strip(np.abs(e), [1.0]),
        lambda e, t: figures.error_map(places(e, t), 5.0),
        lambda e, t: figures.error_maps([places(e, t)] * 4, 5.0),
        lambda e, t: figures.error_regions(
            [figures.ErrorGroup("1", [np.column_stack([e, t])] * 3)] * 4, [("x", "y")] * 3, 5.0
        ),
        lambda e, t: figures.error_drift(t, np.abs(e), 5.0, links=["#trial-001"] * e.size),
        lambda e, t: figures.change_scatter(np.abs(e), np.abs(t), 5.0),
        lambda e, t: figures.teat_boxes(["1", "2"], [np.abs(e), np.abs(t)], 5.0),
        lambda e, t: figures.bath_curve(np.arange(e.size), e, 33.0, 0.1, np.arange(e.size)),
    ],
)
def test_a_hundred_thousand_points_weigh_no_more_than_a_few(draw: object) -> None:
    rng = np.random.default_rng(1)
    few, many = (draw(*rng.normal(0, 1, (2, n))) for n in (MOST_POINTS, 100_000))  # type: ignore[operator]
    assert len(many) < max(2.5 * len(few), 60_000)
    assert len(many) < 150_000


def test_a_plot_says_that_it_doesn_t_draw_all() -> None:
    errors = np.abs(np.random.default_rng(1).normal(0, 2, 5000))
    assert "400 of 5000 drawn, the worst among them" in figures.error_scatter(errors, errors, 5.0)
    assert "drawn" not in figures.error_scatter(errors[:50], errors[:50], 5.0)
    told = "120 of 20000 found ends drawn, the worst among them, and 120 of 20000 missed"
    assert told in figures.error_maps([places(errors, errors)] * 4, 5.0)
    assert "80 of 20000 drawn, the worst among them" in figures.error_regions(
        [figures.ErrorGroup(str(k), [np.column_stack([errors, errors])] * 3) for k in range(4)],
        [("x", "y")] * 3,
        5.0,
    )
