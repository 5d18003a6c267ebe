"""An end is the mean of the fits about it, and its covariance has how they scatter."""

from __future__ import annotations

import numpy as np
import pytest

from detector.fused.decide import NEAR_MM, means

ENDS = np.array([[-1.5, 0, 900], [1.5, 0, 900], [0, 16, 900], [300, 0, 900.0]])


@pytest.mark.parametrize("power", [0.5, 2.0])
def test_two_fits_as_likely_give_the_middle_and_their_spread(power: float) -> None:
    (mean,), (between,) = means(ENDS, np.array([1.0, 1.0, 5.0, 1.0]), [0], power)
    assert mean == pytest.approx([0, 0, 900])
    assert between == pytest.approx(np.diag([1.5**2, 0, 0]))


def test_a_fit_counts_by_a_power_of_its_odds() -> None:
    (mean,), (between,) = means(ENDS, np.log([3.0, 1.0, 1.0, 1.0]), [0], 2.0)
    assert mean == pytest.approx([-1.5 + 3.0 * 0.1, 0, 900])
    assert between[0, 0] == pytest.approx(0.75 * 0.3**2 + 0.25 * 2.7**2)


def test_a_fit_of_the_same_place_farther_off_is_in_the_covariance_alone() -> None:
    ends = np.array([[0, 0, 900], [0, 0, 900 + 1.5 * NEAR_MM], [300, 0, 900.0]])
    (mean,), (between,) = means(ends, np.log([4.0, 1.0, 4.0]), [0], 2.0)
    assert mean == pytest.approx(ends[0])
    assert between == pytest.approx(np.diag([0, 0, 0.2 * (1.5 * NEAR_MM) ** 2]))


def test_a_fit_alone_is_the_end_and_a_likelier_one_counts_no_more_than_the_given() -> None:
    odds = np.array([1.0, 9.0, 0.0, 1.0])
    mean, between = means(ENDS, odds, [3, 0], 2.0)
    assert mean[0] == pytest.approx(ENDS[3])
    assert between[0] == pytest.approx(np.zeros((3, 3)))
    assert mean[1] == pytest.approx([0, 0, 900])


def test_no_answers_have_no_means() -> None:
    mean, between = means(ENDS, np.zeros(4), [], 2.0)
    assert mean.shape == (0, 3)
    assert between.shape == (0, 3, 3)
