"""Guard bands and tolerance limits: frozen numbers, scipy.stats
as referee, Monte Carlo as judge.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import (
    nct,
    ncx2,
    norm,  # type: ignore[attr-defined, unused-ignore]  # re-exported by a star import
)

from bench.scoring.errors import normal_k, quantile_bounds
from bench.scoring.guard_band import (
    acceptance_limit_mm,
    axis_acceptance_limit_mm,
    error_without_noise_mm,
    guard_band_mm,
    leak,
    refusal_limit_mm,
)

T, U = 5.0, 0.23


def test_frozen_acceptance_limits() -> None:
    assert guard_band_mm(U) == pytest.approx(1.645 * U, abs=1e-4)
    assert axis_acceptance_limit_mm(T, U) == pytest.approx(4.622, abs=0.0005)
    assert axis_acceptance_limit_mm(T, T / 1.64) is None
    assert acceptance_limit_mm(T, U) == pytest.approx(4.611, abs=0.0005)
    assert refusal_limit_mm(T, U) == pytest.approx(5.378, abs=0.0005)


def test_a_truth_without_uncertainty_has_no_guard_band() -> None:
    assert acceptance_limit_mm(T, 0.0) == refusal_limit_mm(T, 0.0) == T


@given(st.floats(1, 20), st.floats(1e-4, 0.55))
def test_the_radial_limit_solves_the_noncentral_chi_square(limit: float, relative: float) -> None:
    u = limit * relative
    accept = acceptance_limit_mm(limit, u)
    if accept is None:
        assert ncx2.cdf((limit / u) ** 2, 3, 1e-12) <= 0.95
    else:
        assert ncx2.cdf((limit / u) ** 2, 3, (accept / u) ** 2) == pytest.approx(0.95, abs=1e-6)


def test_the_radial_limit_by_monte_carlo() -> None:
    accept = acceptance_limit_mm(T, U)
    assert accept is not None
    rng = np.random.default_rng(20)
    true = np.array([accept, 0, 0]) + rng.normal(0, U, (400_000, 3))
    share = float((np.linalg.norm(true, axis=1) > T).mean())
    assert share == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / 400_000))


def test_a_true_error_at_the_limit_is_accepted_in_fewer_than_5_percent() -> None:
    accept = acceptance_limit_mm(T, U)
    assert accept is not None
    seen = np.array([0, T, 0]) + np.random.default_rng(21).normal(0, U, (400_000, 3))
    assert float((np.linalg.norm(seen, axis=1) <= accept).mean()) < 0.05


@given(st.floats(1.0, 10.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_more_uncertainty_never_accepts_more(limit: float, a: float, b: float) -> None:
    low, high = sorted((a, b))
    tight, loose = acceptance_limit_mm(limit, high), acceptance_limit_mm(limit, low)
    assert tight is None or (loose is not None and tight <= loose + 1e-9)


def test_a_truth_too_uncertain_accepts_nothing() -> None:
    assert acceptance_limit_mm(T, 1.8) is None


def test_noise_inflates_what_is_seen() -> None:
    rng = np.random.default_rng(22)
    seen = np.array([1.0, 2.0, 2.0]) + rng.normal(0, U, (200_000, 3))
    rms = float(np.sqrt((seen**2).sum(axis=1).mean()))
    assert rms > 3.02
    assert error_without_noise_mm(rms, U) == pytest.approx(3.0, abs=0.003)
    assert error_without_noise_mm(0.3, U) is None


def test_bad_limits_are_refused() -> None:
    for u in (-0.1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="uncertainty of the truth"):
            guard_band_mm(u)
    with pytest.raises(ValueError, match="limit: 0"):
        acceptance_limit_mm(0.0, U)


def test_frozen_tolerance_factors() -> None:
    assert normal_k(30, 0.95, 0.95) == pytest.approx(2.220, abs=0.0005)
    assert normal_k(100, 0.99, 0.95) == pytest.approx(2.684, abs=0.0005)


@given(
    st.integers(2, 500), st.sampled_from([0.9, 0.95, 0.99]), st.sampled_from([0.5, 0.9, 0.95, 0.99])
)
def test_the_normal_factor_against_scipy_stats(n: int, rate: float, confidence: float) -> None:
    referee = nct.ppf(confidence, n - 1, norm.ppf(rate) * np.sqrt(n)) / np.sqrt(n)
    assert normal_k(n, rate, confidence) == pytest.approx(referee, rel=1e-6)


def test_the_largest_of_59_is_the_first_95_95_limit() -> None:
    assert quantile_bounds(np.arange(58.0), 0.95)[1] is None
    assert quantile_bounds(np.arange(59.0), 0.95)[1] == 58.0
    assert quantile_bounds(np.arange(93.0), 0.95)[1] == 91.0  # Wilks: from 93 on the second largest
    assert quantile_bounds([], 0.95) == (None, None)


def test_quantile_bounds_cover_as_often_as_they_claim() -> None:
    draws = np.random.default_rng(23).exponential(size=(4000, 120))
    quantile = -np.log(0.1)  # of 90 %, exactly
    bounds = np.array([quantile_bounds(row, 0.9) for row in draws], dtype=np.float64)
    for covered in ((bounds[:, 0] <= quantile).mean(), (bounds[:, 1] >= quantile).mean()):
        assert 0.94 < covered < 0.99


def test_what_a_guard_band_lets_through() -> None:
    rng = np.random.default_rng(24)
    seen = np.linalg.norm(rng.normal([5.0, 0.0, 0.0], 0.23, (400_000, 3)), axis=1)
    for at in (4.4, 4.611, 4.8):
        assert leak(at, 5.0, 0.23) == pytest.approx(float(np.mean(seen <= at)), rel=0.05)
    assert (leak(5.0, 5.0, 0.0), leak(5.1, 5.0, 0.0)) == (0.0, 1.0)
    for u in (4.99e-4, 5.01e-4):  # on both sides of where the sphere is taken to be flat
        assert leak(5.0 - u, 5.0, u) == pytest.approx(0.1586, abs=1e-4)


def test_a_spread_of_one_value_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        normal_k(1, 0.95)
