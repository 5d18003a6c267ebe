"""The figures of an arm's verification: against numbers worked by hand, and against the accuracy
that was put into an emulated arm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from bench.calibrate.arm import DIRECTIONS, ROUND, Plan, sphere_centre, verify
from bench.rig.arm_files import (
    LengthTest,
    Limits,
    LocationTest,
    Verification,
    as_dict,
    from_dict,
    least_sphere_mm,
)
from tests.bench.calibrate.arm_rig import MADE, Follower, emulated

UP = np.array([[0.0, 0.0, 1.0]])
SWUNG = np.array(
    [[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [-0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [0.0, -0.6, 0.8]]
)
CROSS = np.array(
    [[0.3, 0.0, 0.0], [-0.3, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, -0.1, 0.0], [0.0, 0.0, 0.0]]
)
LIMITS = Limits(0.46, 0.7)  # as the shipped script


def test_figures_worked_by_hand() -> None:
    place = np.array([200.0, 0.0, 20.0])
    test = LocationTest("near", CROSS + place, SWUNG)
    assert test.centre_mm == pytest.approx(place)
    assert test.deviations_mm == pytest.approx([0.3, 0.3, 0.1, 0.1, 0.0], abs=1e-9)
    assert test.largest_mm == pytest.approx(0.3)
    assert test.two_sd_mm == pytest.approx(2.0 * np.sqrt(0.2 / 4.0))
    assert test.sphere_mm == pytest.approx(0.6)
    assert test.swing_deg == pytest.approx(2.0 * np.degrees(np.arctan2(0.6, 0.8)))


def test_lengths_worked_by_hand() -> None:
    lengths = tuple(
        LengthTest(f"way {k}", np.zeros(3), np.array([0.0, 0.0, 300.0 + e]), 300.0)
        for k, e in enumerate((0.3, -0.5, 0.1))
    )
    found = Verification(MADE, "40937", (LocationTest("near", CROSS, SWUNG),), lengths)
    assert [test.error_mm for test in lengths] == pytest.approx([0.3, -0.5, 0.1])
    assert found.length_mm == pytest.approx(0.5)
    assert found.length_two_rms_mm == pytest.approx(2.0 * np.sqrt(0.35 / 3.0))
    assert found.faults(LIMITS) == ()
    assert found.faults(Limits(0.46, 0.49)) == (
        "way 1: 300 mm were measured -0.50 mm wrong, limit 0.49 mm",
    )


def test_without_lengths_a_limit_on_lengths_is_not_kept() -> None:
    found = Verification(MADE, "40937", (LocationTest("near", CROSS, SWUNG),))
    assert found.length_mm is None
    assert found.length_two_rms_mm is None
    assert found.faults(LIMITS) == ("no calibrated length was measured",)
    assert found.faults(Limits(0.46)) == ()


def test_a_test_that_could_not_fail_is_no_test() -> None:
    still = LocationTest("near", CROSS, np.repeat(UP, 5, axis=0))
    few = LocationTest("far", CROSS[:4], SWUNG[:4])
    faults = Verification(MADE, "40937", (still, few)).faults(Limits(0.46))
    assert faults == (
        "near: the stylus was swung by 0 degrees only; 30 are needed",
        "far: 4 touches only; 5 are needed",
    )


@pytest.mark.parametrize(
    ("tips", "axes"), [(CROSS[:1], SWUNG[:1]), (CROSS, SWUNG[:4]), (CROSS[:, :2], SWUNG[:, :2])]
)
def test_shapes_that_are_no_test_are_refused(tips: np.ndarray, axes: np.ndarray) -> None:
    with pytest.raises(ValueError, match="location test"):
        LocationTest("near", tips, axes)


@pytest.mark.slow
@given(st.lists(st.tuples(*[st.floats(-1.0, 1.0)] * 3), min_size=1, max_size=9))
@settings(max_examples=60, deadline=None)
def test_the_least_sphere_is_that_of_an_optimiser(points: list[tuple[float, float, float]]) -> None:
    cloud = np.array(points)
    mine = least_sphere_mm(cloud)

    def inside(x: np.ndarray) -> np.ndarray:
        return np.asarray(x[3] - np.sum((cloud - x[:3]) ** 2, axis=1))

    start = np.append(cloud.mean(axis=0), 4.0)
    found = minimize(
        lambda x: x[3],
        start,
        method="SLSQP",
        constraints={"type": "ineq", "fun": inside},
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert mine == pytest.approx(2.0 * np.sqrt(max(found.x[3], 0.0)), abs=1e-4)


def test_a_verification_survives_being_a_fact() -> None:
    lengths = (LengthTest("flat", np.zeros(3), np.array([0.0, 300.1, 0.0]), 300.0),)
    found = Verification(MADE, "40937", (LocationTest("near", CROSS, SWUNG),), lengths)
    again = from_dict(as_dict(found))
    assert (again.made, again.serial_number) == (MADE, "40937")
    assert (again.location_mm, again.length_mm) == (found.location_mm, found.length_mm)


class Found(NamedTuple):
    location_mm: float
    two_sd_mm: float
    verified: bool


def verified(accuracy_mm: float, seed: int) -> Found:
    with emulated(seed=seed, accuracy_mm=accuracy_mm) as (arm, trying):
        found = verify(arm, Follower(trying), Plan(1, 10, None), MADE)
    return Found(
        found.location_mm,
        max(test.two_sd_mm for test in found.locations),
        not found.faults(Limits(LIMITS.location_mm)),
    )


@pytest.mark.slow
def test_verification_finds_what_accuracy_was_put_in() -> None:
    """The location error grows with the accuracy that is put in; what is left at 0 is the rounding
    of counts and the hand's tremor.
    """
    by_accuracy = {
        accuracy: [verified(accuracy, seed) for seed in range(5)]
        for accuracy in (0.0, 0.23, 0.64, 2.0)
    }
    medians = {
        accuracy: float(np.median([one.location_mm for one in all_of]))
        for accuracy, all_of in by_accuracy.items()
    }
    assert medians[0.0] < 0.2, "0.105 mm rms of rounding at each place, and 0.05 mm of tremor"
    assert medians[0.0] < medians[0.23] < medians[0.64] < medians[2.0]
    grown = [np.sqrt(medians[a] ** 2 - medians[0.0] ** 2) / a for a in (0.64, 2.0)]
    assert grown[0] == pytest.approx(grown[1], rel=0.35), "what was put in shows in proportion"
    assert all(one.verified for one in by_accuracy[0.0] + by_accuracy[0.23]), (
        "an arm as good as the maker says is verified"
    )
    assert not any(one.verified for one in by_accuracy[2.0]), "a bad one is not"


@pytest.mark.slow
def test_what_is_asked_for_is_what_was_planned() -> None:
    with emulated() as (arm, trying):
        person = Follower(trying)
        found = verify(arm, person, Plan(2, 5, 300.0, 3), MADE)
    assert [test.where for test in found.locations] == ["near", "far"]
    assert [test.n for test in found.locations] == [5, 5]
    assert [test.where for test in found.lengths] == list(DIRECTIONS[:3])
    assert [step.what for step in person.steps] == ["near"] * 5 + ["far"] * 5 + [
        "length a",
        "length b",
    ] * 3
    assert all((test.swing_deg or 0.0) > 30.0 for test in found.locations)
    assert found.length_mm is not None
    assert found.length_mm < 0.7
    directions = np.array([(t.b_mm - t.a_mm) / t.measured_mm for t in found.lengths])
    assert np.abs(np.triu(directions @ directions.T, 1)).max() < 0.75, "no two lie alike"


@pytest.mark.slow
def test_a_bar_of_another_length_than_was_said_is_found_out() -> None:
    with emulated(length_mm=302.0) as (arm, trying):
        found = verify(arm, Follower(trying), Plan(1, 5, 300.0, 2), MADE)
    assert [test.error_mm for test in found.lengths] == pytest.approx([2.0, 2.0], abs=0.5)
    assert any("mm wrong" in fault for fault in found.faults(LIMITS))


@pytest.mark.slow
def test_a_ball_bar_is_measured_between_the_centres_of_its_spheres() -> None:
    with emulated(length_mm=302.0) as (arm, trying):
        person = Follower(trying)
        plan = Plan(1, 5, 300.0, 2, spheres=True)
        found = verify(arm, person, plan, MADE)
    assert len(person.steps) == 5 + 2 * 2 * len(ROUND)
    assert [test.error_mm for test in found.lengths] == pytest.approx([2.0, 2.0], abs=0.5)


def test_the_centre_of_a_sphere_is_that_of_an_optimiser() -> None:
    rng = np.random.default_rng(3)
    centre, outwards = np.array([330.0, -20.0, 170.0]), np.array([off for _, off in ROUND])
    points = centre + 19.05 * outwards + rng.normal(0.0, 0.1, outwards.shape)
    best = minimize(lambda x: np.ptp(np.linalg.norm(points - x, axis=1)) ** 2, centre, tol=1e-12)
    assert np.linalg.norm(sphere_centre(points) - centre) < 0.3
    assert np.linalg.norm(sphere_centre(points) - best.x) < 0.3
    assert sphere_centre(centre + 5.0 * outwards) == pytest.approx(centre, abs=1e-3)
