"""Who is asked in a rehearsal: a person who takes as long as persons take, or a script of answers; prompts are counted.

A run that takes a person days would take the clock as many bath readings: then a part of each prompt passes on the clock, and the rest is
only booked. May not know the world.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from bench.rehearsing.time_spent import CAPTURES, MOVES, SET_UPS, TOUCHES, TimeSpent
from instruments.clock import Clock
from instruments.operators.operator import Arrangement, BoardAsked, Operator, Placed
from instruments.operators.prompt import Prompt
from instruments.operators.prompted import Answerer

LOOK_S = 1.0  # between two looks at the interlocks


class Person:
    """Answers prompts. ``seconds`` has "set-up", "placing" and "touch"; ``on_clock`` is the share of them that passes on the clock.

    ``beside_s`` is what each prompt takes whoever answers, and the clock doesn't see. ``answers``, where given, are said instead of a
    plain "go on". ``next_set_up_s`` is how long the next set-up takes.
    """

    def __init__(
        self,
        clock: Clock,
        seconds: Mapping[str, float],
        spent: TimeSpent,
        on_clock: float = 1.0,
        *,
        beside_s: float = 0.0,
        answers: Answerer | None = None,
    ) -> None:
        self._clock = clock
        self._seconds = seconds
        self._spent = spent
        self._on_clock = on_clock
        self._beside_s = beside_s
        self._answers = answers
        self.next_set_up_s = 0.0
        self.asked = 0

    def ask(self, prompt: Prompt, check: Callable[[], None]) -> frozenset[int]:
        self.asked += 1
        takes = {"homing": self._seconds["placing"], "set up": self.next_set_up_s}
        seconds = takes.get(prompt.kind, self._seconds["touch"])
        self._spent.book(seconds * (1.0 - self._on_clock) + self._beside_s)
        end_s = self._clock.now() + seconds * self._on_clock
        check()
        while (left_s := end_s - self._clock.now()) > 0.0:
            self._clock.sleep(min(LOOK_S, left_s))
            check()
        return self._answers.ask(prompt, check) if self._answers else frozenset()

    def say(self, text: str) -> None:
        if self._answers:
            self._answers.say(text)

    def finish(self) -> None:
        if self._answers:
            self._answers.finish()


class TimedOperator:
    """Has ``operator`` do what is asked, tells ``spent`` what that is, and ``person`` how long a set-up takes: as `trial_time` has it."""

    def __init__(self, operator: Operator, person: Person, spent: TimeSpent, seconds: Mapping[str, float]) -> None:
        self._operator = operator
        self._person = person
        self._spent = spent
        self._seconds = seconds
        self._stands: Arrangement | None = None

    def heed(self, check: Callable[[], None]) -> None:
        self._operator.heed(check)

    def next_trial(self, number: int, of: int, left_s: float | None) -> None:
        self._spent.work(MOVES)
        self._operator.next_trial(number, of, left_s)

    def confirm_homing(self, instruction: str) -> None:
        self._operator.confirm_homing(instruction)

    def touch_check_point(self, touch: int, of: int) -> None:
        self._spent.asking(TOUCHES)
        self._operator.touch_check_point(touch, of)

    def set_up(self, arrangement: Arrangement) -> Placed:
        self._spent.asking(SET_UPS)
        self._person.next_set_up_s = self._takes_s(arrangement)
        placed = self._operator.set_up(arrangement)
        self._stands = arrangement
        self._spent.work(CAPTURES)
        return placed

    def touch(self, teat: int, of: int, *, number: int = 1, numbers: int = 1, again: str = "") -> None:
        self._spent.asking(TOUCHES)
        self._operator.touch(teat, of, number=number, numbers=numbers, again=again)

    def hold_board(self, asked: BoardAsked) -> None:
        self._operator.hold_board(asked)

    def touch_board(self, corner: int, instruction: str, *, again: str = "") -> None:
        self._operator.touch_board(corner, instruction, again=again)

    def release(self) -> None:
        self._operator.release()
        self._spent.work(MOVES)

    def finish(self) -> None:
        self._operator.finish()

    def _takes_s(self, wanted: Arrangement) -> float:
        before = self._stands
        if before is None or (before.phantom, before.objects, before.scene) != (wanted.phantom, wanted.objects, wanted.scene):
            return self._seconds["set-up"]
        return self._seconds["placing"] if before.pose != wanted.pose else 0.0
