"""The emulator's motion over time: profiles, corners, holds, homing. Expected figures are worked
out by hand.
"""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.stage.emulator.motion import (
    AxisRates,
    HomingRun,
    Motion,
    Switch,
    Vector,
    junction_speed,
    lay,
    profile,
)
from instruments.stage.emulator.store import Store

RATES = AxisRates((50.0, 50.0, 50.0), (200.0, 200.0, 200.0), 0.01)
PLACES = st.tuples(st.floats(-300, 0), st.floats(-275, 0), st.floats(-50, 0))


def test_a_long_move_takes_length_over_speed_and_speed_over_acceleration() -> None:
    motion = Motion((0.0, 0.0, 0.0))
    motion.go((-100.0, 0.0, 0.0), 50.0, RATES, 0.0)
    assert motion.next_end_s(0.0) == pytest.approx(100 / 50 + 50 / 200, abs=1e-12)
    assert motion.position(0.25) == pytest.approx((-6.25, 0, 0))
    assert motion.position(1.25) == pytest.approx((-56.25, 0, 0))
    assert motion.speed(1.0) == pytest.approx(50.0)
    assert motion.position(2.25) == (-100.0, 0.0, 0.0)
    assert not motion.moving(2.25)


def test_a_short_move_never_reaches_its_speed() -> None:
    motion = Motion((0.0, 0.0, 0.0))
    motion.go((0.0, -2.0, 0.0), 50.0, RATES, 5.0)
    assert motion.next_end_s(5.0) - 5.0 == pytest.approx(2 * math.sqrt(2 / 200), abs=1e-12)
    assert motion.speed(5.1) == pytest.approx(20.0)


def test_a_diagonal_move_is_as_fast_as_its_slowest_axis_allows() -> None:
    motion = Motion((0.0, 0.0, 0.0))
    motion.go((-100.0, -100.0, 0.0), None, RATES, 0.0)
    assert motion.speed(1.0) == pytest.approx(50 * math.sqrt(2))


@given(
    st.floats(1e-3, 500),
    st.floats(0, 50),
    st.floats(1, 80),
    st.floats(10, 1000),
)
def test_a_profile_covers_its_length_and_joins_without_steps(
    length: float, entry: float, cruise: float, accel: float
) -> None:
    phases = lay(profile(length, entry, cruise, 0.0, accel), 0.0)
    last = phases[-1]
    assert last.place_mm(last.end_s) == pytest.approx(length, rel=1e-9, abs=1e-9)
    assert last.speed_at(last.end_s) == pytest.approx(0.0, abs=1e-5)
    assert phases[0].speed_mm_s == entry
    for before, after in itertools.pairwise(phases):
        assert before.speed_at(before.end_s) == pytest.approx(after.speed_mm_s, abs=1e-6)


def test_the_speed_at_a_right_angle() -> None:
    # accel 200·√2 along the bisector, deviation 0.01 mm, sin 45°/(1 - sin 45°) = 2.41421
    expected = math.sqrt(200 * math.sqrt(2) * 0.01 * 2.414213562)
    assert junction_speed((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), RATES) == pytest.approx(
        expected, rel=1e-6
    )
    assert junction_speed((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), RATES) == 0.0
    assert junction_speed((1.0, 0.0, 0.0), (1.0, 0.0, 0.0), RATES) == math.inf


def test_a_straight_line_in_two_blocks_takes_as_long_as_in_one() -> None:
    one, two = Motion((0.0, 0.0, 0.0)), Motion((0.0, 0.0, 0.0))
    one.go((-100.0, 0.0, 0.0), 50.0, RATES, 0.0)
    two.go((-40.0, 0.0, 0.0), 50.0, RATES, 0.0)
    two.go((-100.0, 0.0, 0.0), 50.0, RATES, 0.3)
    for moment in (0.3, 0.5, 0.9, 1.7, 2.2):
        assert two.position(moment) == pytest.approx(one.position(moment), abs=1e-9)


def test_a_hold_brakes_within_v_squared_over_2a_and_the_rest_follows_after_it() -> None:
    motion = Motion((0.0, 0.0, 0.0))
    motion.go((-100.0, 0.0, 0.0), 50.0, RATES, 0.0)
    motion.hold(1.25)
    assert motion.moving(1.49)
    assert not motion.moving(1.5)
    assert motion.position(9.0) == pytest.approx((-56.25 - 6.25, 0, 0))
    assert motion.target == (-100.0, 0.0, 0.0)
    assert len(motion.blocks(9.0)) == 1
    motion.resume(10.0)
    assert motion.next_end_s(10.0) == pytest.approx(10 + 37.5 / 50 + 0.25)
    assert motion.position(12.0) == (-100.0, 0.0, 0.0)


