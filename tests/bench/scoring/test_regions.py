"""Ellipsoids of errors, and the error map of the plane."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import scipy

from bench.scoring.errors import Floats
from bench.scoring.spread import (
    LEAST_POSES,
    Ellipsoid,
    bias_ellipsoid,
    bias_test,
    consistency,
    pose_means,
    prediction_ellipsoid,
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


def test_axes_are_those_of_the_spread_longest_first() -> None:
    region = prediction_ellipsoid(np.random.default_rng(3).normal(0, SPREAD, (4000, 3)))
    assert region is not None
    assert region.half_axes_mm == pytest.approx(
        np.array([2.0, 0.8, 0.4]) * np.sqrt(scipy.stats.chi2.ppf(0.95, 3)), rel=0.05
    )
    assert np.abs(region.directions) == pytest.approx(np.eye(3)[[1, 2, 0]], abs=0.05)


def test_the_outline_is_the_shadow() -> None:
    region = Ellipsoid(
        9, np.array([1.0, 2.0, 3.0]), np.array([3.0, 2.0, 1.0]), np.eye(3)[[1, 2, 0]]
    )
    shadow = region.outline_mm(0, 1) - [1.0, 2.0]
    assert np.square(shadow / [1.0, 3.0]).sum(axis=1) == pytest.approx(1.0)


@pytest.mark.slow
def test_hotelling_against_statsmodels() -> None:
    from statsmodels.stats.multivariate import test_mvmean as hotelling  # type: ignore[import-untyped]

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


def test_too_few_say_nothing() -> None:
    few = np.ones((LEAST_POSES - 1, 3))
    assert (
        prediction_ellipsoid(few),
        bias_ellipsoid(few),
        bias_test(few).p_value,
        consistency([], []).ratio,
    ) == (None, None, None, None)
    # flat: no volume to judge by
    assert (
        bias_test(np.column_stack([np.arange(9.0), np.arange(9.0), np.ones(9)])).t_squared is None
    )


def test_a_pose_counts_once() -> None:
    assert pose_means([[1, 0, 0], [3, 0, 0], [9, 0, 0]], ["a", "a", "b"]).tolist() == [
        [2, 0, 0],
        [9, 0, 0],
    ]
    assert pose_means([], []).shape == (0, 3)


def test_covariances_that_hold_have_a_ratio_of_one() -> None:
    rng = np.random.default_rng(5)
    claimed = np.broadcast_to(np.diag(SPREAD**2), (200, 3, 3))
    right = consistency(rng.normal(0, SPREAD, (200, 3)), claimed)
    assert right.low is not None
    assert right.high is not None
    assert right.ratio is not None
    assert right.low < right.ratio < right.high
    assert (right.low, right.high) == pytest.approx(
        (scipy.stats.chi2.ppf(0.025, 600) / 600, scipy.stats.chi2.ppf(0.975, 600) / 600)
    )
    boastful = consistency(rng.normal(0, 1.5 * SPREAD, (200, 3)), claimed)
    assert boastful.ratio is not None
    assert boastful.ratio > right.high
    with pytest.raises(ValueError, match="positive definite"):
        consistency([[0, 0, 0]], [np.zeros((3, 3))])
