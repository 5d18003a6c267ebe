"""The table frame: what was put in is found, what can't be one is refused, and its uncertainty is
what it shows.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.calibrate.arm import touch_frame
from bench.calibrate.simulated_arm import PLACED, Step
from bench.rig.arm_files import FrameError, TableFrame, TouchedPoint, Triple, world_from_arm
from detector.geometry import Motion
from tests.bench.calibrate.arm_rig import MADE, Follower, emulated

WORLD = np.array([[0.0, 0.0, 0.0], [310.0, 0.0, 0.0], [-80.0, 240.0, 0.0]])
NAMES = ("origin", "x axis", "plane")

rotation = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
place = st.tuples(*[st.floats(-900.0, 900.0)] * 3)


def frame_of(arm_mm: np.ndarray, *checks: TouchedPoint) -> TableFrame:
    points = [
        TouchedPoint(name, (float(p[0]), float(p[1]), float(p[2])))
        for name, p in zip(NAMES, arm_mm, strict=True)
    ]
    return TableFrame.from_touches(MADE, "40937", [*points, *checks])


@given(rotation, place)
def test_exact_touches_give_the_motion_back(om: Triple, T: Triple) -> None:
    put_in = Motion.from_vectors(om, T)
    found = world_from_arm(put_in.inverse().apply(WORLD))
    assert np.allclose(found.R, put_in.R, atol=1e-9)
    assert np.allclose(found.T, put_in.T, atol=1e-6)


@pytest.mark.parametrize(
    ("touched", "sentence"),
    [
        (
            [[0, 0, 0], [99, 0, 0], [0, 200, 0]],
            "the touch on the x axis is 99.0 mm from the origin; 100 mm are needed",
        ),
        (
            [[0, 0, 0], [300, 0, 0], [200, 99, 0]],
            "the third touch is 99.0 mm from the x axis, so the three are nearly in a line",
        ),
        ([[0, 0, 0], [300, 0, 0], [600, 0, 0]], "nearly in a line"),
        ([[0, 0, 0], [0, 0, 0], [0, 200, 0]], "0.0 mm from the origin"),
        ([[0, 0, 0], [300, 0, 0], [float("nan"), 0, 0]], "three points in space"),
        ([[0, 0, 0], [300, 0, 0]], "three points in space"),
    ],
)
def test_what_gives_no_frame_is_refused_with_a_sentence(
    touched: list[list[float]], sentence: str
) -> None:
    with pytest.raises(FrameError, match=sentence.replace("(", r"\(")):
        world_from_arm(touched)


def test_fewer_than_three_touches_and_names_given_twice_are_refused() -> None:
    origin = TouchedPoint("origin", (0.0, 0.0, 0.0))
    with pytest.raises(FrameError, match="three touches"):
        TableFrame.from_touches(MADE, "1", [origin])
    with pytest.raises(FrameError, match="same name"):
        TableFrame.from_touches(
            MADE, "1", [origin, dataclasses.replace(origin, name="x axis"), origin]
        )


def test_residuals_are_distances_from_the_plane_or_from_the_known_place() -> None:
    arm_from_world = PLACED.inverse()

    def touched(name: str, at: Triple, known: Triple | None) -> TouchedPoint:
        x, y, z = arm_from_world.apply(at)
        return TouchedPoint(name, (float(x), float(y), float(z)), 0.1, known)

    frame = frame_of(
        arm_from_world.apply(WORLD),
        touched("flat", (77.0, -30.0, -0.8), None),
        touched("known", (100.0, 103.0, 4.0), (100.0, 100.0, 0.0)),
    )
    assert frame.residuals_mm == pytest.approx({"flat": 0.8, "known": 5.0})
    assert frame.residual_mm == pytest.approx(5.0)
    assert frame_of(arm_from_world.apply(WORLD)).residual_mm is None


@pytest.mark.slow
@pytest.mark.parametrize("target", [(0.0, 0.0, 0.0), (150.0, 80.0, 0.0), (-190.0, 240.0, 135.0)])
def test_the_registration_uncertainty_is_the_spread_over_many_frames(target: Triple) -> None:
    """Against a simulation that knows nothing of derivatives."""
    chance = np.random.default_rng(7)
    seen = PLACED.inverse().apply(target)
    exact = PLACED.inverse().apply(WORLD)
    found = np.array(
        [world_from_arm(exact + chance.normal(0.0, 0.23, (3, 3))).apply(seen) for _ in range(4000)]
    )
    spread = float(np.sqrt(np.mean(np.var(found, axis=0))))
    assert frame_of(exact).u_registration_mm(target, 0.23) == pytest.approx(spread, rel=0.05)


@pytest.mark.slow
def test_frames_put_in_are_found_within_the_arms_noise() -> None:
    """Over seeds and places: at the teats, the frame that was touched is off by no more than its
    own uncertainty says.
    """
    chance = np.random.default_rng(3)
    off, u = [], []
    for seed in range(12):
        yaw, x, y = (
            chance.uniform(-0.6, 0.9),
            chance.uniform(60.0, 220.0),
            chance.uniform(-200.0, -80.0),
        )
        put_in = Motion.from_vectors((0.02, -0.01, yaw), (x, y, 8.0))
        with emulated(seed=seed, placed=put_in) as (arm, trying):
            frame = touch_frame(arm, Follower(trying), [None], MADE)
        teat = put_in.inverse().apply([100.0, 120.0, 100.0])
        off.append(frame.world_from_arm.apply(teat) - np.array([100.0, 120.0, 100.0]))
        u.append(frame.u_registration_mm([100.0, 120.0, 100.0], 0.23))
        assert frame.residual_mm is not None
        assert frame.residual_mm < 1.0
        assert frame.serial_number == "40937"
    errors = np.array(off)
    assert np.abs(errors).max() < 3.0 * max(u)
    assert np.sqrt(np.mean(errors**2)) < 1.5 * float(np.mean(u))
    assert np.abs(errors).max() > 0.01, "the noise is there"


def test_points_too_near_are_asked_for_again() -> None:
    """The second and third touch are asked for once more, and the frame is right then."""
    with emulated() as (arm, trying):
        slips = iter([True])

        def instead(step: Step) -> Step:
            return (
                dataclasses.replace(step, what="origin")
                if step.what == "x axis" and next(slips, False)
                else step
            )

        person = Follower(trying, instead)
        frame = touch_frame(arm, person, [], MADE)
    assert [step.what for step in person.steps] == ["origin", "x axis", "plane", "x axis", "plane"]
    assert any("from the origin; 100 mm are needed" in text for text in person.said)
    assert np.allclose(frame.world_from_arm.T, PLACED.T, atol=1.0)


def test_a_moving_arm_is_read_again() -> None:
    with emulated() as (arm, trying):
        moves = iter([True])
        read = arm.read

        def unsteady(n: int = 8, max_spread_mm: float = 1.0) -> object:
            return read(n, max_spread_mm=1e-6 if next(moves, False) else max_spread_mm)

        arm.read = unsteady  # type: ignore[method-assign, assignment]
        person = Follower(trying)
        touch_frame(arm, person, [], MADE)
    assert [step.what for step in person.steps] == ["origin", "origin", "x axis", "plane"]
    assert any("the arm moves" in text for text in person.said)


def test_a_frame_that_turned_over_is_asked_about() -> None:
    with emulated() as (arm, trying):

        def instead(step: Step) -> Step:
            return (
                dataclasses.replace(step, what="check", world_mm=(100.0, -110.0, 0.0))
                if step.what == "plane"
                else step
            )

        person = Follower(trying, instead)
        frame = touch_frame(arm, person, [], MADE)
    assert frame.hangs
    assert any("upside down" in text for text in person.said)
