"""Truth by touch: the mean, and a budget whose parts are named."""

from __future__ import annotations

import numpy as np
import pytest

from bench.truth import ROUNDING_MM, touched


def test_the_mean_and_the_budget() -> None:
    tips = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.3, 0.3]])
    truth = touched(tips, accuracy_mm=0.23, definition_mm=0.1)
    assert truth.point_mm == pytest.approx((0.1, 0.1, 0.1))
    parts = {c.name: c.u_mm for c in truth.uncertainty.components}
    assert parts["arm"] == 0.23
    assert parts["resolution"] == pytest.approx(0.0606, abs=1e-4)
    assert parts["scatter"] == pytest.approx(np.sqrt(0.03 / 3))
    assert truth.uncertainty.u_mm == pytest.approx(np.sqrt(0.23**2 + 0.1**2 + ROUNDING_MM**2 + 0.03 / 3))


def test_one_touch_has_no_scatter_to_tell() -> None:
    truth = touched(np.array([[1.0, 2.0, 3.0]]), accuracy_mm=0.23, definition_mm=0.1)
    assert {c.name: c.u_mm for c in truth.uncertainty.components}["scatter"] == 0.0


@pytest.mark.parametrize("tips", [np.zeros((0, 3)), np.zeros(3), np.zeros((2, 2))])
def test_no_touch_is_no_truth(tips: np.ndarray) -> None:
    with pytest.raises(ValueError, match="touches"):
        touched(tips, accuracy_mm=0.23, definition_mm=0.1)


def test_the_stated_uncertainty_holds_what_was_put_in() -> None:
    rng = np.random.default_rng(1)
    inside, trials = 0, 2000
    for _ in range(trials):
        shift = rng.normal(0.0, 0.23, 3) + rng.normal(0.0, 0.1, 3) + rng.normal(0.0, ROUNDING_MM, 3)
        truth = touched(shift + rng.normal(0.0, 0.1, (3, 3)), accuracy_mm=0.23, definition_mm=0.1)
        inside += bool(abs(truth.point_mm[0]) <= 1.96 * truth.uncertainty.u_mm)
    assert 0.93 < inside / trials < 0.97
