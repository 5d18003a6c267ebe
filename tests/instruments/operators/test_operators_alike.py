"""What the bench relies on, of all who answer alike: a person, a file of answers, emulated hands, and
a rehearsal of both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from instruments.operators import operator as op
from instruments.world.boards import Pattern
from tests.instruments.operators.people import ANSWERERS, arrangement

pytestmark = pytest.mark.slow


class TrippedError(Exception):
    """What an interlock would raise."""


def tripped() -> None:
    raise TrippedError("over-temperature")


FIXED = op.BoardPose(Pattern(), "Fix the board where both cameras see it.", 1, fixed=True)
HELD = op.BoardPose(Pattern(), "Hold the board where both cameras see it.", 1)
PEG = op.Homing("Put the stylus on its peg.")
CORNER = op.BoardTouch(4, "Touch the middle point.")
ASKED: tuple[op.Awaited, ...] = (
    PEG,
    op.CheckPoint(1, 5),
    arrangement(),
    op.Touch(2, 4),
    op.Touch(2, 4, number=2, numbers=3, again="That was nearer to teat 3."),
    HELD,
    FIXED,
    CORNER,
    replace(CORNER, again="That was another point."),
)
EACH_TRIAL: tuple[op.Request, ...] = (
    arrangement(),
    *(op.Touch(teat, 4, number, 3) for teat in (1, 2, 3, 4) for number in (1, 2, 3)),
    op.Release(),
)
RUN: tuple[op.Request, ...] = (
    PEG,
    *(op.CheckPoint(touch, 5) for touch in range(1, 6)),
    op.Release(),
    *(op.NextTrial(1, 2), *EACH_TRIAL, op.NextTrial(2, 2, lambda: 60.0), *EACH_TRIAL),
    op.Finish(),
)
EACH_POSITION: tuple[op.Request, ...] = (
    *(op.BoardTouch(at, "Touch it.") for at in (0, 4, 53)),
    op.Release(),
)
CALIBRATION: tuple[op.Request, ...] = (
    *(replace(HELD, number=number) for number in (1, 2, 3)),
    PEG,
    *(FIXED, *EACH_POSITION, replace(FIXED, number=2), *EACH_POSITION),
    op.Finish(),
)


@pytest.fixture(params=ANSWERERS)
def who(request: pytest.FixtureRequest) -> op.Operator:
    made: Callable[[], op.Operator] = ANSWERERS[request.param]
    return made()


@pytest.mark.parametrize("requests", [RUN, CALIBRATION], ids=["run", "calibration"])
def test_goes_through_it_all(who: op.Operator, requests: tuple[op.Request, ...]) -> None:
    for request in requests:
        seen = who.ask(request).visible
        assert [type(one) for one in seen] == [bool] * (4 if request == arrangement() else 0)


@pytest.mark.parametrize("asked", ASKED, ids=repr)
def test_a_request_may_come_again_and_ends_with_what_the_check_raises(
    who: op.Operator, asked: op.Awaited
) -> None:
    who.ask(arrangement())
    who.ask(FIXED)
    for _ in range(3):
        assert isinstance(who.ask(asked), op.Answer)
    with pytest.raises(TrippedError, match="over-temperature"):
        who.ask(asked, tripped)


def test_what_is_not_waited_for_checks_nothing(who: op.Operator) -> None:
    for notice in (op.NextTrial(1, 2), op.Release(), op.Finish()):
        who.ask(notice, tripped)
