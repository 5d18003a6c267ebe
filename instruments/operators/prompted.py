"""Operators who are asked in words, with the run's progress; one answers from a list.

Answers of the list go in order, each to the first prompt that it fits; other prompts get
``otherwise`` by kind. A prompt without either and answers left over are errors. The answer to a
teat's first touch is that to all of them, but where the next one of the list names a later press.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

from instruments.errors import ProtocolError
from instruments.operators import operator as op
from instruments.world.phantom import called
from instruments.world.situations import spoken
from textfiles.text import plural

# in an answer that names hidden ends; how many there are is known only when it is given
MOST_TEATS = 99
KINDS: tuple[op.Kind, ...] = tuple(kind for kind in get_args(op.Kind) if kind != "task")
LEANS = (
    "upright",
    "leaning to the left",
    "leaning to the right",
    "leaning towards you",
    "leaning away from you",
)


class PromptedOperator(ABC):
    """``hands`` do what each "go on" agreed to; ``before_touch`` is called before each touch.
    ``in_run``: the prompts are those of a run, else of a calibration or of the arm's check.
    """

    hands: op.Operator | None = None
    in_run = True
    before_touch: Callable[[], None] = staticmethod(op.no_check)
    _trial: op.NextTrial | None = None
    _stands: tuple[op.Arrangement, frozenset[int]] | None = None

    @abstractmethod
    def answer(self, prompt: op.Prompt, check: Callable[[], None]) -> str:
        """Words that answer the prompt. Raises as `Operator.ask`."""

    @abstractmethod
    def say(self, text: str) -> None:
        """Show ``text``."""

    def finish(self) -> None:  # noqa: B027 - not abstract: a person's answers are never left over
        """Nothing more will be asked. Raises ProtocolError where answers are left over."""

    def ask(self, request: op.Request, check: Callable[[], None] = op.no_check) -> op.Answer:
        hidden: frozenset[int] = frozenset()
        if isinstance(request, op.Coordinates):
            return op.Answer(point=op.point_in(self._asked(request, check)))
        if isinstance(request, op.Finish):
            self.finish()
        elif isinstance(request, op.NextTrial):
            self._trial = request
        elif isinstance(request, op.Release):
            if not request.lost:
                self.say("Readings taken; the arm may be put away.")
        elif isinstance(request, op.Arrangement):
            hidden = self._set_up(request, check)
        else:
            self._asked(request, check)
        seen = op.DONE if self.hands is None else self.hands.ask(request, check)
        if not isinstance(request, op.Arrangement) or (seen.visible and not hidden):
            return seen
        return op.Answer(tuple(teat not in hidden for teat in range(1, request.teats + 1)))

    def _set_up(self, request: op.Arrangement, check: Callable[[], None]) -> frozenset[int]:
        attended = replace(request, unattended=False)
        if request.unattended and self._stands and self._stands[0] == attended:
            hidden = self._stands[1]
        else:
            words = self._asked(request, check)
            hidden = op.understood(words, op.Prompt("set up", "", hidden_to=request.teats))
            if hidden:
                self.say(op.hidden_text(hidden))
        self._stands = attended, hidden
        return hidden

    def _asked(self, request: op.Awaited, check: Callable[[], None]) -> str:
        if isinstance(request, op.CheckPoint | op.Touch | op.BoardTouch) and request.again:
            self.say(request.again)
        prompt = replace(self.prompt(request), in_run=self.in_run)
        if prompt.pedal:
            self.before_touch()
        try:
            words = self.answer(prompt, check)
            op.understood(words, prompt)
        except (op.OperatorSkip, op.OperatorRepeat):
            if self.hands:
                self.hands.ask(op.Release())
            raise
        return words

    def prompt(self, request: op.Awaited) -> op.Prompt:
        """``request`` in words."""
        match request:
            case op.Homing(instruction):
                return op.Prompt("homing", instruction)
            case op.CheckPoint(touch, of, _):
                text = "Arm check: put the tip into the divot of the check point, the stylus"
                text += f" {LEANS[(touch - 1) % len(LEANS)]}, and hold it still."
                return op.Prompt("check point", text, progress=f"touch {touch} of {of}", pedal=True)
            case op.Arrangement():
                return self._set_up_prompt(request)
            case op.Touch():
                return self._touch_prompt(request)
            case op.BoardPose():
                at = f"{'position' if request.fixed else 'view'} {request.number}"
                text, enough = request.instruction, not request.fixed
                return op.Prompt("board", text, progress=at, pedal=True, enough=enough)
            case op.BoardTouch():
                return op.Prompt("corner", request.instruction, pedal=True)
            case op.Task(text, pedal):
                return op.Prompt("task", text, pedal=pedal)
            case op.Coordinates(text):
                return op.Prompt("coordinates", text)

    def _set_up_prompt(self, request: op.Arrangement) -> op.Prompt:
        """In coordinates and with the picture, unless it stands so already."""
        name = request.phantom.name  # none of a family's
        scene = f"Situation {spoken(request.situation)}{name and f', layout {name}'}:"
        if self._stands and self._stands[0] == replace(request, unattended=False):
            more = ["It stands so already: put the arm away and step out of the cameras' view."]
        else:
            more = [request.details, f"Picture: {request.picture}" if request.picture else ""]
        text = "\n".join(filter(None, (scene, request.instruction, *more)))
        return self._prompt("set up", text, hidden_to=request.teats)

    def _touch_prompt(self, request: op.Touch) -> op.Prompt:
        """By the teat's name, with how many touches of the trial are left."""
        teat, of = request.teat, request.of
        teats = self._stands[0].phantom.teats if self._stands else ()
        name = teats[teat - 1].name if teat <= len(teats) else ""
        which = f"{called(teat, name)}{',' if name else ''}"
        ends, after = (of, of - teat) if self._trial else (1, 0)  # outside of trials it is one end
        left = (after + 1) * request.numbers - request.number + 1
        left_of = f"{left} of {ends * request.numbers}"
        if request.press:
            progress = f"press {request.number} of {request.numbers}, {left_of} left"
            text = "Lift the tip, then touch the same end again."
            return op.Prompt("touch", text, progress=progress, pedal=True, press=True)
        if request.again:
            text = f"Once more: touch the end of {which} with the tip and hold it still."
        else:
            text = f"Touch the end of {which} with the tip and hold it still."
            if request.numbers > 1:
                text = f"{text.rstrip('.')}: {request.numbers} touches, lifted in between."
        further = f"teat {teat} of {of}", f"{left_of} touches left"
        return self._prompt("touch", text, *further, pedal=True)

    def _prompt(self, kind: op.Kind, text: str, *further: str, **more: Any) -> op.Prompt:
        """Amid the trial under way."""
        if (trial := self._trial) is None:
            return op.Prompt(kind, text, ", ".join(further), **more)
        said, left_s = ", ".join([f"trial {trial.number} of {trial.of}", *further]), trial.left_s()
        left = "" if left_s is None else op.time_left(left_s)
        return op.Prompt(kind, text, said, left=left, **more)


