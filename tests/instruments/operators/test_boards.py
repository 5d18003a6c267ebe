"""Operators who hold calibration boards: what a person may answer, and where emulated hands hold
and touch one.
"""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest

from instruments.operators.emulated import SHOWN, BoardHands
from instruments.operators.operator import (
    BoardAsked,
    BoardTouch,
    Finish,
    OperatorAbort,
    OperatorEnough,
)
from instruments.operators.prompted import ScriptedAnswer, ScriptedAnswers
from instruments.world.boards import Pattern
from tests.instruments.operators.people import hands, person, world

PATTERN = Pattern("chessboard", 10, 7, 40.0, 20.0)
HELD = BoardAsked(PATTERN, "Hold the board. Missing: left: tilt the board.", 3)
FIXED = BoardAsked(PATTERN, "Fix the board.", 1, fixed=True)


class TestAPerson:
    def test_is_told_what_is_missing_and_how_to_end_it(self) -> None:
        out = io.StringIO()
        person("\n", out).ask(HELD)
        assert "[view 3] Hold the board. Missing: left: tilt the board." in out.getvalue()
        assert "e = enough, go on with what there is" in out.getvalue()

    @pytest.mark.parametrize("word", ["e", "Enough"])
    def test_may_have_had_enough(self, word: str) -> None:
        with pytest.raises(OperatorEnough, match="has shown enough"):
            person(f"{word}\n").ask(HELD)

    def test_may_not_have_had_enough_of_a_board_that_is_to_be_touched(self) -> None:
        out = io.StringIO()
        person("enough\n\n", out).ask(FIXED)
        assert "Not understood: 'enough'." in out.getvalue()
        assert "[position 1] Fix the board." in out.getvalue()

    def test_may_abort(self) -> None:
        for asked in (HELD, FIXED):
            with pytest.raises(OperatorAbort):
                person("a\n").ask(asked)
        with pytest.raises(OperatorAbort):
            person("a\n").ask(BoardTouch(0, "Touch it."))

    def test_is_told_why_a_point_is_asked_for_again(self) -> None:
        out = io.StringIO()
        person("\n", out).ask(BoardTouch(0, "Touch point 1.", again="That was another point."))
        assert out.getvalue().index("That was another point.") < out.getvalue().index(
            "Touch point 1."
        )


def test_a_script_says_enough_to_boards_only() -> None:
    script = ScriptedAnswers(
        [ScriptedAnswer("board", "enough", says="view 3")], {"board": "go"}, "answers.txt"
    )
    who = script
    who.ask(replace(HELD, number=2))
    with pytest.raises(OperatorEnough):
        who.ask(HELD)
    who.ask(Finish())
    with pytest.raises(
        ValueError, match='to a prompt of the kind "corner" there are "go", "abort"'
    ):
        ScriptedAnswer("corner", "enough")


class TestEmulatedHands:
    @pytest.mark.slow
    def test_hold_the_board_where_both_cameras_see_all_of_it_another_way_each_time(self) -> None:
        here = world()
        boards = [BoardHands(here).held(replace(HELD, number=number)) for number in (1, 2, 3)]
        assert len({board.corner_mm for board in boards}) == 3
        for board in boards:
            for camera in here.renderer.cameras[:2]:
                pixels = camera.project(board.corners_mm)
                assert ((pixels > 0) & (pixels < (camera.width_px - 1, camera.height_px - 1))).all()

    def test_have_had_enough_after_a_while(self) -> None:
        with pytest.raises(OperatorEnough, match=f"has shown the board {SHOWN} times"):
            hands(world()).ask(replace(HELD, number=SHOWN + 1))

    @pytest.mark.slow
    def test_take_the_phantom_away_meanwhile_and_put_it_back(self) -> None:
        here = world()
        who = hands(here)
        who.ask(HELD)
        assert len(here.scene().boards) == 1
        assert here.scene().phantom.teats == ()
        here.show(None)
        assert here.scene().boards == ()
        assert len(here.scene().phantom.teats) == 4

    @pytest.mark.slow
    def test_a_heated_board_is_warm_where_it_is_dark(self) -> None:
        board = BoardHands(world()).held(replace(HELD, heated=True))
        assert board.dark == 40.0
        assert board.light == "ambient"

    @pytest.mark.parametrize("number", [1, 2])
    def test_rest_the_ball_on_the_face_that_the_cameras_see(self, number: int) -> None:
        here = world()
        tips = BoardHands(here)
        board = tips.held(replace(FIXED, number=number))
        centre, axis = tips.tip(13, 1.5)
        off = centre - board.corners_mm[13]
        assert np.linalg.norm(off) == pytest.approx(1.5)
        assert off @ (here.renderer.cameras[0].centre_mm - board.corners_mm[13]) > 0
        assert axis @ off > 0, "the stylus comes from that side too"

    def test_touch_nothing_where_no_board_is(self) -> None:
        with pytest.raises(ValueError, match="holds no board"):
            hands(world()).ask(BoardTouch(0, "Touch it."))
