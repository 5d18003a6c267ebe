"""What the bench relies on, of every keeper of the protocol alike: a person, a script, emulated
hands, a rehearsal of both, and whoever is awaited under the guardian's eyes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from instruments.operators.operator import BoardAsked, Operator
from instruments.world.boards import Pattern
from tests.instruments.operators.people import KEEPERS, arrangement, trip_handler


class TrippedError(Exception):
    """What an interlock would raise."""


def tripped() -> None:
    raise TrippedError("over-temperature")


FIXED = BoardAsked(Pattern(), "Fix the board where both cameras see it.", 1, fixed=True)
HELD = BoardAsked(Pattern(), "Hold the board where both cameras see it.", 1)

ASKED: dict[str, Callable[[Operator], object]] = {
    "homing": lambda who: who.confirm_homing("Put the stylus on its peg."),
    "check point": lambda who: who.touch_check_point(1, 5),
    "set up": lambda who: who.set_up(arrangement()),
    "touch": lambda who: who.touch(2, 4),
    "hold a board": lambda who: who.hold_board(HELD),
    "fix a board": lambda who: who.hold_board(FIXED),
    "touch the board": lambda who: who.touch_board(4, "Touch the middle point."),
    "touch the board again": lambda who: who.touch_board(
        4, "Touch the middle point.", again="That was another point."
    ),
    "touch again": lambda who: who.touch(
        2, 4, number=2, numbers=3, again="That was nearer to teat 3."
    ),
}


@pytest.fixture(params=KEEPERS)
def who(request: pytest.FixtureRequest) -> Operator:
    return trip_handler(request.param)


class TestEveryKeeper:
    def test_goes_through_a_whole_run(self, who: Operator) -> None:
        who.check_interrupts(lambda: None)
        who.confirm_homing("Put the stylus on its peg.")
        for touch in range(1, 6):
            who.touch_check_point(touch, 5)
        who.release()
        for trial in (1, 2):
            who.next_trial(trial, 2, None if trial == 1 else 60.0)
            placed = who.set_up(arrangement())
            for teat, _ in enumerate(placed.visible, 1):
                for number in (1, 2, 3):
                    who.touch(teat, 4, number=number, numbers=3)
            who.release()
        who.finish()

    def test_goes_through_a_whole_calibration(self, who: Operator) -> None:
        who.check_interrupts(lambda: None)
        for number in (1, 2, 3):
            who.hold_board(replace(HELD, number=number))
        who.confirm_homing("Put the stylus on its peg.")
        for position in (1, 2):
            who.hold_board(replace(FIXED, number=position))
            for corner in (0, 4, 53):
                who.touch_board(corner, "Touch it.")
            who.release()
        who.finish()

    def test_tells_of_each_teat_whether_it_is_seen(self, who: Operator) -> None:
        for layout in ("table-5-1", "overlapping"):
            visible = who.set_up(arrangement(layout)).visible
            assert len(visible) == 4
            assert all(type(seen) is bool for seen in visible)

    @pytest.mark.parametrize("asked", ASKED)
    def test_a_prompt_ends_with_what_the_check_raises(self, who: Operator, asked: str) -> None:
        who.set_up(arrangement())
        who.hold_board(FIXED)
        who.check_interrupts(tripped)
        with pytest.raises(TrippedError, match="over-temperature"):
            ASKED[asked](who)

    def test_what_is_no_prompt_checks_nothing(self, who: Operator) -> None:
        who.check_interrupts(tripped)
        who.next_trial(1, 2, None)
        who.release()
        who.finish()

    @pytest.mark.parametrize("asked", ASKED)
    def test_may_be_asked_the_same_again(self, who: Operator, asked: str) -> None:
        who.set_up(arrangement())
        who.hold_board(FIXED)
        for _ in range(3):
            ASKED[asked](who)