@dataclass(frozen=True, slots=True)
class ScriptedAnswer:
    """``answer`` as typed, ``times`` times, to prompts of kind ``to`` that contain ``says``. As
    `check_answer` has accepted it.
    """

    to: op.Kind
    answer: str
    says: str = ""
    times: int = 1
    where: str = ""

    def fits(self, prompt: op.Prompt) -> bool:
        """Whether it answers this prompt."""
        text = f"{prompt.progress} {prompt.text}".lower()
        return prompt.kind == self.to and self.says.lower() in text

    def __str__(self) -> str:
        says = f" that says {self.says!r}" if self.says else ""
        where = f" ({self.where})" if self.where else ""
        return f"{self.answer!r} to a prompt of the kind {self.to!r}{says}{where}"


def check_answer(to: op.Kind, answer: str) -> None:
    """Raises ValueError for an answer that a prompt of the kind ``to`` can't be given."""
    prompt = op.Prompt(to, "", hidden_to=MOST_TEATS if to == "set up" else 0, enough=to == "board")
    try:
        op.check_words(answer, prompt)
    except op.NotUnderstoodError as error:
        hidden = ', "hidden 2 4"' if to == "set up" else ""
        trial = f', "skip REASON", "repeat"{hidden}' if prompt.in_trial else ""
        enough = ', "enough"' if prompt.enough else ""
        go = '"X Y Z"' if to == "coordinates" else '"go"'
        there = f'to a prompt of the kind "{to}" there are {go}{trial}{enough}, "abort"'
        raise ValueError(f"{error.wrong.rstrip('.')}; {there}") from error


class ScriptedAnswers(PromptedOperator):
    """Answers from a list. ``source`` is for errors, ``show`` gets prompts and answers."""

    def __init__(
        self,
        answers: Sequence[ScriptedAnswer],
        otherwise: Mapping[op.Kind, str],
        source: str,
        *,
        show: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._answers = [one for one in answers for _ in range(one.times)]
        self._otherwise = dict(otherwise)
        self._source = source
        self._show = show
        self._given = 0

    def say(self, text: str) -> None:
        self._show(text)

    def answer(self, prompt: op.Prompt, check: Callable[[], None]) -> str:
        check()
        if prompt.press and not self._names(prompt):
            return op.GO[0]
        answer = self._next(prompt)
        self._show(f"{prompt.head}{prompt.text} > {answer}")
        try:
            op.understood(answer, prompt)
        except op.NotUnderstoodError as error:
            teats = f"There are {prompt.hidden_to} teats here"
            what, hint = (
                f"{error.wrong} {teats}" if prompt.hidden_to else str(error).rstrip("."),
                f"Correct {self._source}.",
            )
            asked = f"{prompt.kind}: {prompt.head}{prompt.text}"
            raise ProtocolError("operator", what, asked=asked, hint=hint) from error
        return answer

    def finish(self) -> None:
        # how often the check point is touched is the run's to say
        if left := [one for one in self._answers[self._given :] if one.to != "check point"]:
            ended = "the run has ended" if self.in_run else "nothing more is asked"
            answers = plural(len(left), "answer")
            were = "was" if len(left) == 1 else "were"
            what = f"{ended} and {answers} of {self._source} {were} never asked for"
            hint = "Take them out, or correct the prompts that they are for."
            raise ProtocolError("operator", f"{what}; the first is {left[0]}", hint=hint)

    def _names(self, prompt: op.Prompt) -> bool:
        """Whether the next answer of the list says words of just this prompt."""
        following = next(iter(self._answers[self._given :]), None)
        return bool(following and following.says and following.fits(prompt))

    def _next(self, prompt: op.Prompt) -> str:
        following = next(iter(self._answers[self._given :]), None)
        if following and following.fits(prompt):
            self._given += 1
            return following.answer
        if prompt.kind in self._otherwise:
            return self._otherwise[prompt.kind]
        what = f"{self._source} has no answer to this prompt"
        asked = f"{prompt.kind}: {prompt.head}{prompt.text}"
        seen = str(following) if following else "no further answer"
        add = f'Add an answer to = "{prompt.kind}" before it'
        hint = f'{add}, or one for all such prompts under "otherwise".'
        raise ProtocolError("operator", what, asked=asked, seen=seen, hint=hint)
