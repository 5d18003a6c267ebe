"""What the bench asks of an operator, who places the phantom and touches the teat ends, and what
answers mean. `Operator.ask` is answered by a person at a terminal, a file of answers, emulated
hands, and those of another process.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal, Protocol

from instruments.world.boards import Pattern
from instruments.world.phantom import Phantom, PlatePose
from instruments.world.setups import Situation
from textfiles.text import range_text


class OperatorAbort(Exception):  # noqa: N818 - a request, not a fault
    """The operator wants the run to end, safely and now."""


class OperatorSkip(Exception):  # noqa: N818 - a request, not a fault
    """This trial can't be done, for the ``reason``. Answers an `Arrangement` and a `Touch` only."""

    def __init__(self, reason: str) -> None:
        self.reason = reason
        super().__init__(f"the operator skipped the trial: {reason}")


class OperatorRepeat(Exception):  # noqa: N818 - a request, not a fault
    """Repeat this trial from its set-up. Answers an `Arrangement` and a `Touch` only."""

    def __init__(self, reason: str = "") -> None:
        self.reason = reason
        super().__init__(f"the operator wants the trial again{f': {reason}' if reason else ''}")


class OperatorEnough(Exception):  # noqa: N818 - a request, not a fault
    """No more boards. Answers a `BoardPose` only, where the board need not be ``fixed``."""


@dataclass(frozen=True, slots=True)
class Homing:
    """The arm's stylus is to be put on its peg, as ``instruction`` says."""

    instruction: str


@dataclass(frozen=True, slots=True)
class CheckPoint:
    """Hold the tip in the check point's divot, the stylus leaning another way each time; ``again``
    says why it is repeated.
    """

    touch: int
    of: int
    again: str = ""


@dataclass(frozen=True, slots=True)
class Arrangement:
    """How the phantom stands and what else is in the scene; the answer says which ends are visible.
    ``pose``: of the plate, zero where a stage moves it; ``unattended``: an unchanged arrangement
    isn't asked for again; ``details`` and ``picture`` help who has not set this up before.
    """

    situation: str
    phantom: Phantom
    objects: tuple[Mapping[str, Any], ...]
    instruction: str
    pose: PlatePose = field(default_factory=PlatePose)
    unattended: bool = False
    scene: Situation | None = None
    details: str = ""
    picture: str = field(default="", compare=False)

    @property
    def teats(self) -> int:
        """How many teats there are."""
        return len(self.phantom.teats)


@dataclass(frozen=True, slots=True)
class Touch:
    """Hold the tip on the end of teat ``teat`` (from 1), for the ``number``-th time of ``numbers``;
    ``again`` says why it is repeated. The first asks for all touches of its teat; the others are a
    ``press``.
    """

    teat: int
    of: int
    number: int = 1
    numbers: int = 1
    again: str = ""

    @property
    def press(self) -> bool:
        """Whether the person knows already that this touch is wanted."""
        return self.number > 1 and not self.again


@dataclass(frozen=True, slots=True)
class BoardPose:
    """Show a calibration board, without the phantom, to all ``cameras``; ``heated``: its dark parts
    are warmer; ``fixed``: it stays, for the arm to touch.
    """

    pattern: Pattern
    instruction: str
    number: int
    cameras: tuple[str, ...] = ("left", "right")
    heated: bool = False
    fixed: bool = False


@dataclass(frozen=True, slots=True)
class BoardTouch:
    """Hold the tip on point ``corner`` (from 0) of the fixed board; ``again``: why once more."""

    corner: int
    instruction: str
    again: str = ""


@dataclass(frozen=True, slots=True)
class Task:
    """Anything else that a person is to do, as ``text`` says; ``pedal``: as good as Enter."""

    text: str
    pedal: bool = False


@dataclass(frozen=True, slots=True)
class Coordinates:
    """Type x, y and z of a point, and i, j and k of the stylus where they are known."""

    text: str


@dataclass(frozen=True, slots=True)
class NextTrial:
    """Trial ``number`` (from 1) of ``of`` is next; ``left_s`` of the run, when asked, or None."""

    number: int
    of: int
    left_s: Callable[[], float | None] = lambda: None


@dataclass(frozen=True, slots=True)
class Release:
    """The readings are taken; the arm may be put away from the scene. ``lost``: they are not, for
    the arm itself is away.
    """

    lost: bool = False


@dataclass(frozen=True, slots=True)
class Finish:
    """Nothing more will be asked. Raises ProtocolError where answers are left over."""


