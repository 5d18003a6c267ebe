"""An operator who is asked in words, with the run's progress; the terminal and the file of answers
are two of them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace

from instruments.operators.operator import (
    DONE,
    Answer,
    Arrangement,
    Awaited,
    BoardAsked,
    BoardTouch,
    CheckPoint,
    Finish,
    Homing,
    NextTrial,
    Operator,
    OperatorRepeat,
    OperatorSkip,
    Prompt,
    Release,
    Request,
    Task,
    Touch,
    no_check,
    time_left,
)

LEANS = (
    "upright",
    "leaning to the left",
    "leaning to the right",
    "leaning towards you",
    "leaning away from you",
)


class PromptedOperator(ABC):
    """``hands``, if given, do what was agreed: emulated ones, that follow each "go on"."""

    hands: Operator | None = None
    _trial: NextTrial | None = None
    _stands: tuple[Arrangement, frozenset[int]] | None = None

    @abstractmethod
    def answer(self, prompt: Prompt, check: Callable[[], None]) -> frozenset[int]:
        """The numbers of hidden teat ends in the answer; ``check`` is called while it waits. Raises
        OperatorAbort, OperatorSkip, OperatorRepeat, what ``check`` raises, and ProtocolError.
        """

    @abstractmethod
    def say(self, text: str) -> None:
        """Show ``text``."""

    def finish(self) -> None:  # noqa: B027 - a person's answers are never left over
        """Nothing more will be asked. Raises ProtocolError where answers are left over."""

    def ask(self, request: Request, check: Callable[[], None] = no_check) -> Answer:
        hidden: frozenset[int] = frozenset()
        if isinstance(request, Finish):
            self.finish()
        elif isinstance(request, NextTrial):
            self._trial = request
        elif isinstance(request, Release):
            self.say("Readings taken; the arm may be put away.")
        elif isinstance(request, Arrangement):
            hidden = self._set_up(request, check)
        else:
            self._asked(request, check)
        seen = DONE if self.hands is None else self.hands.ask(request, check)
        if not isinstance(request, Arrangement) or (seen.visible and not hidden):
            return seen
        return Answer(tuple(teat not in hidden for teat in range(1, request.teats + 1)))

    def _set_up(self, request: Arrangement, check: Callable[[], None]) -> frozenset[int]:
        attended = replace(request, unattended=False)
        if request.unattended and self._stands and self._stands[0] == attended:
            hidden = self._stands[1]
        else:
            hidden = self._asked(request, check)
        self._stands = attended, hidden
        return hidden

    def _asked(self, request: Awaited, check: Callable[[], None]) -> frozenset[int]:
        if isinstance(request, Touch | BoardTouch) and request.again:
            self.say(request.again)
        try:
            return self.answer(self.prompt(request), check)
        except (OperatorSkip, OperatorRepeat):
            if self.hands:
                self.hands.ask(Release())
            raise

    def prompt(self, request: Awaited) -> Prompt:
        """``request`` in words."""
        match request:
            case Homing(instruction):
                return Prompt("homing", instruction)
            case CheckPoint(touch, of):
                text = "Arm check: put the tip into the divot of the check point, the stylus"
                text += f" {LEANS[(touch - 1) % len(LEANS)]}, and hold it still."
                return Prompt("check point", text, progress=f"touch {touch} of {of}", pedal=True)
            case Arrangement():
                scene = f"Situation {request.situation}, layout {request.phantom.name}:"
                text, hidden_to = f"{scene}\n{request.instruction}", request.teats
                return Prompt("set up", text, progress=self._progress(), hidden_to=hidden_to)
            case Touch():
                return self._touch(request)
            case BoardAsked():
                at = f"{'position' if request.fixed else 'view'} {request.number}"
                text, enough = request.instruction, not request.fixed
                return Prompt("board", text, progress=at, pedal=True, enough=enough)
            case BoardTouch():
                return Prompt("corner", request.instruction, pedal=True)
            case Task(text, pedal):
                return Prompt("task", text, pedal=pedal)

    def _touch(self, request: Touch) -> Prompt:
        teats = self._stands[0].phantom.teats if self._stands else ()
        teat, of = request.teat, request.of
        name = teats[teat - 1].name if teat <= len(teats) else ""
        which = f"{teat} ({name})" if name else teat
        do = "Once more: touch" if request.again else "Touch"
        text = f"{do} the end of teat {which} of {of} with the tip and hold it still."
        each = [f"touch {request.number} of {request.numbers}"] if request.numbers > 1 else []
        progress = self._progress(f"teat {teat} of {of}", *each)
        return Prompt("touch", text, progress=progress, pedal=True)

    def _progress(self, *further: str) -> str:
        if self._trial is None:
            return ", ".join(further)
        said = ", ".join([f"trial {self._trial.number} of {self._trial.of}", *further])
        left_s = self._trial.left_s
        return said if left_s is None else f"{said}; {time_left(left_s)}"
