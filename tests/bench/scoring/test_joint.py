"""The truth's joint covariance against draws of it: moments of squares, the mean's covariance, the
radial figure. That tests which take it keep their level is the null world's.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.scoring.errors import Floats
from bench.scoring.joint import JointCovariance, mean_square, radial_95_mm
from bench.scoring.spread import (
    Regressor,
    _generalised,
    bias_ellipsoid,
    bias_test,
    consistency,
    prediction_ellipsoid,
    trend,
    trends,
)
from tests.examples import examples

U = 0.23
N = 30
RUNS = 300


def drawn(truth: JointCovariance, rng: np.random.Generator) -> Floats:
    """Errors (n, 3) of it; nothing of `JointCovariance` is used but its arrays."""
    n, _, k = truth.common.shape
    roots = np.linalg.cholesky(truth.fresh + 1e-18 * np.eye(3))
    return np.asarray(
        truth.common @ rng.normal(size=k) + np.einsum("nab,nb->na", roots, rng.normal(size=(n, 3)))
    )


def turned(places: Floats, *, shift_mm: float = U, turn: float = 1e-3) -> JointCovariance:
    """A shift and a turn that all share, and touches of 0.12 mm."""
    n = len(places)
    turns = np.stack([np.cross(axis, places) for axis in np.eye(3)], axis=-1) * turn
    common = np.concatenate([np.tile(shift_mm * np.eye(3), (n, 1, 1)), turns], axis=2)
    fresh = np.tile(0.12**2 * np.eye(3), (n, 1, 1))
    return JointCovariance(common, fresh, ("arm",) * 3 + ("table frame",) * 3)


def places(rng: np.random.Generator) -> Floats:
    return rng.uniform(-100.0, 100.0, (N, 3))


@pytest.mark.slow
def test_squares_have_the_mean_and_the_variance_of_their_draws() -> None:
    rng = np.random.default_rng(1)
    truth = turned(places(rng))
    forms = rng.normal(size=(N, 3, 3))
    forms = forms @ forms.transpose(0, 2, 1)
    seen = [
        float(np.einsum("na,nab,nb->", t, forms, t))
        for t in (drawn(truth, rng) for _ in range(6000))
    ]
    mean, variance = truth.squares(forms)
    assert mean == pytest.approx(np.mean(seen), rel=0.03)
    assert variance == pytest.approx(np.var(seen), rel=0.1)


@pytest.mark.slow
def test_a_mean_has_the_covariance_of_its_draws() -> None:
    rng = np.random.default_rng(2)
    truth, weights = turned(places(rng)), rng.uniform(0.0, 2.0 / N, N)
    seen = np.array([weights @ drawn(truth, rng) for _ in range(6000)])
    np.testing.assert_allclose(
        truth.of_mean(weights, fresh=True), np.cov(seen.T), atol=0.004, rtol=0.08
    )
    assert set(truth.by_source(weights)) == {"arm", "table frame"}
    assert truth.by_source(weights)["arm"] == pytest.approx(U * weights.sum())


@pytest.mark.parametrize("sds", [(1.0, 1.0, 1.0), (1.0, 1.0, 0.2), (2.0, 0.5, 0.5)])
def test_the_radial_figure_is_exceeded_in_5_percent(sds: tuple[float, ...]) -> None:
    rng = np.random.default_rng(3)
    far = np.linalg.norm(rng.normal(size=(100_000, 3)) * sds, axis=1)
    share = float(np.mean(far > radial_95_mm(np.diag(np.square(sds)))))
    assert share == pytest.approx(0.05, abs=0.006)
    assert radial_95_mm(0.284**2 * np.eye(3)) == pytest.approx(0.794, abs=0.001)
    assert radial_95_mm(np.zeros((3, 3))) == 0.0


def accused(runs: int, *, with_truth: bool) -> dict[str, float]:
    """Of an unbiased detector of 0.5 mm: in which share of runs each statistic accuses."""
    rng, counts = np.random.default_rng(4), dict.fromkeys(("bias", "squares", "trend"), 0)
    for _ in range(runs):
        at = places(rng)
        truth = turned(at, turn=2e-3)
        errors = rng.normal(0.0, 0.5, (N, 3)) - drawn(truth, rng)
        own = truth if with_truth else None
        common = truth.of_mean(np.full(N, 1.0 / N)) if with_truth else None
        p_value = bias_test(errors, common).p_value
        counts["bias"] += p_value is not None and p_value < 0.05
        region = bias_ellipsoid(errors, common_mm2=common)
        assert region is not None
        off = region.directions @ region.centre_mm / region.half_axes_mm
        assert (float(off @ off) > 1.0) is bool(p_value is not None and p_value < 0.05)
        stated = 0.25 * np.eye(3) + truth.covariances_mm2
        held = consistency(errors, stated, truth=own)
        assert held.ratio is not None
        counts["squares"] += not (held.low or 0.0) <= held.ratio <= (held.high or 0.0)
        named = dict(zip(("x_mm", "y_mm", "z_mm"), at.T, strict=True))
        found = trends(named, errors, range(N), truth=own)
        counts["trend"] += any(one.significant for one in found)
    return {kind: count / runs for kind, count in counts.items()}


@pytest.mark.weekly
def test_an_unbiased_detector_is_accused_no_more_often_than_is_claimed() -> None:
    runs = examples(120)
    found = accused(runs, with_truth=True)
    assert max(found.values()) <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / runs), found


@pytest.mark.weekly
def test_without_the_truth_it_is_accused() -> None:
    found = accused(examples(120), with_truth=False)
    assert found["bias"] > 0.5, found
    assert found["squares"] > 0.08, found
    assert found["trend"] > 0.12, found


def test_a_truth_that_shares_nothing_moves_no_figure() -> None:
    rng = np.random.default_rng(5)
    errors, at = rng.normal(0.0, 1.0, (N, 3)), places(rng)
    exact, nothing = JointCovariance.exact(N), np.zeros((3, 3))
    named = dict(zip(("x_mm", "y_mm", "z_mm"), at.T, strict=True))
    assert bias_test(errors, nothing) == bias_test(errors)
    for region in (bias_ellipsoid, prediction_ellipsoid):
        with_it, without = region(errors, common_mm2=nothing), region(errors)
        assert with_it is not None
        assert without is not None
        np.testing.assert_array_equal(with_it.half_axes_mm, without.half_axes_mm)
    assert trends(named, errors, range(N), truth=exact) == trends(named, errors, range(N))
    stated = np.tile(np.eye(3), (N, 1, 1))
    assert consistency(errors, stated, truth=exact) == consistency(errors, stated)


def test_the_next_error_lies_in_its_region() -> None:
    rng, held = np.random.default_rng(6), 0
    for _ in range(RUNS):
        shared = U * rng.normal(size=3)
        seen = rng.normal(0.0, 0.3, (N, 3)) + shared
        region = prediction_ellipsoid(seen, common_mm2=U**2 * np.eye(3))
        assert region is not None
        off = region.directions @ (rng.normal(0.0, 0.3, 3) - region.centre_mm) / region.half_axes_mm
        held += float(off @ off) <= 1.0
    assert held / RUNS == pytest.approx(0.95, abs=0.03)


def test_generalised_least_squares_without_each_group_is_fitted_anew() -> None:
    """The slopes that the jackknife takes, against fits of what is left, each by itself."""
    rng = np.random.default_rng(7)
    at, groups = rng.uniform(-100.0, 100.0, 40), np.repeat(np.arange(10), 4)
    common = np.column_stack([np.ones(40) * 0.3, (groups % 2) * 0.5])
    y = 0.01 * at + common @ rng.normal(size=2) + rng.normal(0.0, 0.2, 40)
    found = _generalised(at, y, groups, 10, common)
    slope, without, weights = found.slope, found.without, found.weights
    X = np.column_stack([np.ones(40), at - at.mean()])
    left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    V = float(left @ left) / 38 * np.eye(40) + common @ common.T

    def fitted(rows: NDArray[np.int_]) -> Floats:
        """What each response weighs in the slope of these rows."""
        W, whole = np.linalg.inv(V[np.ix_(rows, rows)]), np.zeros(40)
        whole[rows] = np.linalg.solve(X[rows].T @ W @ X[rows], X[rows].T @ W)[1]
        return whole

    assert slope == pytest.approx(float(fitted(np.arange(40)) @ y))
    assert slope == pytest.approx(float(weights @ y))
    each = np.array([fitted(np.flatnonzero(groups != g)) for g in range(10)])
    assert without == pytest.approx(each @ y)
    about_mean = each - each.mean(axis=0)
    A = about_mean @ V @ about_mean.T
    assert found.freedom == pytest.approx(np.trace(A) ** 2 / np.trace(A @ A))


def test_a_place_that_hardly_varies_and_a_measured_one_are_told() -> None:
    rng = np.random.default_rng(8)
    true = rng.normal(0.0, 0.5, 60)
    noise = rng.normal(0.0, 0.23, 60)
    near = trend(Regressor(true + noise, 0.23), -noise, range(60))
    assert near.slope is None
    assert near.least_span == pytest.approx(4.6)
    far = 20.0 * true
    plain = trend(Regressor(far + noise), rng.normal(0.0, 0.1, 60) - noise, range(60))
    wary = trend(Regressor(far + noise, 0.23, measured=True), -noise, range(60))
    assert plain.truth == 0.0
    assert wary.truth == pytest.approx(1.96 * 0.23**2 / np.var(far + noise), rel=0.01)


def test_what_is_left_of_a_mean_square_is_told_with_its_interval() -> None:
    rng, held = np.random.default_rng(9), 0
    for _ in range(RUNS):
        truth = turned(places(rng))
        errors = rng.normal(0.0, 0.6, (N, 3))
        found = mean_square(errors - drawn(truth, rng), truth)
        low, high = found.interval_mm
        held += low <= float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))) <= high
    assert held / RUNS >= 0.92
    truth = turned(places(rng))
    noise = mean_square(-drawn(truth, rng), truth)
    assert noise.interval_mm[0] == 0.0
    assert noise.truth_rms_mm < noise.truth_most_mm
