"""A script of answers in the place of a person, for CI and rehearsals.

Answers go in order, each to the first prompt that it fits; other prompts get ``otherwise`` by kind.
A prompt without either and answers left over are errors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

from instruments.errors import ProtocolError
from instruments.operators.operator import (
    Kind,
    NotUnderstoodError,
    OperatorAbort,
    OperatorEnough,
    OperatorRepeat,
    OperatorSkip,
    Prompt,
    understood,
)
from instruments.operators.prompted import PromptedOperator

# in an answer that names hidden ends; how many there are is known only when it is given
MOST_TEATS = 99
KINDS: tuple[Kind, ...] = tuple(kind for kind in get_args(Kind) if kind != "task")


@dataclass(frozen=True, slots=True)
class ScriptedAnswer:
    """``answer`` as typed, ``times`` times to prompts of kind ``to`` that contain ``says``.
    ``where``: its place in the file. Raises ValueError for an answer that no such prompt
    understands.
    """

    to: Kind
    answer: str
    says: str = ""
    times: int = 1
    where: str = ""

    def __post_init__(self) -> None:
        check_answer(self.to, self.answer)
        if self.times < 1:
            raise ValueError(f"an answer is given at least once, not {self.times} times")

    def fits(self, prompt: Prompt) -> bool:
        """Whether it answers this prompt."""
        return (
            prompt.kind == self.to
            and self.says.lower() in f"{prompt.progress} {prompt.text}".lower()
        )


def check_answer(to: Kind, answer: str) -> None:
    """Raises ValueError for an answer that a prompt of the kind ``to`` can't be given."""
    prompt = Prompt(to, "", hidden_to=MOST_TEATS if to == "set up" else 0, enough=to == "board")
    try:
        understood(answer, prompt)
    except NotUnderstoodError as error:
        hidden = ', "hidden 2 4"' if to == "set up" else ""
        trial = f', "skip REASON", "repeat"{hidden}' if prompt.in_trial else ""
        enough = ', "enough"' if prompt.enough else ""
        there = f'to a prompt of the kind "{to}" there are "go"{trial}{enough}, "abort"'
        raise ValueError(f"{str(error).rstrip('.')}; {there}") from error
    except OperatorSkip as skip:
        if not skip.reason:
            raise ValueError('"skip" needs a reason: "skip the teat came off"') from skip
    except (OperatorAbort, OperatorRepeat, OperatorEnough):
        return


class ScriptedAnswers(PromptedOperator):
    """Answers from a list. ``source`` is for errors, ``show`` gets prompts and answers."""

    def __init__(
        self,
        answers: Sequence[ScriptedAnswer],
        otherwise: Mapping[Kind, str],
        source: str,
        *,
        show: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._answers = [one for one in answers for _ in range(one.times)]
        self._otherwise = dict(otherwise)
        self._source = source
        self._show = show
        self._given = 0
        for kind, answer in otherwise.items():
            check_answer(kind, answer)

    def say(self, text: str) -> None:
        self._show(text)

    def answer(self, prompt: Prompt, check: Callable[[], None]) -> frozenset[int]:
        check()
        answer = self._next(prompt)
        self._show(f"{_words(prompt)} > {answer}")
        try:
            return understood(answer, prompt)
        except NotUnderstoodError as error:
            what, hint = (
                f"{error} There are {prompt.hidden_to} teats here",
                f"Correct {self._source}.",
            )
            asked = f"{prompt.kind}: {_words(prompt)}"
            raise ProtocolError("operator", what, asked=asked, hint=hint) from error

    def finish(self) -> None:
        if left := self._answers[self._given :]:
            what = (
                f"the run has ended and {len(left)} answers of {self._source} were never asked for"
            )
            hint = "Take them out, or correct the prompts that they are for."
            raise ProtocolError("operator", f"{what}; the first is {_told(left[0])}", hint=hint)

    def _next(self, prompt: Prompt) -> str:
        following = self._answers[self._given] if self._given < len(self._answers) else None
        if following is not None and following.fits(prompt):
            self._given += 1
            return following.answer
        if prompt.kind in self._otherwise:
            return self._otherwise[prompt.kind]
        seen = _told(following) if following else "no further answer"
        what, asked = (
            f"{self._source} has no answer to this prompt",
            f"{prompt.kind}: {_words(prompt)}",
        )
        add = f'Add an answer to = "{prompt.kind}" before it'
        hint = f'{add}, or one for all such prompts under "otherwise".'
        raise ProtocolError("operator", what, asked=asked, seen=seen, hint=hint)


def _words(prompt: Prompt) -> str:
    return f"[{prompt.progress}] {prompt.text}" if prompt.progress else prompt.text


def _told(answer: ScriptedAnswer) -> str:
    says = f" that says {answer.says!r}" if answer.says else ""
    return f"{answer.answer!r} to a prompt of the kind {answer.to!r}{says}" + (
        f" ({answer.where})" if answer.where else ""
    )
