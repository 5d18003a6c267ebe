"""Who moves what no motor moves, and who touches the teat ends with the arm: what the bench asks of
them.

A person at a terminal, a script of answers and the emulated operator keep this one protocol; the
bench never asks which it is. Each method that asks returns once it is done, or raises what the
operator wants instead.

What an operator is asked, and what his words mean: values and pure functions, the same for a
terminal and a script of answers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from instruments.world.boards import Pattern
from instruments.world.phantom import Phantom, PlatePose
from instruments.world.situations import Situation


class OperatorAbort(Exception):  # noqa: N818 - a wish, not a fault
    """The operator wants the run to end, safely and now."""


class OperatorSkip(Exception):  # noqa: N818 - a wish, not a fault
    """This trial can't be done, for the ``reason``; the run goes on with the next. Raised by
    ``set_up`` and ``touch`` only.
    """

    def __init__(self, reason: str) -> None:
        self.reason = reason
        super().__init__(f"the operator skipped the trial: {reason}")


class OperatorRepeat(Exception):  # noqa: N818 - a wish, not a fault
    """Something went wrong in this trial: it is to be done again from its set-up. Raised by
    ``set_up`` and ``touch`` only.

    ``reason`` is empty where none was given.
    """

    def __init__(self, reason: str = "") -> None:
        self.reason = reason
        super().__init__(f"the operator wants the trial again{f': {reason}' if reason else ''}")


class OperatorEnough(Exception):  # noqa: N818 - a wish, not a fault
    """No more boards: what has been shown shall do. Raised by ``hold_board`` only, and only where
    the board need not be ``fixed``.
    """


@dataclass(frozen=True, slots=True)
class BoardAsked:
    """A calibration board for the ``number``-th time (from 1): ``instruction`` says to a person
    where and how it shall be.

    ``pattern`` is what is printed on it, ``cameras`` are those that shall see all of it.
    ``heated``: its dark parts are to be warmer than its light ones. ``fixed``: it is to stay where
    it is, for the arm to touch it; the phantom is out of the way either way.
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

    ``phantom`` has the teats on their plate, ``objects`` are keyword tables of the scene's other
    things, and ``instruction`` says the same to a person. ``pose`` is where the operator puts the
    plate, relative to its reference place; where a stage moves it, that stays zero. ``unattended``:
    nobody has touched anything since it was last set up, so where it is the same as then, a person
    isn't asked. ``scene`` has light, background and further things where they are a situation's.
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
    """Asked in this order: homing once, the check point, then for each trial set-up and touches;
    the check point once more.
    """

    def check_interrupts(self, check: Callable[[], None]) -> None:
        """From now on ``check`` is called again and again while a prompt waits; what it raises ends
        the prompt at once.
        """
        ...

    def next_trial(self, number: int, of: int, left_s: float | None) -> None:
        """Trial ``number`` (from 1) of ``of`` is next; the run takes ``left_s`` more, None where
        nothing is known of that yet.
        """
        ...

    def confirm_homing(self, instruction: str) -> None:
        """Return once the arm's stylus is on its peg. Raises OperatorAbort."""
        ...

    def touch_check_point(self, touch: int, of: int) -> None:
        """Return once the arm's tip rests in the divot of the check point and is held still, for
        the ``touch``-th time (from 1).

        The stylus leans another way each time, so that wrist and elbow swing. Raises OperatorAbort.
        """
        ...

    def set_up(self, arrangement: Arrangement) -> Placed:
        """Return once the scene stands as asked. Raises OperatorAbort, OperatorSkip,
        OperatorRepeat.
        """
        ...

    def touch(
        self, teat: int, of: int, *, number: int = 1, numbers: int = 1, again: str = ""
    ) -> None:
        """Return once the arm's tip rests on the end of teat ``teat`` (from 1) of ``of`` and is
        held still.

        It is touch ``number`` of ``numbers`` of that end. ``again`` is a sentence that says why a
        touch is asked for once more ("That was nearer to teat 2."), shown before the question.
        Raises OperatorAbort, OperatorSkip, OperatorRepeat.
        """
        ...

    def hold_board(self, asked: BoardAsked) -> None:
        """Return once a calibration board is held still as asked. Raises OperatorAbort,
        OperatorEnough.
        """
        ...

    def touch_board(self, corner: int, instruction: str, *, again: str = "") -> None:
        """Return once the arm's tip rests on point ``corner`` (from 0, of the pattern's
        `corners_mm`) of the board that was fixed last.

        ``instruction`` says to a person which one that is, ``again`` why it is asked for once more.
        Raises OperatorAbort.
        """
        ...

    def release(self) -> None:
        """The reading is taken; the arm may be put away from the scene."""
        ...

    def finish(self) -> None:
        """The run has come to its end: nothing more will be asked. Raises ProtocolError where
        answers are left over.
        """
        ...


