"""The emulated operator's hands, who look whether the arm reaches before they try: what it can't
reach is met, not waited for.

An arm that is pulled too far hangs up, and the bench would take it for one that has lost its cable.
A person may lean the stylus.

Who is asked in a rehearsal: a person who takes as long as persons take, or a script of answers;
prompts are counted.

A run that takes a person days would take the clock as many bath readings: then a part of each
prompt passes on the clock, and the rest is only booked. May not know the world.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from bench.rig.emulated_rig import EmulatedRig
from bench.rig.emulation_model import Placed as ArmPlaced
from bench.run.estimate import CAPTURES, MOVES, SET_UPS, TOUCHES, TimeSpent
from detector.geometry import Motion
from instruments.clock import Clock
from instruments.microscribe.kinematics import OutOfReachError, inverse
from instruments.operators.operator import (
    Arrangement,
    BoardAsked,
    Operator,
    OperatorAbort,
    OperatorSkip,
    Placed,
    Prompt,
)
from instruments.operators.prompted import Answerer

Floats = NDArray[np.float64]


class ReachingHands:
    """The operator of ``twin``, whose arm stands at ``placed``. ``met`` gets what is out of reach;
    ``leans`` where a person touches.
    """

    def __init__(
        self, twin: EmulatedRig, placed: ArmPlaced, met: Callable[[str, str], None], *, leans: bool
    ) -> None:
        self._twin = twin
        self._hands = twin.operator
        self._arm_from_world = Motion.from_vectors(placed.om, placed.T).inverse()
        self._met = met
        self._leans = leans
        # to within a millimetre, how the stylus was held: nobody solves the same pose twice
        self._reached: dict[bytes, Floats] = {}

    def check_interrupts(self, check: Callable[[], None]) -> None:
        self._hands.check_interrupts(check)

    def next_trial(self, number: int, of: int, left_s: float | None) -> None:
        self._hands.next_trial(number, of, left_s)

    def confirm_homing(self, instruction: str) -> None:
        self._hands.confirm_homing(instruction)

    def touch_check_point(self, touch: int, of: int) -> None:
        """Raises OperatorAbort where the arm doesn't reach the check point."""
        self._hands.touch_check_point(touch, of)
        if why := self._out_of_reach("the check point"):
            raise OperatorAbort(why)

    def set_up(self, arrangement: Arrangement) -> Placed:
        return self._hands.set_up(arrangement)

    def touch(
        self, teat: int, of: int, *, number: int = 1, numbers: int = 1, again: str = ""
    ) -> None:
        """Raises OperatorSkip where the arm doesn't reach the teat's end."""
        self._hands.touch(teat, of, number=number, numbers=numbers, again=again)
        if why := self._out_of_reach(
            f"the end of teat {self._twin.world.phantom().teats[teat - 1].name or teat}"
        ):
            raise OperatorSkip(why)

    def hold_board(self, asked: BoardAsked) -> None:
        self._hands.hold_board(asked)

    def touch_board(self, corner: int, instruction: str, *, again: str = "") -> None:
        self._hands.touch_board(corner, instruction, again=again)

    def release(self) -> None:
        self._hands.release()

    def finish(self) -> None:
        self._hands.finish()

    def _out_of_reach(self, what: str) -> str:
        """Empty where the arm gets there, leaning if need be; else the tip is let go of, and why is
        met and given back.
        """
        world, held = self._twin.world, self._twin.world.arm_target()
        if held is None:
            return ""
        point, axis = held
        key = np.round(point).tobytes() + axis.tobytes()
        if key not in self._reached:
            way = self._way(point, axis)
            if way is None:
                world.hold(None)
                why = f"the arm doesn't reach {what} at {np.round(point).astype(int).tolist()} mm"
                self._met("reach", why)
                return why
            self._reached[key] = way
        world.hold(point, self._reached[key])
        return ""

    def _way(self, point_mm: Floats, axis: Floats) -> Floats | None:
        """The stylus's direction (3,), world frame, in which the tip gets to (3,): ``axis`` if it
        can be, else any for who leans.
        """
        arm, there = self._twin.arm, self._arm_from_world.apply(point_mm)
        try:
            arm.check_reach(there, np.asarray(self._arm_from_world.R @ axis))
        except OutOfReachError:
            return self._leaning(there) if self._leans else None
        return axis

    def _leaning(self, there_mm: Floats) -> Floats | None:
        """As the arm likes, at (3,) in its own frame."""
        unit = self._twin.arm.unit
        geometry = unit.geometry()
        try:
            counts = inverse(geometry, there_mm, None, start=unit.home)
        except OutOfReachError:
            return None
        _, axes = geometry.forward(counts)
        return np.asarray(self._arm_from_world.R.T @ axes[0])


LOOK_S = 1.0  # between two looks at the interlocks


class Person:
    """Answers prompts. ``seconds`` has "set-up", "placing" and "touch"; ``on_clock`` is the share
    of them that passes on the clock.

    ``beside_s`` is what each prompt takes whoever answers, and the clock doesn't see. ``answers``,
    where given, are said instead of a plain "go on". ``next_set_up_s`` is how long the next set-up
    takes.
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
    """Has ``operator`` do what is asked, tells ``spent`` what that is, and ``person`` how long a
    set-up takes: as `trial_time` has it.
    """

    def __init__(
        self, operator: Operator, person: Person, spent: TimeSpent, seconds: Mapping[str, float]
    ) -> None:
        self._operator = operator
        self._person = person
        self._spent = spent
        self._seconds = seconds
        self._stands: Arrangement | None = None

    def check_interrupts(self, check: Callable[[], None]) -> None:
        self._operator.check_interrupts(check)

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

    def touch(
        self, teat: int, of: int, *, number: int = 1, numbers: int = 1, again: str = ""
    ) -> None:
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
        if before is None or (before.phantom, before.objects, before.scene) != (
            wanted.phantom,
            wanted.objects,
            wanted.scene,
        ):
            return self._seconds["set-up"]
        return self._seconds["placing"] if before.pose != wanted.pose else 0.0
