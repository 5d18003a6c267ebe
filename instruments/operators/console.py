"""A person at a terminal: says what to do, waits for Enter, and takes an abort at any prompt.

The streams are arguments, so that a test can be the person. It may not read the clock: a person takes what it takes.
"""

from __future__ import annotations

from typing import TextIO

from instruments.operators.operator import Arrangement, OperatorAbort, Placed

ABORT = ("a", "abort", "q", "quit")


class ConsoleOperator:
    """Prompts on ``out`` and reads answers from ``answers``. The end of the answers is an abort."""

    def __init__(self, answers: TextIO, out: TextIO) -> None:
        self._answers = answers
        self._out = out

    def confirm_homing(self, instruction: str) -> None:
        self._ask(instruction)

    def set_up(self, arrangement: Arrangement) -> Placed:
        self._say(f"\nSituation {arrangement.situation}, layout {arrangement.layout}:")
        hidden = self._ask(
            arrangement.instruction,
            f"Enter when it stands; if teat ends are hidden from a camera, their numbers first (1 to {arrangement.teats})",
            numbers_to=arrangement.teats,
        )
        return Placed(tuple(teat not in hidden for teat in range(1, arrangement.teats + 1)))

    def touch(self, teat: int, of: int) -> None:
        self._ask(f"Touch the end of teat {teat} of {of} with the tip and hold it still.")

    def release(self) -> None:
        self._say("Reading taken.")

    def _say(self, text: str) -> None:
        self._out.write(text + "\n")
        self._out.flush()

    def _ask(self, text: str, then: str = "Enter to go on", numbers_to: int = 0) -> set[int]:
        self._say(text)
        while True:
            self._out.write(f"{then} (a = abort the run): ")
            self._out.flush()
            line = self._answers.readline()
            words = line.replace(",", " ").lower().split()
            if not line or (words and words[0] in ABORT):
                raise OperatorAbort("the operator aborted the run" if line else "nobody is at the terminal any more")
            if not words:
                return set()
            if numbers_to and all(word.isdigit() and 1 <= int(word) <= numbers_to for word in words):
                return {int(word) for word in words}
            self._say(f"Not understood: {line.strip()!r}.")
