"""Trends: the jackknife by brute force, slopes against statsmodels, and how often chance is taken
for a trend.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.scoring.errors import Floats
from bench.scoring.spread import LEAST_TREND_POSES, Trend, trend, trends
from tests.examples import examples, few


def line(x: Floats, y: Floats, strata: npt.NDArray[np.int64]) -> float:
    """The least-squares slope with a level for each stratum, by dummy variables."""
    import statsmodels.api as sm  # type: ignore[import-untyped]

    levels = (strata[:, None] == np.unique(strata)[None, :]).astype(float)
    return float(sm.OLS(y, np.column_stack([x, levels])).fit().params[0])


def weighs(x: Floats, kept: npt.NDArray[np.bool_], strata: npt.NDArray[np.int64]) -> Floats:
    """What each response weighs (n,) in the slope of the kept rows: the slope is linear in them."""
    levels = (strata[kept, None] == np.unique(strata)[None, :]).astype(float)
    whole = np.zeros(len(x))
    whole[kept] = np.linalg.pinv(np.column_stack([x[kept], levels]))[0]
    return whole


@pytest.mark.slow
@settings(max_examples=examples(10), deadline=None)
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
    each = np.array([weighs(x, group != g, stratum) for g in range(groups)])
    each -= each.mean(axis=0)
    A = each @ each.T
    freedom = np.trace(A) ** 2 / np.trace(A @ A)
    assert found.slope == pytest.approx(line(x, y, stratum), abs=1e-9)
    assert found.low is not None
    assert found.high is not None
    assert (found.high - found.low) / 2 == pytest.approx(
        float(scipy.stats.t.ppf(0.975, freedom)) * error, rel=1e-6
    )


@pytest.mark.slow
def test_the_error_is_near_statsmodels_cluster_robust_one() -> None:
    import statsmodels.api as sm

    rng = np.random.default_rng(1)
    group = np.repeat(np.arange(60), 4)
    x = rng.normal(0, 50, 240)
    y = 0.01 * x + np.repeat(rng.normal(0, 1, 60), 4) + rng.normal(0, 0.3, 240)
    fit = sm.OLS(y, sm.add_constant(x)).fit(
        cov_type="cluster", cov_kwds={"groups": group}, use_t=True
    )
    found = trend(x, y, group.tolist())
    assert found.slope == pytest.approx(fit.params[1])
    low, high = fit.conf_int()[1]
    assert (found.low, found.high) == pytest.approx((low, high), abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("same_place", few([True, False], 2))
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


@pytest.mark.weekly
def test_the_chance_of_many_questions_is_that_of_one() -> None:
    """Adjusted together, each is judged far out, where groups - 1 degrees of freedom are too many:
    of these 20 questions of 16 poses one was then shown in 13 % of runs.
    """
    rng, shown, runs = np.random.default_rng(9), 0, examples(120)
    for _ in range(runs):
        asked = {str(k): rng.normal(0.0, 50.0, 16) for k in range(5)}
        found = trends(asked, rng.normal(0.0, 1.0, (16, 3)), range(16))
        shown += any(one.significant for one in found)
    assert shown / runs < 0.05 + 3 * np.sqrt(0.05 * 0.95 / runs)


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
