"""One teat end as a point: its mean, its budget line by line, the ball tip, and a region that holds
what it says.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from bench.truth.uncertainty import (
    CARRY,
    CHI2_95,
    ROUNDING_MM,
    Component,
    How,
    end_u_mm,
    moved,
    reading_u_mm,
    tip_radius_u_mm,
    touched,
)
from instruments.teat_end import DEFINITION, apex_mm, ball_centre_mm, end_under_ball_mm
from tests.bench.truth.touches import arm_settings, layout

ARM = arm_settings()
TIPS = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.3, 0.3]])


def test_the_mean_and_the_budget() -> None:
    truth = touched(TIPS, ARM)
    assert truth.point_mm == pytest.approx((0.1, 0.1, 0.1))
    assert truth.how is How.TOUCHED
    parts = {c.name: c.u_mm for c in truth.uncertainty.components}
    assert list(parts) == ["arm", "definition", "resolution", "scatter"]
    assert parts["arm"] == 0.23
    assert parts["resolution"] == pytest.approx(0.0606, abs=1e-4)
    assert parts["scatter"] == pytest.approx(np.sqrt(0.03 / 3))
    assert truth.uncertainty.u_mm == pytest.approx(
        np.sqrt(0.23**2 + 0.1**2 + ROUNDING_MM**2 + 0.03 / 3)
    )
    assert np.allclose(truth.covariance_mm2, truth.uncertainty.u_mm**2 * np.eye(3))


def test_the_table_frame_is_a_line_of_its_own() -> None:
    parts = {c.name: c.u_mm for c in touched(TIPS, ARM, registration_mm=0.4).uncertainty.components}
    assert parts["registration"] == 0.4


def test_one_touch_has_no_scatter_to_tell() -> None:
    truth = touched(np.array([[1.0, 2.0, 3.0]]), ARM)
    assert {c.name: c.u_mm for c in truth.uncertainty.components}["scatter"] == 0.0


@pytest.mark.parametrize("tips", [np.zeros((0, 3)), np.zeros(3), np.zeros((2, 2))])
def test_no_touch_is_no_truth(tips: np.ndarray) -> None:
    with pytest.raises(ValueError, match="touches"):
        touched(tips, ARM)


def test_a_ball_tip_adds_what_the_axis_is_uncertain_by() -> None:
    ball = arm_settings(tip_radius_mm=3.0, axis_u_rad=0.02, tip_radius_u_mm=0.01)
    parts = {c.name: c.u_mm for c in touched(TIPS, ball).uncertainty.components}
    assert parts["tip radius"] == pytest.approx(np.hypot(0.06, 0.01)) == tip_radius_u_mm(ball)
    assert tip_radius_u_mm(ARM) == 0.0
    assert end_u_mm(ball, 3) > end_u_mm(ARM, 3) > end_u_mm(ARM, 30) > 0.23
    assert reading_u_mm(ARM) == pytest.approx(np.hypot(0.1, 0.0606), abs=1e-4)


def test_a_carried_end_keeps_its_budget_and_gets_a_line() -> None:
    start = touched(TIPS, ARM, registration_mm=0.2)
    carry = np.diag([0.04, 0.01, 0.0])
    there = moved(start, np.array([1.0, 2.0, 3.0]), carry, "carried 5 mm", 0.35)
    parts = {c.name: c.u_mm for c in there.uncertainty.components}
    assert there.how is How.CARRIED
    assert there.point_mm == (1.0, 2.0, 3.0)
    assert parts["registration"] == 0.35, "the table frame's part is that of the new place"
    assert parts[CARRY] == pytest.approx(0.2), "the worst direction's"
    alike = sum(c.u_mm**2 for c in there.uncertainty.components if c.name != CARRY)
    assert np.allclose(there.covariance_mm2, alike * np.eye(3) + carry)
    assert isinstance(there.uncertainty.components[-1], Component)


def test_the_region_is_the_ellipsoid_of_95_percent() -> None:
    assert pytest.approx(chi2.ppf(0.95, 3)) == CHI2_95
    truth = touched(np.zeros((1, 3)), ARM)
    edge = np.sqrt(CHI2_95) * truth.uncertainty.u_mm
    assert truth.holds((0.999 * edge, 0.0, 0.0))
    assert not truth.holds((1.001 * edge, 0.0, 0.0))


def test_the_stated_uncertainty_holds_what_was_put_in() -> None:
    rng = np.random.default_rng(1)
    inside, trials = 0, 2000
    for _ in range(trials):
        shift = rng.normal(0.0, 0.23, 3) + rng.normal(0.0, 0.1, 3) + rng.normal(0.0, ROUNDING_MM, 3)
        inside += touched(shift + rng.normal(0.0, 0.1, (3, 3)), ARM).holds((0.0, 0.0, 0.0))
    assert 0.93 < inside / trials < 0.97


def test_what_a_teat_end_is_stands_in_one_place_and_the_scene_keeps_to_it() -> None:
    phantom = layout("non-vertical")
    lengths = [teat.shape.length_mm for teat in phantom.teats]
    assert np.array_equal(phantom.ends_mm, apex_mm(phantom.bases_mm, phantom.axes, lengths))
    assert "own axis" in DEFINITION


def test_the_end_lies_under_the_ball_along_the_teat_s_axis() -> None:
    phantom = layout("non-vertical")
    for end, axis in zip(phantom.ends_mm, phantom.axes, strict=True):
        centre = ball_centre_mm(end, axis, 3.0)
        assert np.linalg.norm(centre - end) == pytest.approx(3.0)
        assert centre[2] > end[2]
        assert np.allclose(end_under_ball_mm(centre, axis, 3.0), end)
