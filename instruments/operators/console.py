"""A person at a terminal: says what to do, waits for Enter, and takes an abort at any prompt.

Who holds the arm has no hand free: where a touch is asked for, a pedal is as good as Enter. The streams are arguments, so
that a test can be the person. It may not read the clock: a person takes what it takes.
"""

from __future__ import annotations

import select
import sys
from collections.abc import Callable
from typing import TextIO

from instruments.operators.operator import Arrangement, OperatorAbort, Placed

LEANS = ("upright", "leaning to the left", "leaning to the right", "leaning towards you", "leaning away from you")
PEDAL_S = 0.2  # how long the pedals are watched before the keyboard is looked at again
ABORT = ("a", "abort", "q", "quit")


Pedal = Callable[[float], bool]


class ConsoleOperator:
    """Prompts on ``out`` and reads answers from ``answers``. The end of the answers is an abort.

    ``watch`` is called for each touch that is asked for, and gives back what waits some seconds and says whether a pedal was
    pressed; only where ``answers`` is a terminal.
    """

    def __init__(self, answers: TextIO, out: TextIO, *, watch: Callable[[], Pedal] | None = None) -> None:
        self._answers = answers
        self._out = out
        self._watch: Callable[[], Pedal] | None = None
        if watch:
            self.watch_pedals(watch)

    def watch_pedals(self, watch: Callable[[], Pedal]) -> None:
        """From now on a pedal is as good as Enter where a touch is asked for."""
        self._watch = watch if self._answers.isatty() else None

    def confirm_homing(self, instruction: str) -> None:
        self._ask(instruction)

    def set_up(self, arrangement: Arrangement) -> Placed:
        self.say(f"\nSituation {arrangement.situation}, layout {arrangement.layout}:")
        hidden = self._ask(
            arrangement.instruction,
            f"Enter when it stands; if teat ends are hidden from a camera, their numbers first (1 to {arrangement.teats})",
            numbers_to=arrangement.teats,
        )
        return Placed(tuple(teat not in hidden for teat in range(1, arrangement.teats + 1)))

    def touch_check_point(self, touch: int, of: int) -> None:
        lean = LEANS[(touch - 1) % len(LEANS)]
        self.ask_touch(f"Arm check, {touch} of {of}: put the tip into the divot of the check point, the stylus {lean}, and hold it still.")

    def touch(self, teat: int, of: int) -> None:
        self.ask_touch(f"Touch the end of teat {teat} of {of} with the tip and hold it still.")

    def release(self) -> None:
        self.say("Reading taken.")

    def ask(self, text: str) -> None:
        """Return once the person has done what ``text`` says. Raises OperatorAbort."""
        self._ask(text)

    def ask_touch(self, text: str) -> None:
        """As ``ask``, and a pedal is as good as Enter. Raises OperatorAbort, and what reading the pedals raises."""
        self._ask(text, "Enter or a pedal to go on" if self._watch else "Enter to go on", pedal=self._watch() if self._watch else None)

    def say(self, text: str) -> None:
        self._out.write(text + "\n")
        self._out.flush()

    def _ask(self, text: str, then: str = "Enter to go on", numbers_to: int = 0, pedal: Pedal | None = None) -> set[int]:
        self.say(text)
        while True:
            self._out.write(f"{then} (a = abort the run): ")
            self._out.flush()
            line = self._line(pedal)
            words = line.replace(",", " ").lower().split()
            if not line or (words and words[0] in ABORT):
                raise OperatorAbort("the operator aborted the run" if line else "nobody is at the terminal any more")
            if not words:
                return set()
            if numbers_to and all(word.isdigit() and 1 <= int(word) <= numbers_to for word in words):
                return {int(word) for word in words}
            self.say(f"Not understood: {line.strip()!r}.")

    def _line(self, pedal: Pedal | None) -> str:
        while pedal is not None and not _typed(self._answers):
            if pedal(PEDAL_S):
                self._out.write("\n")
                return "\n"
        return self._answers.readline()


if sys.platform == "win32":
    import msvcrt

    def _typed(_: TextIO) -> bool:
        return bool(msvcrt.kbhit())

else:

    def _typed(answers: TextIO) -> bool:
        """Whether a line waits at the terminal, or its end."""
        return bool(select.select([answers], [], [], 0.0)[0])
