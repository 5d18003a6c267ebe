"""Who moves what no motor moves, and who touches the teat ends with the arm: what the bench asks of them.

A person at a terminal, a script of answers and the emulated operator keep this one protocol; the bench never asks which it is.
Each method that asks returns once it is done, or raises what the operator wants instead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from instruments.world.boards import Pattern
from instruments.world.phantom import Phantom, PlatePose
from instruments.world.situations import Situation


class OperatorAbort(Exception):  # noqa: N818 - a wish, not a fault
    """The operator wants the run to end, safely and now."""


class OperatorSkip(Exception):  # noqa: N818 - a wish, not a fault
    """This trial can't be done, for the ``reason``; the run goes on with the next. Raised by ``set_up`` and ``touch`` only."""

    def __init__(self, reason: str) -> None:
        self.reason = reason
        super().__init__(f"the operator skipped the trial: {reason}")


class OperatorRepeat(Exception):  # noqa: N818 - a wish, not a fault
    """Something went wrong in this trial: it is to be done again from its set-up. Raised by ``set_up`` and ``touch`` only.

    ``reason`` is empty where none was given.
    """

    def __init__(self, reason: str = "") -> None:
        self.reason = reason
        super().__init__(f"the operator wants the trial again{f': {reason}' if reason else ''}")


class OperatorEnough(Exception):  # noqa: N818 - a wish, not a fault
    """No more boards: what has been shown shall do. Raised by ``hold_board`` only, and only where the board need not be ``fixed``."""


@dataclass(frozen=True, slots=True)
class BoardAsked:
    """A calibration board for the ``number``-th time (from 1): ``instruction`` says to a person where and how it shall be.

    ``pattern`` is what is printed on it, ``cameras`` are those that shall see all of it. ``heated``: its dark parts are to be warmer
    than its light ones. ``fixed``: it is to stay where it is, for the arm to touch it; the phantom is out of the way either way.
    """

    pattern: Pattern
    instruction: str
    number: int
    cameras: tuple[str, ...] = ("left", "right")
    heated: bool = False
    fixed: bool = False


@dataclass(frozen=True, slots=True)
class Arrangement:
    """How the phantom shall stand and what else shall be in the scene.

    ``phantom`` has the teats on their plate, ``objects`` are keyword tables of the scene's other things, and
    ``instruction`` says the same to a person. ``pose`` is where the operator puts the plate, relative to its reference place;
    where a stage moves it, that stays zero. ``unattended``: nobody has touched anything since it was last set up, so where it is the
    same as then, a person isn't asked. ``scene`` has light, background and further things where they are a situation's.
    """

    situation: str
    phantom: Phantom
    objects: tuple[Mapping[str, Any], ...]
    instruction: str
    pose: PlatePose = field(default_factory=PlatePose)
    unattended: bool = False
    scene: Situation | None = None

    @property
    def teats(self) -> int:
        """How many teats there are."""
        return len(self.phantom.teats)


@dataclass(frozen=True, slots=True)
class Placed:
    """What was set up. ``visible[i]`` is False for a teat end that some camera can't see."""

    visible: tuple[bool, ...]


class Operator(Protocol):
    """Asked in this order: homing once, the check point, then for each trial set-up and touches; the check point once more."""

    def heed(self, check: Callable[[], None]) -> None:
        """From now on ``check`` is called again and again while a prompt waits; what it raises ends the prompt at once."""
        ...

    def next_trial(self, number: int, of: int, left_s: float | None) -> None:
        """Trial ``number`` (from 1) of ``of`` is next; the run takes ``left_s`` more, None where nothing is known of that yet."""
        ...

    def confirm_homing(self, instruction: str) -> None:
        """Return once the arm's stylus is on its peg. Raises OperatorAbort."""
        ...

    def touch_check_point(self, touch: int, of: int) -> None:
        """Return once the arm's tip rests in the divot of the check point and is held still, for the ``touch``-th time (from 1).

        The stylus leans another way each time, so that wrist and elbow swing. Raises OperatorAbort.
        """
        ...

    def set_up(self, arrangement: Arrangement) -> Placed:
        """Return once the scene stands as asked. Raises OperatorAbort, OperatorSkip, OperatorRepeat."""
        ...

    def touch(self, teat: int, of: int, *, number: int = 1, numbers: int = 1, again: str = "") -> None:
        """Return once the arm's tip rests on the end of teat ``teat`` (from 1) of ``of`` and is held still.

        It is touch ``number`` of ``numbers`` of that end. ``again`` is a sentence that says why a touch is asked for once more
        ("That was nearer to teat 2."), shown before the question. Raises OperatorAbort, OperatorSkip, OperatorRepeat.
        """
        ...

    def hold_board(self, asked: BoardAsked) -> None:
        """Return once a calibration board is held still as asked. Raises OperatorAbort, OperatorEnough."""
        ...

    def touch_board(self, corner: int, instruction: str, *, again: str = "") -> None:
        """Return once the arm's tip rests on point ``corner`` (from 0, of the pattern's `corners_mm`) of the board that was fixed last.

        ``instruction`` says to a person which one that is, ``again`` why it is asked for once more. Raises OperatorAbort.
        """
        ...

    def release(self) -> None:
        """The reading is taken; the arm may be put away from the scene."""
        ...

    def finish(self) -> None:
        """The run has come to its end: nothing more will be asked. Raises ProtocolError where answers are left over."""
        ...