Awaited = Homing | CheckPoint | Arrangement | Touch | BoardPose | BoardTouch | Task | Coordinates
Notice = NextTrial | Release | Finish  # the bench waits for no answer to these
Request = Awaited | Notice


@dataclass(frozen=True, slots=True)
class Answer:
    """``visible[i]``: whether all cameras see a teat end, of an `Arrangement`; ``point``: typed."""

    visible: tuple[bool, ...] = ()
    point: tuple[str, ...] | None = None


DONE = Answer()


def no_check() -> None:
    """For requests outside of runs: nothing watches."""


class Operator(Protocol):
    """Asked in this order: homing, check point, set-up and touches of each trial, check point."""

    def ask(self, request: Request, check: Callable[[], None] = no_check) -> Answer:
        """Return once ``request`` is done; ``check`` is called meanwhile, and may raise. Raises
        OperatorAbort, OperatorSkip, OperatorRepeat, OperatorEnough, InstrumentError.
        """


Kind = Literal["homing", "check point", "set up", "touch", "board", "corner", "task", "coordinates"]
KIND_OF: Mapping[type, Kind] = {
    Homing: "homing",
    CheckPoint: "check point",
    Arrangement: "set up",
    Touch: "touch",
    BoardPose: "board",
    BoardTouch: "corner",
    Task: "task",
    Coordinates: "coordinates",
}
IN_TRIALS: tuple[Kind, ...] = ("set up", "touch")  # what may be skipped or repeated

GO = ("go",)
ABORT = ("a", "abort", "q", "quit")
SKIP = ("s", "skip")
REPEAT = ("r", "repeat")
ENOUGH = ("e", "enough")
EXPLAIN = "?"
KEYS = (*GO, *ABORT, *SKIP, *REPEAT, *ENOUGH, EXPLAIN)  # none is a reason for the record


@cache
def explained() -> Mapping[str, str]:
    """Why a person is asked, by the kind of prompt."""
    return tomllib.loads(Path(__file__).with_name("explained.toml").read_text(encoding="utf-8"))


class NotUnderstoodError(ValueError):
    """The words are no answer to this prompt; the text says what would be. ``wrong`` doesn't."""

    def __init__(self, wrong: str, allowed: str = "") -> None:
        self.wrong = wrong
        super().__init__(f"{wrong} {allowed}".rstrip())


@dataclass(frozen=True, slots=True)
class Prompt:
    """``hidden_to``: hidden teat ends may be named, 1 to that; ``enough``: may be answered;
    ``press``: one more touch of the prompt before, said in short; ``left``: of the run, when asked;
    ``in_run``: else a command asks that has no trials, such as a calibration.
    """

    kind: Kind
    text: str
    progress: str = ""
    hidden_to: int = 0
    pedal: bool = False
    enough: bool = False
    press: bool = False
    left: str = ""
    in_run: bool = True

    @property
    def head(self) -> str:
        """``[trial 3 of 18; about 12 min left] ``; empty where there is nothing to say."""
        said = "; ".join(filter(None, (self.progress, self.left)))
        return f"[{said}] " if said else ""

    @property
    def in_trial(self) -> bool:
        """Whether it may be answered by skipping or repeating the trial."""
        return self.in_run and self.kind in IN_TRIALS

    @property
    def aborted(self) -> OperatorAbort:
        """What an abort raises."""
        return OperatorAbort(f"the operator aborted{' the run' * self.in_run}")

    def keys(self, *, pedal: bool = False) -> str:
        """The possible answers, always with abort. ``pedal``: a pedal is watched."""
        abort = f"? = explain, a = abort{' the run' * self.in_run}"
        if self.kind == "coordinates":
            return f"x y z, then Enter ({abort}): "
        go = "Enter or a pedal to go on" if pedal and self.pedal else "Enter to go on"
        if self.press:
            return f"{go} ({'s, r, ' * self.in_trial}? or a as before): "
        if self.hidden_to:
            ends = f"first the numbers of hidden teat ends ({range_text(1, self.hidden_to)})"
            ends = "first 1 where the teat's end is hidden" if self.hidden_to == 1 else ends
            go = f"Enter when it stands; {ends}"
        trial = "s REASON = skip the trial, r = repeat it, " * self.in_trial
        enough = "e = enough, go on with what there is, " * self.enough
        return f"{go}\n({trial}{enough}{abort}): "

    @property
    def allowed(self) -> str:
        """What may be answered, in a sentence."""
        if self.kind == "coordinates":
            return 'Three or six numbers are wanted: "-110.20 284.20 134.20".'
        ends = list[str]()
        if self.hidden_to == 1:
            ends = ['1 where the end is hidden: "1"']
        elif self.hidden_to:
            such = "2 4" if self.hidden_to >= 4 else "2"
            ends = [f'the hidden ends\' numbers, 1 to {self.hidden_to}: "{such}"']
        trial = ["s REASON", "r"] if self.in_trial else []
        keys = ["Enter", *ends, *trial, *(["e"] if self.enough else []), "?"]
        return f"There are {', '.join(keys)} and a."

    def explained(self) -> str:
        """Why it is asked, and what each answer does."""
        trial = (
            "Skip: the trial gets no result, and the report lists it with your reason.\n"
            "Repeat: its pictures and touches are dropped.\n"
        )
        enough = "Enough: it is calibrated from what was shown so far.\n"
        abort = "the bath goes to standby, the stage stops. What was finished is kept"
        if not self.in_run:
            abort = "the command ends. Pictures that were taken are kept, nothing else is written"
        return (
            f"{explained()[self.kind]}\n{trial * self.in_trial}{enough * self.enough}"
            f"Abort: {abort}.\n"
            "There is no hurry; nothing is lost by taking long."
        )


