"""An end is the mean of the fits of its place, and its covariance has how they scatter."""

from __future__ import annotations

import numpy as np
import pytest

from detector.fused.decide import means

ENDS = np.array([[-1.5, 0, 900], [1.5, 0, 900], [0, 16, 900], [300, 0, 900.0]])


def test_two_fits_as_likely_give_the_middle_and_their_spread() -> None:
    (mean,), (between,) = means(ENDS, np.array([1.0, 1.0, 5.0, 1.0]), [0])
    assert mean == pytest.approx([0, 0, 900])
    assert between == pytest.approx(np.diag([1.5**2, 0, 0]))


@pytest.mark.parametrize("far_mm", [1.0, 3.0, 10.0])
def test_a_fit_counts_by_its_odds_however_far_off_in_its_place(far_mm: float) -> None:
    ends = np.array([[0, 0, 900], [0, 0, 900 + far_mm], [300, 0, 900.0]])
    (mean,), (between,) = means(ends, np.log([4.0, 1.0, 4.0]), [0])
    assert mean == pytest.approx([0, 0, 900 + 0.2 * far_mm])
    assert between == pytest.approx(np.diag([0, 0, 0.8 * 0.2 * far_mm**2]))


def test_a_fit_alone_is_the_end_and_a_likelier_one_counts_no_more_than_the_given() -> None:
    odds = np.array([1.0, 9.0, 0.0, 1.0])
    mean, between = means(ENDS, odds, [3, 0])
    assert mean[0] == pytest.approx(ENDS[3])
    assert between[0] == pytest.approx(np.zeros((3, 3)))
    assert mean[1] == pytest.approx([0, 0, 900])


def test_no_answers_have_no_means() -> None:
    mean, between = means(ENDS, np.zeros(4), [])
    assert mean.shape == (0, 3)
    assert between.shape == (0, 3, 3)
