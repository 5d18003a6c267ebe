"""What a number of poses can show: frozen numbers, brute force, and statsmodels."""

from __future__ import annotations

import pytest
import scipy
from hypothesis import example, given
from hypothesis import strategies as st

from bench.scoring.comparison import Discordance
from bench.scoring.guard_band import acceptance_limit_mm, leak
from bench.scoring.rates import Rate, guarded_n
from bench.scoring.sample_size import (
    detectable_loss,
    detectable_shift,
    discordant_needed,
    failures_allowed,
    mcnemar_power,
    poses_for_shift,
    power_of_rate,
    shown_error_mm,
)


def test_frozen_numbers() -> None:
    assert [failures_allowed(n, 0.95) for n in (58, 59, 92, 93)] == [None, 0, 0, 1]
    assert discordant_needed() == 6


@given(st.integers(1, 400), st.sampled_from([0.8, 0.95, 0.99]))
def test_the_failures_allowed_are_the_most(trials: int, rate: float) -> None:
    allowed = failures_allowed(trials, rate)
    shows = [
        k
        for k in range(min(trials, 60) + 1)
        if (Rate(trials - k, trials).lower_bound() or 0.0) >= rate
    ]
    assert allowed == (max(shows) if shows else None) or (allowed or 0) >= 60


def test_the_chance_to_show_a_rate() -> None:
    assert power_of_rate(59, 0.99, 0.95) == pytest.approx(0.99**59)
    assert power_of_rate(93, 0.99, 0.95) == pytest.approx(float(scipy.stats.binom.cdf(1, 93, 0.01)))
    assert power_of_rate(58, 0.999, 0.95) == 0.0


@pytest.mark.parametrize(
    ("trials", "u_mm"), [(59, 0.23), (70, 0.23), (91, 0.23), (500, 0.23), (59, 0.0), (62, 1.0)]
)
def test_the_largest_error_that_poses_show(trials: int, u_mm: float) -> None:
    most = shown_error_mm(trials, 0.95, 5.0, u_mm)
    assert most is not None
    accept = acceptance_limit_mm(5.0, u_mm)
    assert accept is not None
    assert most <= accept
    needed = guarded_n(0, 0.95, 0.95, leak(most - 1e-6, 5.0, u_mm))
    assert needed is not None
    assert needed <= trials
    if most < accept:
        beyond = guarded_n(0, 0.95, 0.95, leak(most + 1e-3, 5.0, u_mm))
        assert beyond is None or beyond > trials


def test_too_few_poses_and_too_uncertain_a_truth_show_no_error() -> None:
    assert shown_error_mm(58, 0.95, 5.0, 0.23) is None
    assert shown_error_mm(500, 0.95, 5.0, 2.5) is None


def test_a_share_too_small_for_any_computer_is_none() -> None:
    assert mcnemar_power(2, 0.0, 1.1125369292536007e-308) == 0.0


SHARES = st.floats(0, 0.5).map(lambda share: share if share > 1e-12 else 0.0)


@pytest.mark.slow
@given(st.integers(1, 25), SHARES, SHARES)
@example(2, 0.0, 0.0)
def test_the_power_of_mcnemar_by_counting_every_outcome(n: int, lost: float, won: float) -> None:
    total = 0.0
    for b in range(n + 1):
        for c in range(n - b + 1):
            if Discordance(only_old=b, only_new=c, both=n - b - c).p_value < 0.05:
                chance = scipy.stats.binom.pmf(b, n, lost) * (
                    scipy.stats.binom.pmf(c, n - b, won / (1.0 - lost))
                    if lost < 1.0
                    else float(c == 0)
                )
                total += float(chance)
    assert mcnemar_power(n, lost, won) == pytest.approx(total, abs=1e-9)


def test_the_smallest_loss_that_shows() -> None:
    loss = detectable_loss(59)
    assert loss is not None
    assert mcnemar_power(59, loss, 0.0) == pytest.approx(0.8, abs=1e-6)
    assert float(scipy.stats.binom.sf(5, 59, loss)) == pytest.approx(
        0.8, abs=1e-6
    )  # six lost and none won
    assert detectable_loss(5) is None


@pytest.mark.slow
@pytest.mark.parametrize("n", [4, 6, 20, 59, 300])
def test_the_smallest_shift_against_statsmodels(n: int) -> None:
    from statsmodels.stats.power import TTestPower  # type: ignore[import-untyped]

    assert detectable_shift(n, 1.5) == pytest.approx(
        1.5 * TTestPower().solve_power(nobs=n, alpha=0.05, power=0.8), rel=1e-5
    )


@pytest.mark.slow
def test_the_poses_for_a_shift() -> None:
    # the textbook's one-sample t test with effect 0.5, 5 %, 80 %
    assert poses_for_shift(0.5, 1.0) == 34
    assert detectable_shift(1, 1.0) is None


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: mcnemar_power(10, 0.7, 0.7), "more than 1 together"),
        (lambda: detectable_shift(10, 0.0), "above 0 and finite"),
        (lambda: poses_for_shift(0.0, 1.0), "the same"),
        (lambda: detectable_loss(10, power=1.0), "power"),
    ],
)
def test_impossible_questions(call: object, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        call()  # type: ignore[operator]