def point_in(answer: str) -> tuple[str, ...]:
    """The three or six numbers in an answer to `Coordinates`. Raises NotUnderstoodError."""
    cells = tuple(answer.replace(";", " ").replace(",", ".").split())
    try:
        if len(cells) not in (3, 6) or not math.isfinite(sum(map(float, cells))):
            raise ValueError
    except ValueError:
        allowed = Prompt("coordinates", "").allowed
        raise NotUnderstoodError(f"Not understood: {answer.strip()!r}.", allowed) from None
    return cells


def understood(answer: str, prompt: Prompt) -> frozenset[int]:
    """The numbers of hidden teat ends in ``answer``. Raises OperatorAbort, OperatorRepeat,
    OperatorEnough, OperatorSkip (the reason may be empty), NotUnderstoodError.
    """
    if not " ".join(answer.split()).isprintable():
        why = f"Not understood: {answer.strip()!r}. Arrow keys edit nothing here; backspace does."
        raise NotUnderstoodError(why, prompt.allowed)
    words = [word for word in re.split(r"[\s,;+&]+", answer.lower()) if word]
    first, *more = words or (GO if not answer.strip() else ("",))
    reason = " ".join(answer.split()[1:])
    if first in ABORT and not more:
        raise prompt.aborted
    if prompt.in_trial and first in REPEAT:
        raise OperatorRepeat(reason)
    if prompt.enough and first in ENOUGH and not more:
        raise OperatorEnough("the operator has shown enough")
    if prompt.in_trial and first in SKIP:
        raise OperatorSkip("" if reason.lower() in KEYS else reason)
    if prompt.kind == "coordinates":
        point_in(answer)
        return frozenset()
    if first in GO and not more:
        return frozenset()
    numbers = more if first == "hidden" and more else words
    numbers = [word for word in numbers if word != "and"]
    if numbers and all(word.isdecimal() and 1 <= int(word) <= prompt.hidden_to for word in numbers):
        return frozenset(map(int, numbers))
    raise NotUnderstoodError(f"Not understood: {answer.strip()!r}.", prompt.allowed)


def hidden_text(hidden: Collection[int]) -> str:
    """``Hidden: teat ends 2 and 4.``"""
    *others, last = map(str, sorted(hidden))
    ends = f"teat ends {', '.join(others)} and {last}" if others else f"teat end {last}"
    return f"Hidden: {ends}."


def check_words(words: str, prompt: Prompt) -> None:
    """Raises ValueError for words that ``prompt`` doesn't understand; a skip needs a reason."""
    try:
        understood(words, prompt)
    except OperatorSkip as skip:
        if not skip.reason:
            raise ValueError("a skipped trial needs a reason, for the record") from skip
    except (OperatorAbort, OperatorRepeat, OperatorEnough):
        return


def time_left(seconds: float) -> str:
    """A length of time in words: "about 12 min left"."""
    if seconds < 60.0:
        return "less than a minute left"
    if (minutes := round(seconds / 60.0)) < 100:
        return f"about {minutes} min left"
    return f"about {round(seconds / 3600.0, 1):g} h left"