def test_a_hold_brakes_across_blocks() -> None:
    motion = Motion((0.0, 0.0, 0.0))
    for end in (-50.0, -51.0, -52.0, -100.0):
        motion.go((end, 0.0, 0.0), 50.0, RATES, 0.0)
    # at 43.75 mm with 50 mm/s: stands 6.25 mm further on, at the first block's end
    motion.hold(1.0)
    assert motion.position(5.0) == pytest.approx((-50.0, 0, 0))
    motion.resume(5.0)
    motion.hold(5.15)
    motion.resume(6.0)
    assert motion.position(20.0) == (-100.0, 0.0, 0.0)


@given(
    st.lists(st.tuples(PLACES, st.floats(1, 60)), min_size=1, max_size=6),
    st.lists(st.floats(0.01, 2.0), max_size=5),
)
def test_any_path_with_any_holds_is_smooth_and_ends_at_its_target(
    moves: list[tuple[Vector, float]], holds: list[float]
) -> None:
    motion, now = Motion((-1.0, -1.0, -1.0)), 0.0
    for target, feed in moves:
        motion.go(target, feed, RATES, now)
    for run in holds:
        before = motion.position(now + run - 1e-6)
        assert math.dist(before, motion.position(now + run)) <= 1e-6 * 50 * math.sqrt(3) + 1e-9
        now += run
        motion.hold(now)
        assert (
            math.dist(motion.position(now), motion.position(now + 1e-6))
            <= 1e-6 * 50 * math.sqrt(3) + 1e-9
        )
        now += 1.0  # 87 mm/s at 200 mm/s² stand within 0.44 s
        assert not motion.moving(now)
        motion.resume(now)
    assert motion.position(now + 3600) == moves[-1][0]
    assert motion.blocks(now + 3600) == ()


def test_an_override_changes_the_speed_on_the_way() -> None:
    motion = Motion((0.0, 0.0, 0.0))
    motion.go((-100.0, 0.0, 0.0), 50.0, RATES, 0.0)
    motion.override(10, 100, 1.0)
    assert motion.speed(2.0) == pytest.approx(5.0)
    assert motion.position(60.0) == (-100.0, 0.0, 0.0)


def test_homing_takes_what_its_runs_take() -> None:
    store = Store({25: 1500, 24: 100, 26: 250, 27: 1})
    run = HomingRun((-150.0, -100.0, -25.0), store.homing, {})

    def seek(way: float) -> float:  # to a dead stop at 25 mm/s, 200 mm/s²
        return way / 25 + 25 / (2 * 200)

    off = 2 * math.sqrt(1 / 200)
    creep = 1 / (100 / 60) + (100 / 60) / (2 * 200)
    expected = seek(25) + seek(150) + 2 * (2 * off + creep) + 8 * 0.25
    assert run.end_s == pytest.approx(expected, abs=1e-9)
    assert run.position(run.end_s) == pytest.approx((-1.0, -1.0, -1.0))
    assert run.position(0.0) == (-150.0, -100.0, -25.0)
    assert run.alarm is None


def test_homing_to_the_far_end() -> None:
    run = HomingRun((-150.0, -100.0, -25.0), Store({23: 1}).homing, {})
    assert run.position(run.end_s) == pytest.approx((-299.0, -1.0, -1.0))


@pytest.mark.parametrize(("switch", "alarm"), [(Switch.MISSING, 9), (Switch.STUCK, 8)])
def test_a_broken_switch_ends_homing_in_its_alarm(switch: Switch, alarm: int) -> None:
    run = HomingRun((-150.0, -100.0, -25.0), Store().homing, {0: switch})
    assert run.alarm == alarm
    assert all(place <= 1e-9 for place in run.position(run.end_s))


@given(PLACES)
def test_homing_ends_at_the_pull_off_from_anywhere(start: Vector) -> None:
    run = HomingRun(start, Store().homing, {})
    assert run.alarm is None
    assert run.position(run.end_s) == pytest.approx((-1.0, -1.0, -1.0), abs=1e-9)
