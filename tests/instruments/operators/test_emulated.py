"""Emulated hands: errors of the size that was asked for, the same for the same seed, and mistakes
once each when told.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from instruments.operators import operator as op
from instruments.operators.emulated import SHOWN, BoardHands, EmulatedOperator, Mistake
from instruments.world.boards import Pattern
from instruments.world.phantom import PIVOT_MM, PlatePose
from instruments.world.situations import situation
from instruments.world.world import World
from tests.instruments.operators.people import arrangement, hands, world

ERROR_MM, ERROR_RAD = 2.0, 0.02


def tip(of: World) -> np.ndarray:
    held = of.arm_target()
    assert held is not None
    return held[0]


def turn_and_shift(of: World) -> tuple[float, float, float]:
    """How the phantom of table 5.1 stands against its layout, told from its ends alone: shift of
    the pivot in mm, turn in rad.
    """
    pivot = np.array([*PIVOT_MM, 0.0])
    wanted, found = arrangement().phantom.ends_mm - pivot, of.ends_mm() - pivot
    turn, _ = Rotation.align_vectors(found - found.mean(axis=0), wanted - wanted.mean(axis=0))
    x, y, _ = found.mean(axis=0) - turn.apply(wanted.mean(axis=0))
    return float(x), float(y), float(turn.as_rotvec()[2])


@pytest.mark.weekly
def test_placement_errors_have_the_spread_that_was_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    here = world()
    who = hands(here, placement_error_mm=ERROR_MM, placement_error_rad=ERROR_RAD)
    # drawn 400 times it takes a minute
    monkeypatch.setattr(here.renderer, "visible_ends", lambda _: np.ones((4, 3), dtype=bool))
    errors = []
    for n in range(400):
        # it only errs where it moves something
        who.ask(arrangement(pose=PlatePose(float(n % 2), 0.0)))
        x, y, yaw = turn_and_shift(here)
        errors.append((x - n % 2, y, yaw))
    spread = np.std(errors, axis=0)
    assert spread == pytest.approx([ERROR_MM, ERROR_MM, ERROR_RAD], rel=0.12)
    assert np.abs(np.mean(errors, axis=0)) == pytest.approx(np.zeros(3), abs=4 * ERROR_MM / 20)
    assert np.abs(np.corrcoef(np.transpose(errors)) - np.eye(3)).max() < 0.2


@pytest.mark.slow
def test_what_stands_as_asked_is_not_touched_again() -> None:
    here = world()
    who = hands(here, placement_error_mm=ERROR_MM)
    who.ask(arrangement())
    before = here.ends_mm()
    who.ask(arrangement())
    assert (here.ends_mm() == before).all()
    who.ask(arrangement("overlapping"))
    who.ask(arrangement())
    assert (here.ends_mm() != before).any()


@pytest.mark.slow
def test_touches_scatter_by_the_hand_s_error() -> None:
    here = world()
    who = hands(here, hand_error_mm=0.3)
    who.ask(arrangement())
    touched = []
    for _ in range(400):
        who.ask(op.Touch(2, 4))
        touched.append(tip(here) - here.ends_mm()[1])
    assert np.std(touched, axis=0) == pytest.approx([0.3] * 3, rel=0.12)
    assert np.mean(touched, axis=0) == pytest.approx(np.zeros(3), abs=0.06)


def touched_teats(who: EmulatedOperator, here: World, teats: list[int]) -> list[int]:
    """Which teat the tip is at after each touch that is asked for."""
    at = []
    for teat in teats:
        who.ask(op.Touch(teat, 4))
        at.append(int(np.linalg.norm(here.ends_mm() - tip(here), axis=1).argmin()) + 1)
    return at


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mistakes", "touched"),
    [
        ((), [1, 2, 3, 4, 2, 4]),
        (("wrong teat",), [1, 3, 3, 4, 2, 4]),
        (("forgotten teat",), [1, 1, 3, 4, 2, 4]),
        (("forgotten teat", "wrong teat"), [1, 1, 4, 4, 2, 4]),
        (("wrong teat", "wrong teat"), [1, 3, 4, 4, 2, 4]),
    ],
)
def test_a_mistake_is_made_once(mistakes: tuple[Mistake, ...], touched: list[int]) -> None:
    here = world()
    who = hands(here, mistakes=mistakes)
    who.ask(arrangement())
    assert touched_teats(who, here, [1, 2, 3, 4, 2, 4]) == touched


def test_a_forgotten_move_leaves_the_plate_and_the_next_one_is_done() -> None:
    here = world()
    who = hands(here, mistakes=("forgotten move",))
    who.ask(arrangement())
    home = here.ends_mm()
    who.ask(arrangement(pose=PlatePose(20.0, 0.0)))
    assert (here.ends_mm() == home).all()
    who.ask(arrangement(pose=PlatePose(20.0, 0.0)))
    assert here.ends_mm() - home == pytest.approx(np.array([[20.0, 0.0, 0.0]] * 4), abs=1e-9)


def test_a_prompt_takes_its_time_and_the_interlocks_are_looked_at_meanwhile() -> None:
    here = world()
    who = hands(here, prompt_s=7.5)
    looked: list[float] = []
    who.ask(arrangement(), lambda: looked.append(here.clock.now()))
    assert here.clock.now() == pytest.approx(7.5)
    assert max(np.diff(looked)) <= 1.0

    def tripped() -> None:
        if here.clock.now() >= 10.0:
            raise RuntimeError("tripped")

    with pytest.raises(RuntimeError, match="tripped"):
        who.ask(op.Touch(1, 4), tripped)
    assert here.clock.now() == pytest.approx(10.5)
    assert here.arm_target() is None, "the hand had not got there yet"


def test_hands_without_a_check_point_or_a_board_say_so() -> None:
    with pytest.raises(ValueError, match="give it check_point_mm"):
        EmulatedOperator(world(), hand_error_mm=0.1).ask(op.CheckPoint(1, 5))
    with pytest.raises(ValueError, match="holds no board"):
        hands(world()).ask(op.BoardTouch(0, "Touch it."))


@pytest.mark.parametrize(
    ("wanted", "stop", "what"),
    [
        (op.Touch(2, 4), op.OperatorSkip, "the end of teat 2"),
        (op.CheckPoint(1, 5), op.OperatorAbort, "the check point"),
        (op.BoardTouch(0, "Touch it."), op.OperatorAbort, "the board"),
    ],
)
def test_where_the_arm_does_not_get_there_hands_let_go_and_name_the_place(
    wanted: op.Request, stop: type[Exception], what: str
) -> None:
    here = world()
    who = hands(here)
    who.ask(FIXED)
    who.ask(wanted)
    at = np.round(tip(here)).astype(int).tolist()
    who.way = lambda _, axis: None
    with pytest.raises(stop) as said:
        who.ask(wanted)
    assert f"the arm doesn't reach {what} at {at} mm. Have it nearer" in str(said.value)
    assert here.arm_target() is None


@pytest.mark.slow
@pytest.mark.parametrize("member", [16069, 16000])
def test_a_scene_is_lit_less_where_too_much_of_a_picture_would_be_white(member: int) -> None:
    here, sent = world(), situation("non_vertical", member)
    hands(here).ask(op.Arrangement(sent.name, sent.phantom, (), "Set it up.", scene=sent))
    shown, scene = here.renderer, here.scene()
    levels = [one.expected(scene) for one in (shown.left, shown.right)]
    assert max(np.mean(level >= 254.0) for level in levels) < 0.25
    drawn = here.renderer.left.expected(replace(scene, lighting=sent.lighting))
    if member == 16000:  # as it was drawn
        assert scene.lighting == sent.lighting
    else:
        assert np.mean(drawn >= 254.0) > 0.25
        assert 0.8 < scene.lighting.brightness / sent.lighting.brightness < 1.0
        assert replace(scene.lighting, brightness=sent.lighting.brightness) == sent.lighting


# Calibration boards

PATTERN = Pattern("chessboard", 10, 7, 40.0, 20.0)
HELD = op.BoardPose(PATTERN, "Hold the board.", 3)
FIXED = op.BoardPose(PATTERN, "Fix the board.", 1, fixed=True)


@pytest.mark.slow
def test_hands_hold_the_board_where_both_cameras_see_all_of_it_another_way_each_time() -> None:
    here = world()
    hands = BoardHands(here)
    boards = [hands.held(replace(HELD, number=n, heated=n == 3)) for n in (1, 2, 3)]
    assert (boards[2].dark, boards[2].light) == (40.0, "ambient")
    assert len({board.corner_mm for board in boards}) == 3
    for board in boards:
        for camera in here.renderer.cameras[:2]:
            pixels = camera.project(board.corners_mm)
            assert ((pixels > 0) & (pixels < (camera.width_px - 1, camera.height_px - 1))).all()


def test_hands_have_had_enough_after_a_while() -> None:
    with pytest.raises(op.OperatorEnough, match=f"has shown the board {SHOWN} times"):
        hands(world()).ask(replace(HELD, number=SHOWN + 1))


@pytest.mark.slow
def test_hands_take_the_phantom_away_meanwhile_and_put_it_back() -> None:
    here = world()
    hands(here).ask(HELD)
    assert (len(here.scene().boards), here.scene().phantom.teats) == (1, ())
    here.show(None)
    assert (here.scene().boards, len(here.scene().phantom.teats)) == ((), 4)


@pytest.mark.parametrize("number", [1, 2])
def test_hands_rest_the_ball_on_the_face_that_the_cameras_see(number: int) -> None:
    here = world()
    tips = BoardHands(here)
    board = tips.held(replace(FIXED, number=number))
    centre, axis = tips.tip(13, 1.5)
    off = centre - board.corners_mm[13]
    assert np.linalg.norm(off) == pytest.approx(1.5)
    assert off @ (here.renderer.cameras[0].centre_mm - board.corners_mm[13]) > 0
    assert axis @ off > 0, "the stylus comes from that side too"
