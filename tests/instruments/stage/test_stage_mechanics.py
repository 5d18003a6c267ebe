"""The emulator's motion over time, and what the carriage does that the controller can't know: stalls, lost
steps, play, rails' ends, power cuts. And the plate's pose for a place of the carriage. Expected figures are
worked out by hand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.stage.emulator.board import StageFault
from instruments.stage.emulator.carriage import AxisDrive, Mounting
from instruments.stage.emulator.gcode import GCode, StraightMove
from instruments.stage.emulator.motion import (
    AxisRates,
    CountedMotion,
    LinearMove,
    MoveSegment,
    Vector,
)
from tests.instruments.stage.board import LOCK, WELCOME, Board

RATES = AxisRates((50.0, 50.0, 50.0), (200.0, 200.0, 200.0))
PLACES = st.tuples(st.floats(-300, 0), st.floats(-275, 0), st.floats(-50, 0))


@given(st.floats(1e-3, 500), st.floats(0, 1), st.floats(1, 80), st.floats(10, 1000))
def test_a_run_covers_its_length_and_ends_at_rest(
    length: float, entry: float, speed: float, accel: float
) -> None:
    entry *= math.sqrt(2 * accel * length)  # from which it can still stop
    move = LinearMove((0.0,), (length,), length, None, speed, accel)
    run = MoveSegment(move, 0.0, length, 0.0, speed, entry)
    assert run.at(0.0) == pytest.approx((0.0, entry))
    almost = run.at(run.end_s - 1e-6)
    assert almost == pytest.approx((length, 0.0), abs=1e-6 * (accel + entry + 1))
    steps = [run.at(run.end_s * n / 50) for n in range(51)]
    for (place, fast), (further, _) in itertools.pairwise(steps):
        assert further >= place - 1e-9
        assert fast <= max(speed, entry) + 1e-9


@given(
    st.lists(st.tuples(PLACES, st.floats(1, 60)), min_size=1, max_size=6),
    st.lists(st.tuples(st.floats(0.01, 2.0), st.sampled_from((10, 100, 200))), max_size=5),
)
def test_any_path_with_any_holds_and_overrides_is_smooth_and_ends_at_its_target(
    moves: list[tuple[Vector, float]], holds: list[tuple[float, int]]
) -> None:
    motion, now = CountedMotion((-1.0, -1.0, -1.0)), 0.0
    for target, feed in moves:
        motion.go(target, feed, RATES, now)
    for run, percent in holds:
        before = motion.position(now + run - 1e-6)
        assert math.dist(before, motion.position(now + run)) <= 1e-6 * 50 * math.sqrt(3) + 1e-9
        now += run
        motion.override(percent, 100, now)
        motion.hold(now)
        assert (
            math.dist(motion.position(now), motion.position(now + 1e-6))
            <= 1e-6 * 50 * math.sqrt(3) + 1e-9
        )
        now += 1.0  # 87 mm/s at 200 mm/s² stand within 0.44 s
        assert not motion.moving(now)
        motion.resume(now)
    assert motion.position(now + 36000) == moves[-1][0]
    assert motion.left(now + 36000) == ()


Make = Callable[..., Board]


def test_homing_takes_what_its_runs_take_axis_by_axis(board: Board) -> None:
    def seek(way: float) -> float:  # at 25 mm/s, 200 mm/s²
        return way / 25 + 25 / 200

    off = 2 * math.sqrt(1 / 200)
    creep = 1 / (100 / 60) + (100 / 60) / 200
    ways_s = seek(25) + seek(150) + seek(137.5)
    assert board.answered_at(b"$H\n") == pytest.approx(
        ways_s + 3 * (2 * off + creep + 4 * 0.25), abs=1e-6
    )
    assert board.emulator.position_mm() == pytest.approx([-1, -1, -1])


@pytest.mark.parametrize("far", [0, 1, 3, 7])
def test_homing_ends_at_the_pull_off_from_anywhere(make_board: Make, far: int) -> None:
    board = make_board({23: far}, play_mm=(0.3, 0.1, 0.0))
    home = [-299 if far & 1 else -1, -274 if far & 2 else -1, -49 if far & 4 else -1]
    for _ in range(2):
        board.answered_at(b"$H\n")
        assert board.emulator.position_mm() == pytest.approx(home)
        board.say(b"G53G1X-37Y-270Z-3F3000\n", 30.0)


def test_a_stalled_carriage_stands_while_the_count_goes_on(free: Board) -> None:
    free.emulator.inject(StageFault.STALL, 1.25)
    free.say(b"G1X-100F3000\n", 5.0)
    assert free.say(b"?").startswith(b"<Idle|MPos:-100.000,")
    assert free.emulator.position_mm()[0] == pytest.approx(-206.25)
    free.say(b"G1X-90F3000\n", 5.0)
    assert free.emulator.position_mm()[0] == pytest.approx(-196.25)
    free.answered_at(b"$H\n")
    assert free.emulator.position_mm() == pytest.approx([-1, -1, -1])


def test_opening_the_port_again_resets_the_board_where_the_carriage_stands(board: Board) -> None:
    board.answered_at(b"$H\n")
    board.say(b"G53G1X-100F3000\n", 1.0)
    board.unplug()
    assert board.plug_in() == WELCOME + LOCK
    assert b"MPos:0.000,0.000,0.000|" in board.say(b"?")
    assert -60 < board.emulator.position_mm()[0] < -40


def test_lost_steps_wait_for_a_motion_that_is_not_homing_and_stay_until_the_next(
    board: Board,
) -> None:
    board.emulator.inject(StageFault.LOST_STEP, lost_mm=0.8)
    board.answered_at(b"$H\n")
    assert board.emulator.position_mm() == pytest.approx([-1, -1, -1])
    board.say(b"G53G1X-101Y-11F3000\n", 5.0)
    assert b"MPos:-101.000,-11.000,-1.000|" in board.say(b"?")
    assert board.emulator.position_mm() == pytest.approx([-100.2, -11, -1])
    board.say(b"G53G1X-51Y-111\n", 5.0)
    assert board.emulator.position_mm() == pytest.approx([-50.2, -111, -1]), "lost once"
    board.answered_at(b"$H\n")
    assert board.emulator.position_mm() == pytest.approx([-1, -1, -1])


def test_lost_steps_are_lost_on_the_way_and_not_by_a_leap(board: Board) -> None:
    board.answered_at(b"$H\n")
    board.emulator.inject(StageFault.LOST_STEP, lost_mm=5.0)
    board.say(b"G53G1X-101F600\n", 0.25)
    before = board.emulator.position_mm()[0]
    assert before == pytest.approx(-1.0), "of the first 2.25 mm not one was made"
    for _ in range(40):
        board.hear(0.1)
        now = board.emulator.position_mm()[0]
        assert 0 <= before - now <= 1.0 + 1e-6
        before = now


def test_play_is_taken_up_after_each_reversal(make_board: Make) -> None:
    board = make_board(play_mm=(0.3, 0.1, 0.0))
    board.answered_at(b"$H\n")
    # homing ends by moving down, so that going down is exact and going up falls short by the play
    for target, place in (
        (b"X-50Y-50", (-50, -50)),
        (b"X-100Y-20", (-100, -20.1)),
        (b"X-60Y-20", (-60.3, -20.1)),
        (b"X-60.2Y-20", (-60.3, -20.1)),
        (b"X-60.4Y-20", (-60.4, -20.1)),
        (b"X-80Y-60", (-80, -60)),
        (b"X-79.8Y-60", (-80, -60)),
    ):
        board.say(b"G53G1" + target + b"F3000\n", 5.0)
        assert b"MPos:" + target[1:].replace(b"Y", b",")[:3] in board.say(b"?")
        assert board.emulator.position_mm()[:2] == pytest.approx(place, abs=1e-6)


@pytest.mark.parametrize(
    "lines", [b"G1X200F3000\n", b"G1X-50F3000\nG1X160\nG4P0\n"], ids=["at once", "second leg"]
)
def test_a_switch_at_the_rails_end_is_noticed_with_the_next_report(
    free: Board, lines: bytes
) -> None:
    said = free.say(lines)
    while b"ALARM" not in said and free.clock.now() < 60:
        said += free.say(b"?", 0.2)
    assert free.emulator.position_mm()[0] == pytest.approx(0.0)
    assert said.endswith(b"ALARM:1\r\n[MSG:Reset to continue]\r\n")
    count = float(said.split(b"MPos:")[-1].split(b",")[0])
    assert 140 < count < 150, "the last one before it was hit, 150 mm from where it started"
    assert b"|Pn:X|" in free.say(b"\x18?")


def test_at_the_end_without_a_switch_the_motor_loses_its_steps(free: Board) -> None:
    assert free.say(b"G1X-200F3000\nG4P0\n", 10.0) == b"ok\r\nok\r\n"
    assert free.emulator.position_mm()[0] == pytest.approx(-300.0)
    free.say(b"G1X-190\n", 5.0)
    assert free.emulator.position_mm()[0] == pytest.approx(-290.0)


def test_without_hard_limits_the_switch_says_nothing(make_board: Make) -> None:
    board = make_board({20: 0, 21: 0})
    board.unlock()
    assert board.say(b"G1X200F3000\nG4P0\n", 10.0) == b"ok\r\nok\r\n"
    assert board.emulator.position_mm()[0] == pytest.approx(0.0)


@given(
    st.lists(st.floats(-40, 40), min_size=1, max_size=8),
    st.integers(2, 7),
    st.floats(0, 2),
    st.floats(0, 3),
)
def test_a_drive_fed_in_pieces_of_straight_lines_ends_the_same(
    ends: list[float], pieces: int, play: float, lost: float
) -> None:
    whole, cut = (AxisDrive(-25.0, low=-50.0, play=play, to_lose=lost) for _ in range(2))
    at = 0.0
    for end in ends:
        whole.follow(end)
        for piece in range(1, pieces + 1):
            cut.follow(at + (end - at) * piece / pieces)
        at = end
        assert cut.place == pytest.approx(whole.place, abs=1e-9)


TRUE = Mounting("XYZA", (-150.0, -137.5, -50.0, -180.0))


CROOKED = replace(TRUE, scale_errors=(0.01, -0.01, 0.02, 0.03), squareness_rad=0.01, yaw_rad=-0.02)
SCALED = replace(TRUE, scale_errors=(0.01, -0.02, 0.1, 0.001))
REFERENCE = (-150.0, -137.5, -50.0, -180.0)


@pytest.mark.parametrize(
    ("mounting", "place", "pose"),
    [
        (TRUE, REFERENCE, (0, 0, 0, 0)),
        (CROOKED, REFERENCE, (0, 0, 0, 0)),
        (TRUE, (-140.0, -150.0, -30.0, -90.0), (10, -12.5, 20, math.pi / 2)),
        # axes that are not declared carry nothing
        (replace(TRUE, axes="XY"), (-140.0, -137.5, -1.0), (10, 0, 0, 0)),
        (replace(TRUE, axes="XYA"), (-140.0, -137.5, -1.0, -181.0), (10, 0, 0, -math.radians(1))),
        # below its reference the plate rests on the table
        (TRUE, (-150.0, -137.5, -50.1, -180.0), (0, 0, 0, 0)),
        (SCALED, (-50.0, -37.5, -40.0, -80.0), (101, 98, 11, math.radians(100.1))),
        (
            replace(TRUE, squareness_rad=0.01),
            (-50.0, -37.5, -50.0, -180.0),
            (100 - 100 * math.sin(0.01), 100 * math.cos(0.01), 0, 0),
        ),
        (
            replace(TRUE, yaw_rad=0.1),
            (-50.0, -137.5, -50.0, -180.0),
            (100 * math.cos(0.1), 100 * math.sin(0.1), 0, 0),
        ),
        (
            replace(SCALED, squareness_rad=0.02, yaw_rad=0.1),
            (-50.0, -37.5, -50.0, -180.0),
            (
                101 * math.cos(0.1) - 98 * math.sin(0.12),
                101 * math.sin(0.1) + 98 * math.cos(0.12),
                0,
                0,
            ),
        ),
    ],
)
def test_the_plates_pose_by_hand(
    mounting: Mounting, place: tuple[float, ...], pose: tuple[float, float, float, float]
) -> None:
    got = mounting.pose(place)
    assert (got.x_mm, got.y_mm, got.z_mm, got.yaw_rad) == pytest.approx(pose, abs=1e-12)


@pytest.mark.parametrize(
    ("line", "centre", "radius", "turn_deg"),
    [
        ("G2X1Y1I1F500", (1.0, 0.0), 1.0, -90.0),
        ("G3X1Y1I1F500", (1.0, 0.0), 1.0, 270.0),
        ("G3X1Y1J1F500", (0.0, 1.0), 1.0, 90.0),
        ("G2X2Y0R1F500", (1.0, 0.0), 1.0, -180.0),
        ("G2X1Y1R-1F500", (0.0, 1.0), 1.0, -270.0),
        ("G3X1Y1R1F500", (0.0, 1.0), 1.0, 90.0),
        ("G2X0Y0I3F500", (3.0, 0.0), 3.0, -360.0),
    ],
)
def test_an_arc_goes_round_its_centre(
    line: str, centre: tuple[float, float], radius: float, turn_deg: float
) -> None:
    """Signs by hand: G2 is clockwise, and a negative R is the longer way round."""
    places = [
        one.target_mm for one in GCode("XYZ", 1e7).take(line) if isinstance(one, StraightMove)
    ]
    ways = [(x - centre[0], y - centre[1]) for x, y, _ in [(0.0, 0.0, 0.0), *places]]
    assert [math.hypot(*way) for way in ways] == pytest.approx([radius] * len(ways))
    angles = [math.degrees(math.atan2(y, x)) for x, y in ways]
    turns = [(after - at + 180) % 360 - 180 for at, after in itertools.pairwise(angles)]
    assert sum(turns) == pytest.approx(turn_deg)
    assert max(map(abs, turns)) <= 10 + 1e-9
