"""Rates and exact intervals, with scipy's binomial test as referee."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from bench.scoring.rates import (
    Rate,
    crossing,
    guarded_n,
    percent,
    percent_apart,
    pose_successes,
    shown_falsely,
    trials_needed,
    zero_failure_n,
)
from textfiles.text import plural

RATES = st.integers(1, 400).flatmap(lambda n: st.builds(Rate, st.integers(0, n), st.just(n)))


@pytest.mark.slow
@given(RATES, st.sampled_from([0.8, 0.9, 0.95, 0.99]))
def test_the_interval_is_the_exact_one(rate: Rate, confidence: float) -> None:
    referee = scipy.stats.binomtest(rate.successes, rate.trials).proportion_ci(
        confidence, method="exact"
    )
    assert rate.interval(confidence) == pytest.approx((referee.low, referee.high), abs=1e-9)


@pytest.mark.slow
@given(RATES)
def test_one_sided_bounds(rate: Rate) -> None:
    greater, less = (
        scipy.stats.binomtest(rate.successes, rate.trials, alternative=side).proportion_ci(
            0.95, "exact"
        )
        for side in ("greater", "less")
    )
    assert rate.lower_bound() == pytest.approx(greater.low, abs=1e-9)
    assert rate.upper_bound() == pytest.approx(less.high, abs=1e-9)


@pytest.mark.parametrize(
    ("failures", "n"), [(0, 59), (1, 93), (2, 124), (3, 153), (4, 181)]
)  # the 95/95 column of attribute sampling tables
def test_trials_needed_with_failures(failures: int, n: int) -> None:
    assert trials_needed(failures, 0.95) == n


@given(st.integers(0, 12), st.sampled_from([0.5, 0.9, 0.99]), st.sampled_from([0.8, 0.95]))
def test_trials_needed_are_the_fewest(failures: int, rate: float, confidence: float) -> None:
    n = trials_needed(failures, rate, confidence)
    shown, before = (Rate(k - failures, k).lower_bound(confidence) or 0.0 for k in (n, n - 1))
    assert shown >= rate > before


def test_an_empty_rate_is_not_measured() -> None:
    empty = Rate()
    assert (empty.value, empty.interval()) == (None, None)
    assert (empty.lower_bound(), empty.upper_bound()) == (None, None)
    assert str(empty) == "not measured"


def test_a_pose_succeeds_when_all_its_repeats_do() -> None:
    poses = ["a", "b", "a", "b", "c", "a"]
    assert pose_successes(poses, [True, True, True, False, True, True]) == Rate(2, 3)
    assert pose_successes([], []) == Rate()
    with pytest.raises(ValueError, match="shorter"):
        pose_successes(["a", "b"], [True])


@pytest.mark.parametrize(
    ("fraction", "text"),
    [
        (1.0, "100 %"),
        (0.9999, "> 99.9 %"),
        (0.9990001, "> 99.9 %"),
        (0.999, "99.9 %"),
        (0.883, "88.3 %"),
        (0.001, "0.1 %"),
        (1e-5, "< 0.1 %"),
        (0.0, "0 %"),
    ],
)
def test_100_percent_is_said_only_where_true(fraction: float, text: str) -> None:
    assert percent(fraction) == text


def test_one_of_a_thing_is_said_as_one() -> None:
    assert [plural(n, "touch", "has") for n in (1, 2)] == ["1 touch has", "2 touches have"]


def test_impossible_counts_and_claims_are_refused() -> None:
    with pytest.raises(ValueError, match="5 successes of 4 trials"):
        Rate(5, 4)
    with pytest.raises(ValueError, match="negative"):
        trials_needed(-1, 0.95)


CLAIMS: dict[str, tuple[str, Callable[[float], object]]] = {
    "interval": ("confidence", lambda value: Rate(3, 4).interval(value)),
    "lower_bound": ("confidence", lambda value: Rate(3, 4).lower_bound(value)),
    "upper_bound": ("confidence", lambda value: Rate(3, 4).upper_bound(value)),
    "zero_failure_n, rate": ("rate", zero_failure_n),
    "zero_failure_n": ("confidence", lambda value: zero_failure_n(0.95, value)),
    "trials_needed, rate": ("rate", lambda value: trials_needed(0, value)),
    "trials_needed": ("confidence", lambda value: trials_needed(0, 0.95, value)),
}


@pytest.mark.parametrize("claim", CLAIMS)
def test_rates_and_confidences_lie_between_0_and_1_both_excluded(claim: str) -> None:
    name, call = CLAIMS[claim]
    for outside in (-0.5, 0.0, 1.0, 1.5, float("nan")):
        with pytest.raises(ValueError, match=rf"^{name}: {outside} must lie .* shows 100 %"):
            call(outside)
    for inside in (1e-9, 1.0 - 1e-9):
        assert call(inside) is not None


@pytest.mark.parametrize(
    ("failures", "leak", "n"),
    [
        (0, 0.0, 59),
        (0, 1e-4, 59),
        (0, 0.0408, 91),
        (0, 0.05, None),
        (1, 0.0, 93),
        (1, 0.02, 110),
        (1, 0.05, None),
    ],
)
def test_poses_where_the_truth_could_pass_a_bad_one(
    failures: int, leak: float, n: int | None
) -> None:
    assert guarded_n(failures, 0.95, 0.95, leak) == n


@pytest.mark.parametrize(
    ("failures", "trials", "rate", "leak"),
    [(0, 59, 0.95, 0.04), (1, 100, 0.95, 0.02), (3, 3000, 0.999, 0.01)],
)
def test_the_risk_of_a_false_claim_is_the_sum_over_the_bad_poses(
    failures: int, trials: int, rate: float, leak: float
) -> None:
    b = np.arange(failures + 1, trials + 1)
    passed = np.minimum(1.0, b * leak / (b - failures))
    bad = 1.0 - rate
    expected = scipy.stats.binom.cdf(failures, trials, bad) + np.sum(
        scipy.stats.binom.pmf(b, trials, bad) * passed
    )
    assert shown_falsely(failures, trials, rate, leak) == pytest.approx(float(expected), abs=1e-9)
    if failures == 0:
        assert expected == pytest.approx(rate**trials + (1.0 - rate**trials) * leak)


@pytest.mark.parametrize(
    ("fraction", "limit", "text"),
    [
        (0.94966, 0.95, "94.97 %"),
        (0.95049, 0.95, "95.0 %"),
        (0.98999, 0.99, "98.999 %"),
        (0.999001, 0.999, "> 99.9 %"),
        (0.5, 0.95, "50.0 %"),
    ],
)
def test_a_figure_is_read_on_the_right_side_of_its_limit(
    fraction: float, limit: float, text: str
) -> None:
    assert percent_apart(fraction, limit) == text


MONOTONE: dict[str, Callable[[float], float]] = {
    "straight": lambda off: off,
    "steep": lambda off: float(np.tanh(300.0 * off)),
    "flat at its zero": lambda off: off**3,
    "steepest at its zero": lambda off: float(np.cbrt(off)),
    "a step": lambda off: 1.0 if off > 0.0 else -1.0,
    "falls": lambda off: float(np.exp(-off)) - 1.0,
}


@given(
    st.sampled_from(sorted(MONOTONE)),
    st.floats(-3.0, 3.0),
    st.floats(1e-6, 9.0),
    st.floats(1e-6, 9.0),
)
def test_a_crossing_is_where_scipy_finds_it(
    form: str, zero: float, below: float, above: float
) -> None:
    asked: list[float] = []

    def function(x: float) -> float:
        asked.append(x)
        return MONOTONE[form](x - zero)

    low, high = zero - below, zero + above
    found, steps = crossing(function, low, high), len(asked)
    assert low <= min(asked)
    assert max(asked) <= high
    assert steps <= 3 * 45  # halves alone take some 43 from 18 to 2e-12
    near = 2e-4 if form == "flat at its zero" else 5e-12  # where rounding makes a cube 0
    assert found == pytest.approx(zero, abs=near)
    assert found == pytest.approx(brentq(function, low, high, maxiter=9999), abs=near)


@pytest.mark.parametrize(("low", "high", "nearer"), [(1.0, 3.0, 1.0), (-3.0, -2.0, -2.0)])
def test_without_a_crossing_it_is_the_nearer_end(low: float, high: float, nearer: float) -> None:
    assert crossing(lambda x: x, low, high) == nearer


@pytest.mark.parametrize("wrong", [0.0, 1.0, 0.5])
def test_what_is_no_number_has_no_crossing(wrong: float) -> None:
    with pytest.raises(ValueError, match=f"no number at {wrong}"):
        crossing(lambda x: math.nan if x == wrong else x - 0.3, 0.0, 1.0)


def test_a_crossing_loads_no_part_of_scipy() -> None:
    code = (
        "import sys; from bench.scoring.rates import crossing; crossing(lambda x: x - 0.3, 0, 1);"
        "print(sorted(name for name in sys.modules if name.startswith('scipy.opt')))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert loaded.strip() == "[]"
