"""Rates and exact intervals, with scipy's binomial test as referee."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest  # type: ignore[attr-defined, unused-ignore]  # re-exported by a star import

from bench.scoring.rates import Rate, percent, pose_successes, trials_needed, zero_failure_n

RATES = st.integers(1, 400).flatmap(lambda n: st.builds(Rate, st.integers(0, n), st.just(n)))


@given(RATES, st.sampled_from([0.8, 0.9, 0.95, 0.99]))
def test_the_interval_is_the_exact_one(rate: Rate, confidence: float) -> None:
    referee = binomtest(rate.successes, rate.trials).proportion_ci(confidence, method="exact")
    assert rate.interval(confidence) == pytest.approx((referee.low, referee.high), abs=1e-9)


@given(RATES)
def test_one_sided_bounds(rate: Rate) -> None:
    greater = binomtest(rate.successes, rate.trials, alternative="greater").proportion_ci(0.95, method="exact")
    less = binomtest(rate.successes, rate.trials, alternative="less").proportion_ci(0.95, method="exact")
    assert rate.lower_bound() == pytest.approx(greater.low, abs=1e-9)
    assert rate.upper_bound() == pytest.approx(less.high, abs=1e-9)


def test_frozen_numbers() -> None:
    assert [zero_failure_n(r, 0.95) for r in (0.95, 0.99, 0.999)] == [59, 299, 2995]
    assert Rate(24, 24).lower_bound(0.95) == pytest.approx(0.883, abs=0.0005)


@pytest.mark.parametrize(
    ("failures", "n"), [(0, 59), (1, 93), (2, 124), (3, 153), (4, 181)]
)  # the 95/95 column of attribute sampling tables
def test_trials_needed_with_failures(failures: int, n: int) -> None:
    assert trials_needed(failures, 0.95) == n


@given(st.integers(0, 12), st.sampled_from([0.5, 0.9, 0.99]), st.sampled_from([0.8, 0.95]))
def test_trials_needed_are_the_fewest(failures: int, rate: float, confidence: float) -> None:
    n = trials_needed(failures, rate, confidence)
    shown, before = (
        Rate(n - failures, n).lower_bound(confidence),
        Rate(n - 1 - failures, n - 1).lower_bound(confidence) if n > 1 + failures else 0.0,
    )
    assert shown is not None
    assert before is not None
    assert shown >= rate > before


def test_an_empty_rate_is_not_measured() -> None:
    empty = Rate()
    assert (empty.value, empty.interval(), empty.lower_bound(), empty.upper_bound()) == (None, None, None, None)
    assert str(empty) == "not measured"


@given(st.lists(RATES, max_size=5))
def test_rates_add_by_their_counts(rates: list[Rate]) -> None:
    total = sum(rates, Rate())
    assert (total.successes, total.trials) == (sum(r.successes for r in rates), sum(r.trials for r in rates))


def test_a_pose_succeeds_when_all_its_repeats_do() -> None:
    poses = ["a", "b", "a", "b", "c", "a"]
    assert pose_successes(poses, [True, True, True, False, True, True]) == Rate(2, 3)
    assert pose_successes([], []) == Rate()
    with pytest.raises(ValueError, match="shorter"):
        pose_successes(["a", "b"], [True])


def test_repeats_do_not_narrow_the_interval() -> None:
    frames = [f"pose {k // 3}" for k in range(60)]
    assert pose_successes(frames, [True] * 60).lower_bound() == Rate(20, 20).lower_bound()


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


def test_impossible_counts_and_claims_are_refused() -> None:
    with pytest.raises(ValueError, match="5 successes of 4 trials"):
        Rate(5, 4)
    with pytest.raises(ValueError, match="negative"):
        trials_needed(-1, 0.95)
    for rate in (0.0, 1.0):
        with pytest.raises(ValueError, match="no number of trials shows 100 %"):
            zero_failure_n(rate)
    with pytest.raises(ValueError, match="confidence"):
        Rate(1, 1).interval(1.0)
