"""What the bench relies on, of all who answer alike: a person, a file of answers, emulated hands, and
a rehearsal of both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from instruments.operators.operator import (
    Answer,
    Awaited,
    BoardAsked,
    BoardTouch,
    CheckPoint,
    Finish,
    Homing,
    NextTrial,
    Operator,
    Release,
    Request,
    Touch,
)
from instruments.world.boards import Pattern
from tests.instruments.operators.people import ANSWERERS, arrangement

pytestmark = pytest.mark.slow


class TrippedError(Exception):
    """What an interlock would raise."""


def tripped() -> None:
    raise TrippedError("over-temperature")


FIXED = BoardAsked(Pattern(), "Fix the board where both cameras see it.", 1, fixed=True)
HELD = BoardAsked(Pattern(), "Hold the board where both cameras see it.", 1)
PEG = Homing("Put the stylus on its peg.")
CORNER = BoardTouch(4, "Touch the middle point.")
ASKED: tuple[Awaited, ...] = (
    PEG,
    CheckPoint(1, 5),
    arrangement(),
    Touch(2, 4),
    Touch(2, 4, number=2, numbers=3, again="That was nearer to teat 3."),
    HELD,
    FIXED,
    CORNER,
    replace(CORNER, again="That was another point."),
)
EACH_TRIAL: tuple[Request, ...] = (
    arrangement(),
    *(Touch(teat, 4, number, 3) for teat in (1, 2, 3, 4) for number in (1, 2, 3)),
    Release(),
)
RUN: tuple[Request, ...] = (
    PEG,
    *(CheckPoint(touch, 5) for touch in range(1, 6)),
    Release(),
    *(NextTrial(1, 2, None), *EACH_TRIAL, NextTrial(2, 2, 60.0), *EACH_TRIAL),
    Finish(),
)
EACH_POSITION: tuple[Request, ...] = (
    *(BoardTouch(at, "Touch it.") for at in (0, 4, 53)),
    Release(),
)
CALIBRATION: tuple[Request, ...] = (
    *(replace(HELD, number=number) for number in (1, 2, 3)),
    PEG,
    *(FIXED, *EACH_POSITION, replace(FIXED, number=2), *EACH_POSITION),
    Finish(),
)


@pytest.fixture(params=ANSWERERS)
def who(request: pytest.FixtureRequest) -> Operator:
    made: Callable[[], Operator] = ANSWERERS[request.param]
    return made()


@pytest.mark.parametrize("requests", [RUN, CALIBRATION], ids=["run", "calibration"])
def test_goes_through_it_all(who: Operator, requests: tuple[Request, ...]) -> None:
    for request in requests:
        seen = who.ask(request).visible
        assert [type(one) for one in seen] == [bool] * (4 if request == arrangement() else 0)


@pytest.mark.parametrize("asked", ASKED, ids=repr)
def test_a_request_may_come_again_and_ends_with_what_the_check_raises(
    who: Operator, asked: Awaited
) -> None:
    who.ask(arrangement())
    who.ask(FIXED)
    for _ in range(3):
        assert isinstance(who.ask(asked), Answer)
    with pytest.raises(TrippedError, match="over-temperature"):
        who.ask(asked, tripped)


def test_what_is_not_waited_for_checks_nothing(who: Operator) -> None:
    for notice in (NextTrial(1, 2, None), Release(), Finish()):
        who.ask(notice, tripped)
