"""The operators of a rehearsal.

`ReachingHands` are the emulated hands, which look whether the arm reaches before they try: an arm
that is pulled too far hangs up, and the bench would take it for one that has lost its cable.
`Person` takes as long as persons take, or gives the answers of a file, and counts what is asked; a
part of that time passes on the clock, and the rest is booked. `TimedOperator` books what the time
goes to.
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
    Answer,
    Arrangement,
    CheckPoint,
    NextTrial,
    Operator,
    OperatorAbort,
    OperatorSkip,
    Prompt,
    Release,
    Request,
    Touch,
    no_check,
)
from instruments.operators.prompted import PromptedOperator

Floats = NDArray[np.float64]
LOOK_S = 1.0  # between two looks at the interlocks


class ReachingHands:
    """The operator of ``twin``, whose arm stands at ``placed``. ``met`` gets what is out of reach;
    ``leans`` where a person touches, who may lean the stylus.
    """

    def __init__(
        self, twin: EmulatedRig, placed: ArmPlaced, met: Callable[[str, str], None], *, leans: bool
    ) -> None:
        self._twin = twin
        self._arm_from_world = Motion.from_vectors(placed.om, placed.T).inverse()
        self._met = met
        self._leans = leans
        # to within a millimetre, how the stylus was held: nobody solves the same pose twice
        self._reached: dict[bytes, Floats] = {}

    def ask(self, request: Request, check: Callable[[], None] = no_check) -> Answer:
        """Raises OperatorAbort where the arm doesn't reach the check point, OperatorSkip where it
        doesn't reach a teat's end.
        """
        answer = self._twin.operator.ask(request, check)
        if isinstance(request, CheckPoint) and (why := self._out_of_reach("the check point")):
            raise OperatorAbort(why)
        if isinstance(request, Touch):
            name = self._twin.world.phantom().teats[request.teat - 1].name or request.teat
            if why := self._out_of_reach(f"the end of teat {name}"):
                raise OperatorSkip(why)
        return answer

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
        unit = arm.unit
        try:
            arm.check_reach(there, np.asarray(self._arm_from_world.R @ axis))
            return axis
        except OutOfReachError:
            if not self._leans:
                return None
        try:
            counts = inverse(unit.geometry(), there, None, start=unit.home)
        except OutOfReachError:
            return None
        return np.asarray(self._arm_from_world.R.T @ unit.geometry().forward(counts)[1][0])


class Person(PromptedOperator):
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
        answers: PromptedOperator | None = None,
    ) -> None:
        self._clock = clock
        self._seconds = seconds
        self._spent = spent
        self._on_clock = on_clock
        self._beside_s = beside_s
        self._answers = answers
        self.next_set_up_s = 0.0
        self.asked = 0

    def answer(self, prompt: Prompt, check: Callable[[], None]) -> frozenset[int]:
        self.asked += 1
        takes = {"homing": self._seconds["placing"], "set up": self.next_set_up_s}
        seconds = takes.get(prompt.kind, self._seconds["touch"])
        self._spent.book(seconds * (1.0 - self._on_clock) + self._beside_s)
        end_s = self._clock.now() + seconds * self._on_clock
        check()
        while (left_s := end_s - self._clock.now()) > 0.0:
            self._clock.sleep(min(LOOK_S, left_s))
            check()
        return self._answers.answer(prompt, check) if self._answers else frozenset()

    def say(self, text: str) -> None:
        if self._answers:
            self._answers.say(text)

    def finish(self) -> None:
        if self._answers:
            self._answers.finish()


class TimedOperator:
    """Has ``operator`` do what is asked, tells ``spent`` what that is, and ``person`` how long a
    set-up takes.
    """

    def __init__(
        self, operator: Operator, person: Person, spent: TimeSpent, seconds: Mapping[str, float]
    ) -> None:
        self._operator = operator
        self._person = person
        self._spent = spent
        self._seconds = seconds
        self._stands: Arrangement | None = None

    def ask(self, request: Request, check: Callable[[], None] = no_check) -> Answer:
        match request:
            case NextTrial():
                self._spent.work(MOVES)
            case CheckPoint() | Touch():
                self._spent.asking(TOUCHES)
            case Arrangement():
                self._spent.asking(SET_UPS)
                self._person.next_set_up_s = self._takes_s(request)
        answer = self._operator.ask(request, check)
        if isinstance(request, Arrangement):
            self._stands = request
            self._spent.work(CAPTURES)
        elif isinstance(request, Release):
            self._spent.work(MOVES)
        return answer

    def _takes_s(self, wanted: Arrangement) -> float:
        before = self._stands
        if before is None or (before.phantom, before.objects, before.scene) != (
            wanted.phantom,
            wanted.objects,
            wanted.scene,
        ):
            return self._seconds["set-up"]
        return self._seconds["placing"] if before.pose != wanted.pose else 0.0
