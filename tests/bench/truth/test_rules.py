"""When a touch is refused: slips of the tip, and tips at another teat; and what must not be
refused.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.truth.touching import FAR, MEDIAN_LENGTH, mistaken, outliers
from bench.truth.uncertainty import reading_u_mm
from tests.bench.truth.touches import ENDS_MM, arm_settings

S0 = reading_u_mm(arm_settings())


def test_a_slip_is_refused_with_its_figures() -> None:
    readings = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.05], [1.5, 0.0, -0.3]])
    refused = outliers(readings, S0)
    assert list(refused) == [2]
    assert "1.4" in refused[2]
    assert "median of 3 readings" in refused[2]


@pytest.mark.parametrize("n", [3, 5, 8])
def test_honest_readings_are_hardly_ever_refused(n: int) -> None:
    rng = np.random.default_rng(n)
    lost = sum(bool(outliers(rng.normal(0.0, S0, (n, 3)), S0)) for _ in range(2000))
    assert lost <= 6, f"{lost} of 2000 ends lost a reading that belonged to it"


def test_an_unsteady_hand_widens_its_own_limit() -> None:
    rng = np.random.default_rng(7)
    lost = sum(len(outliers(rng.normal(0.0, 5.0 * S0, (8, 3)), S0)) for _ in range(500))
    assert lost <= 0.03 * 8 * 500


def test_of_two_readings_neither_can_be_told_to_be_wrong() -> None:
    apart = np.array([[0.0, 0.0, 0.0], [FAR * S0 * 1.5, 0.0, 0.0]])
    assert list(outliers(apart, S0)) == [0, 1]
    assert outliers(0.5 * apart, S0) == {}
    assert outliers(apart[:1], S0) == {}


def test_the_median_length_is_that_of_a_normal_vector() -> None:
    from scipy.stats import chi

    assert pytest.approx(chi.median(3), abs=1e-4) == MEDIAN_LENGTH


@given(st.permutations([1, 2, 3, 4]), st.tuples(*[st.floats(-12.0, 12.0)] * 2))
def test_a_wrong_order_is_noticed_wherever_the_phantom_came_to_stand(
    order: list[int], shift: tuple[float, float]
) -> None:
    there = ENDS_MM + np.array([*shift, 0.0])
    done: dict[int, np.ndarray] = {}
    noticed = False
    for asked, touched in zip((1, 2, 3, 4), order, strict=True):
        reason = mistaken(there[touched - 1], asked, ENDS_MM, done)
        if reason:
            noticed = True
            assert asked != touched
            assert f"teat {touched}" in reason
            break
        done[asked] = there[touched - 1]
    assert noticed == (order != [1, 2, 3, 4])


def test_an_end_that_was_touched_already_is_recognised() -> None:
    reason = mistaken(ENDS_MM[0] + 0.3, 2, ENDS_MM, {1: ENDS_MM[0]})
    assert reason is not None
    assert "the end of teat 1 once more" in reason


def test_a_place_between_two_teats_is_left_to_the_operator() -> None:
    between = (ENDS_MM[0] + ENDS_MM[1]) / 2
    assert mistaken(between, 1, ENDS_MM, {}) is None
    assert mistaken(between, 2, ENDS_MM, {}) is None


def test_teats_that_touch_each_other_are_told_apart() -> None:
    # 22 mm: the layout "overlapping"
    near = np.array([[-95.0, 232.0, 136.0], [-117.0, 232.0, 134.0]])
    assert mistaken(near[0] + [3.0, 0.0, 0.0], 1, near, {}) is None
    assert mistaken(near[1] + [3.0, 0.0, 0.0], 1, near, {}) is not None
