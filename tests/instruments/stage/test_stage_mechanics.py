"""What the carriage does that the controller can't know: stalls, lost steps, play, rails' ends,
power cuts; and faults of the line.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.errors import LinkError
from instruments.stage.emulator import Fault
from instruments.stage.emulator.carriage import AxisDrive
from tests.instruments.stage.board import LOCK, WELCOME, Board

Make = Callable[..., Board]


def test_a_stalled_carriage_stands_while_the_count_goes_on(free: Board) -> None:
    free.emulator.inject(Fault.STALL, 1.25)
    free.say(b"G1X-100F3000\n", 5.0)
    assert free.say(b"?").startswith(b"<Idle|MPos:-100.000,")
    assert free.emulator.position_mm()[0] == pytest.approx(-206.25)
    free.say(b"G1X-90F3000\n", 5.0)
    assert free.emulator.position_mm()[0] == pytest.approx(-196.25)
    free.answered_at(b"$H\n")
    assert free.emulator.position_mm() == pytest.approx([-1, -1, -1])


def test_lost_steps_part_carriage_and_count_until_homing(board: Board) -> None:
    board.answered_at(b"$H\n")
    board.emulator.lose_steps((-2.0, 0.0, 0.0))
    assert board.emulator.position_mm() == pytest.approx([-3, -1, -1])
    board.answered_at(b"$H\n")
    assert board.emulator.position_mm() == pytest.approx([-1, -1, -1])


def test_opening_the_port_again_resets_the_board_where_the_carriage_stands(board: Board) -> None:
    board.answered_at(b"$H\n")
    board.say(b"G53G1X-100F3000\n", 1.0)
    board.links[-1].close()
    assert board.plug_in() == WELCOME + LOCK
    assert b"MPos:0.000,0.000,0.000|" in board.say(b"?")
    assert -60 < board.emulator.position_mm()[0] < -40


def test_a_pulled_cable_ends_the_link_and_not_the_motion(free: Board) -> None:
    free.emulator.inject(Fault.DISCONNECT, 0.5)
    free.links[-1].write(b"G1X-50F3000\n")
    with pytest.raises(LinkError, match="hung up"):
        free.hear_until_broken()
    free.clock.sleep(5.0)
    # what was planned has run to its end
    assert free.emulator.position_mm()[0] == pytest.approx(-200.0)


def test_a_power_dip_in_motion_shows_as_a_welcome(free: Board) -> None:
    free.emulator.inject(Fault.RESTART, 0.5)
    assert free.say(b"G1X-50F3000\n", 2.0) == b"ok\r\n" + WELCOME + LOCK


def test_faulty_answers(free: Board) -> None:
    free.emulator.inject(Fault.LOST_OK)
    assert free.say(b"G21\n", 5.0) == b""
    free.emulator.inject(Fault.LATE_OK, 3.0)
    assert free.say(b"G21\n", 2.9) == b""
    assert free.hear(0.2) == b"ok\r\n"
    free.emulator.inject(Fault.GARBAGE)
    assert free.say(b"G21\n").endswith(b"\r\nok\r\n")
    free.emulator.inject(Fault.SILENT)
    assert free.say(b"?\nG21\n\x18", 5.0) == b""
    free.emulator.cure(Fault.SILENT)
    assert free.state() == b"Idle"


def test_a_lost_step_is_silent_and_stays_until_homing(board: Board) -> None:
    board.answered_at(b"$H\n")
    board.emulator.inject(Fault.LOST_STEP, lost_mm=0.8)
    board.say(b"G53G1X-101Y-11F3000\n", 5.0)
    assert b"MPos:-101.000,-11.000,-1.000|" in board.say(b"?")
    assert board.emulator.position_mm() == pytest.approx([-100.2, -11, -1])
    board.say(b"G53G1X-51Y-111\n", 5.0)
    assert board.emulator.position_mm() == pytest.approx([-50.2, -111, -1]), "lost once"
    board.answered_at(b"$H\n")
    assert board.emulator.position_mm() == pytest.approx([-1, -1, -1])


def test_lost_steps_are_lost_on_the_way_and_not_by_a_leap(board: Board) -> None:
    board.answered_at(b"$H\n")
    board.emulator.inject(Fault.LOST_STEP, lost_mm=5.0)
    board.say(b"G53G1X-101F600\n", 0.25)
    before = board.emulator.position_mm()[0]
    assert before == pytest.approx(-1.0), "of the first 2.25 mm not one was made"
    for _ in range(40):
        board.hear(0.1)
        now = board.emulator.position_mm()[0]
        assert 0 <= before - now <= 1.0 + 1e-6
        before = now


def test_a_lost_step_waits_for_a_motion_that_is_not_homing(board: Board) -> None:
    board.emulator.inject(Fault.LOST_STEP, lost_mm=2.0)
    board.answered_at(b"$H\n")
    assert board.emulator.position_mm() == pytest.approx([-1, -1, -1])
    board.say(b"G53G1Y-50F3000\n", 5.0)
    assert board.emulator.position_mm() == pytest.approx([-1, -48, -1])


def test_play_is_taken_up_after_each_reversal(make_board: Make) -> None:
    board = make_board(play_mm=(0.3, 0.1, 0.0))
    board.answered_at(b"$H\n")
    places = []
    for target in (
        b"X-50Y-50",
        b"X-100Y-20",
        b"X-60Y-20",
        b"X-60.2Y-20",
        b"X-60.4Y-20",
        b"X-80Y-60",
        b"X-79.8Y-60",
    ):
        board.say(b"G53G1" + target + b"F3000\n", 5.0)
        assert b"MPos:" + target[1:].replace(b"Y", b",")[:3] in board.say(b"?")
        places.append(tuple(board.emulator.position_mm()[:2].round(6).tolist()))
    # Homing ends by moving down, so that going down is exact and going up falls short by the play.
    assert places == [
        (-50, -50),
        (-100, -20.1),
        (-60.3, -20.1),
        (-60.3, -20.1),
        (-60.4, -20.1),
        (-80, -60),
        (-80, -60),
    ]


def test_play_of_an_axis_that_homes_to_its_far_end_is_on_the_other_side(make_board: Make) -> None:
    board = make_board({23: 1}, play_mm=(0.3, 0.0, 0.0))
    board.answered_at(b"$H\n")
    assert board.emulator.position_mm() == pytest.approx([-299, -1, -1])
    board.say(b"G53G1X-100F3000\n", 10.0)
    assert board.emulator.position_mm()[0] == pytest.approx(-100)
    board.say(b"G53G1X-150F3000\n", 10.0)
    assert board.emulator.position_mm()[0] == pytest.approx(-149.7)


def test_the_carriage_stops_at_the_rails_end_and_the_switch_tells(free: Board) -> None:
    free.links[-1].write(b"G1X200F3000\n")  # count 0 is 150 mm from the switch
    start = free.clock.now()
    said = free.links[-1].read_until(b"ALARM:1\r\n", 60.0)
    assert said == b"ok\r\nALARM:1\r\n"
    assert free.clock.now() - start == pytest.approx(150 / 50 + 50 / 400, abs=2e-3)
    assert free.emulator.position_mm()[0] == pytest.approx(0.0)


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
    st.lists(st.floats(-60, 60), min_size=1, max_size=30),
    st.floats(0, 2),
    st.booleans(),
    st.floats(-50, 0),
)
def test_a_drive_never_leaves_its_rails_or_its_play(
    counts: list[float], play: float, at_far_end: bool, place: float
) -> None:
    axis = AxisDrive(place, low=-50.0, high=0.0, play=play, at_far_end=at_far_end)
    for count in counts:
        before, was = axis.place, axis.count
        axis.follow(count)
        assert -50.0 <= axis.place <= 0.0
        low, high = (0.0, play) if at_far_end else (-play, 0.0)
        assert low - 1e-9 <= axis.place - axis.motor <= high + 1e-9
        assert abs(axis.place - before) <= abs(count - was) + 1e-9, (
            "the carriage never goes further than the count"
        )


@given(
    st.lists(st.floats(-40, 40), min_size=1, max_size=8),
    st.integers(2, 7),
    st.floats(0, 2),
    st.floats(0, 3),
)
def test_a_drive_fed_in_pieces_of_straight_lines_ends_the_same(
    ends: list[float], pieces: int, play: float, lost: float
) -> None:
    whole, cut = (AxisDrive(-25.0, low=-50.0, high=0.0, play=play, to_lose=lost) for _ in range(2))
    at = 0.0
    for end in ends:
        whole.follow(end)
        for piece in range(1, pieces + 1):
            cut.follow(at + (end - at) * piece / pieces)
        at = end
        assert cut.place == pytest.approx(whole.place, abs=1e-9)


def test_turns_that_nobody_watched_count_too(make_board: Make) -> None:
    board = make_board(play_mm=(0.3, 0.0, 0.0))
    board.answered_at(b"$H\n")
    board.say(b"G53G1X-50F3000\nG53G1X-40\nG4P0\n", 30.0)
    assert board.emulator.position_mm()[0] == pytest.approx(-40.3)


def test_a_switch_on_the_second_leg_closes_at_its_moment(free: Board) -> None:
    free.links[-1].write(b"G1X-50F3000\nG1X160\nG4P0\n")
    start = free.clock.now()
    free.links[-1].read_until(b"ALARM:1\r\n", 60.0)
    assert free.clock.now() - start == pytest.approx(
        (50 / 50 + 0.25) + (200 / 50 + 0.125), abs=2e-3
    )
    assert free.emulator.position_mm()[0] == pytest.approx(0.0)
