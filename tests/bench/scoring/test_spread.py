"""Ellipsoids of errors, the error map of the plane, and trends: by brute force, by simulation, and
against statsmodels.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import statsmodels.api as sm  # type: ignore[import-untyped]
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, t
from statsmodels.stats.multivariate import test_mvmean as hotelling  # type: ignore[import-untyped]

from bench.scoring.errors import Floats
from bench.scoring.spread import (
    LEAST_POSES,
    LEAST_TREND_POSES,
    Cell,
    Ellipsoid,
    Trend,
    bias_ellipsoid,
    bias_test,
    consistency,
    error_map,
    pose_means,
    prediction_ellipsoid,
    trend,
    trends,
)

SPREAD = np.array([0.4, 2.0, 0.8])


def holds(region: Ellipsoid, points: Floats) -> npt.NDArray[np.bool_]:
    inside: npt.NDArray[np.bool_] = (
        np.square((points - region.centre_mm) @ region.directions.T / region.half_axes_mm).sum(
            axis=-1
        )
        <= 1.0
    )
    return inside


def test_the_next_error_lies_within_as_often_as_said() -> None:
    rng = np.random.default_rng(1)
    held = []
    for _ in range(400):
        region = prediction_ellipsoid(rng.normal(0, SPREAD, (12, 3)), 0.9)
        assert region is not None
        held.append(holds(region, rng.normal(0, SPREAD, (20, 3))).mean())
    assert float(np.mean(held)) == pytest.approx(0.9, abs=0.01)


def test_the_bias_lies_within_as_often_as_said() -> None:
    rng = np.random.default_rng(2)
    held = []
    for _ in range(600):
        region = bias_ellipsoid(rng.normal([1.0, 0.0, 0.0], SPREAD, (12, 3)))
        assert region is not None
        held.append(bool(holds(region, np.array([1.0, 0.0, 0.0]))))
    assert float(np.mean(held)) == pytest.approx(0.95, abs=0.03)


def test_axes_are_those_of_the_spread_longest_first() -> None:
    region = prediction_ellipsoid(np.random.default_rng(3).normal(0, SPREAD, (4000, 3)))
    assert region is not None
    assert region.half_axes_mm == pytest.approx(
        np.array([2.0, 0.8, 0.4]) * np.sqrt(chi2.ppf(0.95, 3)), rel=0.05
    )
    assert np.abs(region.directions) == pytest.approx(np.eye(3)[[1, 2, 0]], abs=0.05)


def test_the_outline_is_the_shadow() -> None:
    centre = np.array([1.0, 2.0, 3.0])
    region = Ellipsoid(9, centre, np.array([3.0, 2.0, 1.0]), np.eye(3)[[1, 2, 0]])
    shadow = region.outline_mm(0, 1) - [1.0, 2.0]
    assert np.square(shadow / [1.0, 3.0]).sum(axis=1) == pytest.approx(1.0)


def test_hotelling_against_statsmodels() -> None:
    errors = np.random.default_rng(4).normal([0.3, 0.0, 0.1], SPREAD, (15, 3))
    mine, theirs = bias_test(errors), hotelling(errors, np.zeros(3))
    assert (mine.t_squared, mine.p_value) == pytest.approx((theirs.t2, theirs.pvalue))


def test_no_bias_is_shown_exactly_where_the_region_holds_zero() -> None:
    for seed in range(40):
        errors = np.random.default_rng(seed).normal([0.2, 0.5, 0.0], SPREAD, (10, 3))
        region, test = bias_ellipsoid(errors), bias_test(errors)
        assert region is not None
        assert test.p_value is not None
        assert bool(holds(region, np.zeros(3))) == (test.p_value >= 0.05)


def test_too_few_say_nothing_and_a_pose_counts_once() -> None:
    few = np.ones((LEAST_POSES - 1, 3))
    assert prediction_ellipsoid(few) is bias_ellipsoid(few) is None
    assert bias_test(few).p_value is consistency([], []).ratio is None
    flat = np.column_stack([np.arange(9.0), np.arange(9.0), np.ones(9)])
    assert bias_test(flat).t_squared is None  # no volume to judge by
    means = pose_means([[1, 0, 0], [3, 0, 0], [9, 0, 0]], ["a", "a", "b"])
    assert means.tolist() == [[2, 0, 0], [9, 0, 0]]
    assert pose_means([], []).shape == (0, 3)


def test_covariances_that_hold_have_a_ratio_of_one() -> None:
    rng = np.random.default_rng(5)
    claimed = np.broadcast_to(np.diag(SPREAD**2), (200, 3, 3))
    right = consistency(rng.normal(0, SPREAD, (200, 3)), claimed)
    low, high = chi2.ppf([0.025, 0.975], 600) / 600
    assert (right.low, right.high) == pytest.approx((low, high))
    assert low < (right.ratio or 0.0) < high
    boastful = consistency(rng.normal(0, 1.5 * SPREAD, (200, 3)), claimed)
    assert (boastful.ratio or 0.0) > high
    with pytest.raises(ValueError, match="positive definite"):
        consistency([[0, 0, 0]], [np.zeros((3, 3))])


def test_a_map_counts_what_was_missed() -> None:
    cells = error_map([[25, 0], [0, 0], [0, 0]], [[1, 0, 0], [0, 3, 4]], [False, True, True])
    assert cells == (
        Cell(0.0, 0.0, 2, 2, (0.5, 1.5, 2.0), 3.0, float(np.sqrt(13.0)), 5.0),
        Cell(25.0, 0.0, 1, 0),
    )


@given(st.integers(0, 60), st.integers(0, 2**32 - 1), st.floats(1, 200))
def test_cells_hold_all_rows_once(n: int, seed: int, step: float) -> None:
    rng = np.random.default_rng(seed)
    places, found = rng.uniform(-100, 100, (n, 2)), rng.random(n) < 0.7
    errors = rng.normal(0, 2, (int(found.sum()), 3))
    cells = error_map(places, errors, found, step_mm=step)
    assert sum(cell.teats for cell in cells) == n
    assert sum(cell.found for cell in cells) == len(errors)
    biases = np.array(
        [np.array(cell.bias_mm) * cell.found for cell in cells if cell.bias_mm is not None]
    ).reshape(-1, 3)
    assert biases.sum(axis=0) == pytest.approx(errors.sum(axis=0), abs=1e-6)
    squares = sum(cell.rms_mm**2 * cell.found for cell in cells if cell.rms_mm is not None)
    assert squares == pytest.approx(float(np.square(errors).sum()), abs=1e-6)
    if len(errors):
        assert max(cell.max_mm or 0.0 for cell in cells) == pytest.approx(
            float(np.linalg.norm(errors, axis=1).max())
        )


def test_a_map_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="1 places, 1 of them found, but 2 errors"):
        error_map([[0, 0]], [[0, 0, 0], [0, 0, 0]])
    with pytest.raises(ValueError, match="not above 0"):
        error_map([[0, 0]], [[0, 0, 0]], step_mm=0.0)


def line(x: Floats, y: Floats, strata: npt.NDArray[np.int64]) -> float:
    """The least-squares slope with a level for each stratum, by dummy variables."""
    levels = (strata[:, None] == np.unique(strata)[None, :]).astype(float)
    return float(sm.OLS(y, np.column_stack([x, levels])).fit().params[0])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(LEAST_TREND_POSES, 9), st.integers(1, 3))
def test_the_slope_and_its_jackknife_by_leaving_out_each_group(
    seed: int, groups: int, strata: int
) -> None:
    rng = np.random.default_rng(seed)
    group = np.repeat(np.arange(groups), 3 * strata)
    stratum = np.tile(np.arange(strata), 3 * groups)
    x, y = rng.normal(0, 10, len(group)), rng.normal(0, 1, len(group))
    found = trend(x, y, group.tolist(), within=stratum.tolist())
    without = np.array(
        [line(x[group != g], y[group != g], stratum[group != g]) for g in range(groups)]
    )
    error = np.sqrt((groups - 1) / groups * np.square(without - without.mean()).sum())
    assert found.slope == pytest.approx(line(x, y, stratum), abs=1e-9)
    assert found.low is not None
    assert found.high is not None
    assert (found.high - found.low) / 2 == pytest.approx(
        float(t.ppf(0.975, groups - 1)) * error, rel=1e-6
    )


@pytest.mark.parametrize("same_place", [True, False])
def test_chance_is_taken_for_a_trend_in_no_more_than_5_percent(same_place: bool) -> None:
    rng = np.random.default_rng(2)
    group = np.repeat(np.arange(12), 4)
    hits = 0
    for _ in range(800):
        x = np.repeat(rng.normal(0, 50, 12), 4) if same_place else rng.normal(0, 50, 48)
        found = trend(
            x, np.repeat(rng.normal(0, 1, 12), 4) + rng.normal(0, 0.3, 48), group.tolist()
        )
        hits += found.p_value is not None and found.p_value < 0.05
    assert hits / 800 < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 800)


def test_a_drift_within_poses_shows_though_the_poses_differ_by_more() -> None:
    rng = np.random.default_rng(3)
    pose, trial = np.tile(np.arange(3), 20), np.arange(60)
    y = np.array([-8.0, 0.0, 9.0])[pose] + 0.02 * trial + rng.normal(0, 0.3, 60)
    over = trend(trial, y, pose.tolist())
    within = trend(trial, y, trial.tolist(), within=pose.tolist())
    assert over.slope is None  # three poses tell nothing
    assert within.slope == pytest.approx(0.02, abs=0.006)
    assert within.p_value is not None
    assert within.p_value < 0.001


def test_what_was_put_in_comes_out_and_is_adjusted_for_all_questions() -> None:
    rng = np.random.default_rng(4)
    n = 100
    x, z, bath = rng.uniform(-50, 50, n), rng.uniform(-20, 20, n), np.full(n, 33.0)
    tilt = np.where(np.arange(n) < 50, rng.uniform(0, 20, n), np.nan)
    errors = np.column_stack(
        [rng.normal(0, 0.2, n), 0.02 * x + rng.normal(0, 0.2, n), rng.normal(1.0, 0.2, n)]
    )
    found = trends({"x_mm": x, "z_mm": z, "bath_c": bath, "tilt_deg": tilt}, errors, list(range(n)))
    assert len(found) == 16
    by = {(one.quantity, one.response): one for one in found}
    assert by["x_mm", "y"].slope == pytest.approx(0.02, abs=0.002)
    assert [key for key, one in by.items() if one.significant] in (
        [("x_mm", "y")],
        [("x_mm", "y"), ("x_mm", "distance")],
    )
    assert by["bath_c", "x"].slope is None
    assert (by["tilt_deg", "x"].n, by["x_mm", "x"].n) == (50, 100)
    for one in found:
        if one.p_value is not None:
            assert one.p_holm is not None
            assert one.p_value <= one.p_holm


def test_nothing_and_too_little_is_not_measured() -> None:
    assert trend([], [], []) == Trend("", "", 0, 0, 0.0)
    assert trend([1.0, 2.0, 3.0], [1.0, 2.0, 3.0], ["a", "b", "c"]).slope is None
    only_one_moves = trend([0.0] * 5 + [1.0], [0.0] * 5 + [1.0], list("abcdef"))
    assert only_one_moves.slope is None
    assert trends({"x": []}, [], []) == tuple(
        Trend("x", r, 0, 0, 0.0) for r in ("x", "y", "z", "distance")
    )
    with pytest.raises(ValueError, match="2 values, 2 responses, 1 groups"):
        trend([1.0, 2.0], [1.0, 2.0], ["a"])