Kind = Literal["homing", "check point", "set up", "touch", "board", "corner", "task"]
IN_TRIALS: tuple[Kind, ...] = ("set up", "touch")  # what may be skipped or repeated

GO = ("go",)
ABORT = ("a", "abort", "q", "quit")
SKIP = ("s", "skip")
REPEAT = ("r", "repeat")
ENOUGH = ("e", "enough")
EXPLAIN = "?"
ABORT_KEY = "? = explain, a = abort the run"
EXPLAINED: Mapping[Kind, str] = {
    "homing": (
        "The arm counts its joints' angles from where they are when it is switched on. Away from"
        " its peg every point would be wrong."
    ),
    "check point": (
        "The check point's place is known: the readings there show whether the arm measures right."
    ),
    "set up": (
        "The cameras take their pictures after your answer, so step out of their view. A teat end"
        " is hidden where at least one camera can't see it; it doesn't count as missed."
    ),
    "touch": (
        "Where the tip is when you go on is the truth that the detectors are scored against. A"
        " touch that doesn't fit is asked for again, and the reason stands above the question."
    ),
    "board": (
        "The cameras take a picture of the board after your answer. Hold it still, the whole"
        " pattern in each camera's view."
    ),
    "corner": "Where the tip is when you go on ties the board's corners to the arm's frame.",
    "task": "The bench goes on when this is done.",
}


class NotUnderstoodError(ValueError):
    """The words are no answer to this prompt; the text says what would be."""


@dataclass(frozen=True, slots=True)
class Prompt:
    """``text`` says what to do and ``progress`` how far the run is; ``pedal``: a pedal is as good
    as Enter.

    ``hidden_to`` above 0 lets the answer be numbers of hidden teat ends, 1 to that many.
    ``enough``: it may be answered by that word.
    """

    kind: Kind
    text: str
    progress: str = ""
    hidden_to: int = 0
    pedal: bool = False
    enough: bool = False

    @property
    def in_trial(self) -> bool:
        """Whether it may be answered by skipping or repeating the trial."""
        return self.kind in IN_TRIALS

    def keys(self, *, pedal: bool = False) -> str:
        """What may be answered, the abort always among it. ``pedal``: there is one, and it is
        watched.
        """
        go = "Enter or a pedal to go on" if pedal and self.pedal else "Enter to go on"
        if self.hidden_to:
            go = (
                "Enter when it stands; if teat ends are hidden from a camera, their numbers first"
                f" (1 to {self.hidden_to})"
            )
        trial = (
            ["s REASON = skip this trial", "r = repeat it from its set-up"] if self.in_trial else []
        )
        enough = ["e = enough, go on with what there is"] if self.enough else []
        return f"{go} ({', '.join([*trial, *enough, ABORT_KEY])}): "

    def explained(self) -> str:
        """Why it is asked, and what each answer does."""
        lines = [EXPLAINED[self.kind]]
        if self.in_trial:
            lines += [
                "Skip: the trial gets no result, and the report lists it with your reason.",
                "Repeat: its pictures and touches are dropped.",
            ]
        if self.enough:
            lines.append("Enough: it is calibrated from what was shown so far.")
        lines += [
            "Abort: the bath goes to standby, the stage stops. What was finished is kept.",
            "There is no hurry; nothing is lost by taking long.",
        ]
        return "\n".join(lines)


def understood(answer: str, prompt: Prompt) -> frozenset[int]:
    """The numbers of hidden teat ends in ``answer``: none for a plain "go on", as Enter is.

    Raises OperatorAbort, OperatorRepeat, OperatorEnough, OperatorSkip (with an empty reason where
    none was given), or NotUnderstoodError.
    """
    words = answer.replace(",", " ").lower().split()
    first = words[0] if words else ""
    if first in ABORT and len(words) == 1:
        raise OperatorAbort("the operator aborted the run")
    if prompt.in_trial and first in REPEAT:
        raise OperatorRepeat(" ".join(answer.split()[1:]))
    if prompt.enough and first in ENOUGH and len(words) == 1:
        raise OperatorEnough("the operator has shown enough")
    if prompt.in_trial and first in SKIP:
        raise OperatorSkip(" ".join(answer.split()[1:]))
    if not words or (first in GO and len(words) == 1):
        return frozenset()
    numbers = words[1:] if first == "hidden" and len(words) > 1 else words
    if prompt.hidden_to and all(
        word.isdecimal() and 1 <= int(word) <= prompt.hidden_to for word in numbers
    ):
        return frozenset(int(word) for word in numbers)
    raise NotUnderstoodError(f"Not understood: {answer.strip()!r}.")


def time_left(seconds: float) -> str:
    """A length of time as one says it: "about 12 min left"."""
    if seconds < 60.0:
        return "less than a minute left"
    minutes = round(seconds / 60.0)
    if minutes < 100:
        return f"about {minutes} min left"
    return f"about {round(seconds / 3600.0, 1):g} h left"
