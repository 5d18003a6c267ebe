"""An operator who is asked in words, with the run's progress.

Who answers (terminal or script) is an argument; so are the emulated hands that follow each "go on"
on an emulated rig.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

from instruments.operators.operator import (
    Arrangement,
    BoardAsked,
    Operator,
    OperatorRepeat,
    OperatorSkip,
    Placed,
    Prompt,
    time_left,
)

LEANS = (
    "upright",
    "leaning to the left",
    "leaning to the right",
    "leaning towards you",
    "leaning away from you",
)


class Answerer(Protocol):
    """Who answers prompts."""

    def ask(self, prompt: Prompt, check: Callable[[], None]) -> frozenset[int]:
        """The numbers of hidden teat ends in the answer; ``check`` is called while it waits. Raises
        OperatorAbort, OperatorSkip, OperatorRepeat, what ``check`` raises, and ProtocolError.
        """
        ...

    def say(self, text: str) -> None:
        """Show ``text``."""
        ...

    def finish(self) -> None:
        """Nothing more will be asked. Raises ProtocolError where answers are left over."""
        ...


class PromptedOperator:
    """An `Operator` that asks ``answerer``; ``hands``, if given, do what was agreed."""

    def __init__(self, answerer: Answerer, hands: Operator | None = None) -> None:
        self._answerer = answerer
        self._hands = hands
        self._check: Callable[[], None] = lambda: None
        self._trial: tuple[int, int, float | None] | None = None
        self._names: tuple[str, ...] = ()
        self._stands: tuple[Arrangement, frozenset[int]] | None = None

    def check_interrupts(self, check: Callable[[], None]) -> None:
        self._check = check
        if self._hands:
            self._hands.check_interrupts(check)

    def next_trial(self, number: int, of: int, left_s: float | None) -> None:
        self._trial = (number, of, left_s)
        if self._hands:
            self._hands.next_trial(number, of, left_s)

    def confirm_homing(self, instruction: str) -> None:
        self._ask(Prompt("homing", instruction))
        if self._hands:
            self._hands.confirm_homing(instruction)

    def touch_check_point(self, touch: int, of: int) -> None:
        lean = LEANS[(touch - 1) % len(LEANS)]
        text = (
            f"Arm check: put the tip into the divot of the check point, the stylus {lean}, and hold"
            " it still."
        )
        self._ask(Prompt("check point", text, progress=f"touch {touch} of {of}", pedal=True))
        if self._hands:
            self._hands.touch_check_point(touch, of)

    def set_up(self, arrangement: Arrangement) -> Placed:
        self._names = tuple(teat.name for teat in arrangement.phantom.teats)
        text = (
            f"Situation {arrangement.situation}, layout"
            f" {arrangement.phantom.name}:\n{arrangement.instruction}"
        )
        attended = replace(arrangement, unattended=False)
        if arrangement.unattended and self._stands and self._stands[0] == attended:
            hidden = self._stands[1]
        else:
            hidden = self._ask(
                Prompt("set up", text, progress=self._progress(), hidden_to=arrangement.teats)
            )
        self._stands = attended, hidden
        if self._hands:
            seen = self._hands.set_up(arrangement)
            if not hidden:
                return seen
        return Placed(tuple(teat not in hidden for teat in range(1, arrangement.teats + 1)))

    def touch(
        self, teat: int, of: int, *, number: int = 1, numbers: int = 1, again: str = ""
    ) -> None:
        if again:
            self._answerer.say(again)
        name = self._names[teat - 1] if teat <= len(self._names) else ""
        which = f"{teat} ({name})" if name else f"{teat}"
        text = (
            f"{'Once more: touch' if again else 'Touch'} the end of teat {which} of {of} with the"
            " tip and hold it still."
        )
        progress = self._progress(
            f"teat {teat} of {of}", *([f"touch {number} of {numbers}"] if numbers > 1 else [])
        )
        self._ask(Prompt("touch", text, progress=progress, pedal=True))
        if self._hands:
            self._hands.touch(teat, of, number=number, numbers=numbers, again=again)

    def hold_board(self, asked: BoardAsked) -> None:
        progress = f"{'position' if asked.fixed else 'view'} {asked.number}"
        self._ask(
            Prompt(
                "board", asked.instruction, progress=progress, pedal=True, enough=not asked.fixed
            )
        )
        if self._hands:
            self._hands.hold_board(asked)

    def touch_board(self, corner: int, instruction: str, *, again: str = "") -> None:
        if again:
            self._answerer.say(again)
        self._ask(Prompt("corner", instruction, pedal=True))
        if self._hands:
            self._hands.touch_board(corner, instruction, again=again)

    def release(self) -> None:
        self._answerer.say("Readings taken; the arm may be put away.")
        if self._hands:
            self._hands.release()

    def finish(self) -> None:
        self._answerer.finish()

    def _ask(self, prompt: Prompt) -> frozenset[int]:
        try:
            return self._answerer.ask(prompt, self._check)
        except (OperatorSkip, OperatorRepeat):
            if self._hands:
                self._hands.release()
            raise

    def _progress(self, *further: str) -> str:
        if self._trial is None:
            return ", ".join(further)
        number, of, left_s = self._trial
        said = ", ".join([f"trial {number} of {of}", *further])
        return said if left_s is None else f"{said}; {time_left(left_s)}"
