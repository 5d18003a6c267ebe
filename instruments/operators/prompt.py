"""What an operator is asked, and what his words mean: values and pure functions, the same for a terminal and a script of answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from instruments.operators.operator import OperatorAbort, OperatorEnough, OperatorRepeat, OperatorSkip

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
    "homing": "The arm counts its joints' angles from where they are when it is switched on. Away from its peg every point would be wrong.",
    "check point": "The check point's place is known: the readings there show whether the arm measures right.",
    "set up": "The cameras take their pictures after your answer, so step out of their view. A teat end is hidden where at least one "
    "camera can't see it; it doesn't count as missed.",
    "touch": "Where the tip is when you go on is the truth that the detectors are scored against. A touch that doesn't fit is asked for "
    "again, and the reason stands above the question.",
    "board": "The cameras take a picture of the board after your answer. Hold it still, the whole pattern in each camera's view.",
    "corner": "Where the tip is when you go on ties the board's corners to the arm's frame.",
    "task": "The bench goes on when this is done.",
}


class NotUnderstoodError(ValueError):
    """The words are no answer to this prompt; the text says what would be."""


@dataclass(frozen=True, slots=True)
class Prompt:
    """``text`` says what to do and ``progress`` how far the run is; ``pedal``: a pedal is as good as Enter.

    ``hidden_to`` above 0 lets the answer be numbers of hidden teat ends, 1 to that many. ``enough``: it may be answered by that word.
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
        """What may be answered, the abort always among it. ``pedal``: there is one, and it is watched."""
        go = "Enter or a pedal to go on" if pedal and self.pedal else "Enter to go on"
        if self.hidden_to:
            go = f"Enter when it stands; if teat ends are hidden from a camera, their numbers first (1 to {self.hidden_to})"
        trial = ["s REASON = skip this trial", "r = repeat it from its set-up"] if self.in_trial else []
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

    Raises OperatorAbort, OperatorRepeat, OperatorEnough, OperatorSkip (with an empty reason where none was given), or NotUnderstoodError.
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
    if prompt.hidden_to and all(word.isdecimal() and 1 <= int(word) <= prompt.hidden_to for word in numbers):
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
