"""The dialogues of `arm frame` and `arm verify`: which touches are asked for, in which order and
words, and what they add up to. A touch that can't be used (the arm moved, two points are too near)
is asked for again; nothing is lost but that touch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import chain
from typing import Protocol

import numpy as np

from bench.rig.arm_files import (
    APART_MM,
    TOUCHES,
    FrameError,
    LengthTest,
    LocationTest,
    TableFrame,
    TouchedPoint,
    Triple,
    Verification,
    world_from_arm,
)
from instruments.microscribe.configuration import Identity
from instruments.microscribe.errors import ArmMovesError
from instruments.microscribe.stream import Reading

LEANS = ("upright", "leaning left", "leaning right", "leaning towards you", "leaning away from you")
DISTANCES = ("near", "middle", "far")
DIVOTS = {
    "near": "near the arm, some 200 mm from its base",
    "middle": "at half the arm's reach, some 330 mm from its base",
    "far": "far out, some 450 mm from its base",
}
DIRECTIONS = (
    "flat, pointing away from the arm",
    "flat, across in front of the arm",
    "flat, diagonal",
    "flat, the other diagonal",
    "upright",
    "rising away from the arm at 45 degrees",
    "rising across in front of the arm at 45 degrees",
)


@dataclass(frozen=True, slots=True)
class Step:
    """One touch that is asked for. ``what`` names the place, ``number`` (from 0) which of several;
    ``world_mm`` where it is known.
    """

    what: str
    number: int
    text: str
    world_mm: Triple | None = None


class Person(Protocol):
    """Who brings the tip where it is asked for."""

    def ask(self, text: str) -> None:
        """Return once what ``text`` says is done. Raises OperatorAbort."""
        ...

    def touch(self, step: Step) -> None:
        """Return once the tip is there and held still. Raises OperatorAbort."""
        ...

    def say(self, text: str) -> None:
        """Show ``text``."""
        ...


class ReadableArm(Protocol):
    """What is asked of the driver."""

    @property
    def identity(self) -> Identity: ...
    def read(self, n: int = 8, max_spread_mm: float = 1.0) -> Reading: ...


@dataclass(frozen=True, slots=True)
class Plan:
    """What `verify` asks for: ``distances`` of divots (1 to 3), ``touches`` in each, a
    ``length_mm`` (None: none) in ``directions``.
    """

    distances: int = 3
    touches: int = TOUCHES
    length_mm: float | None = None
    directions: int = len(DIRECTIONS)


def touch_frame(
    arm: ReadableArm, person: Person, checks: Sequence[Triple | None], made: datetime
) -> TableFrame:
    """A table frame from three touches and one for each of ``checks``: a known place, or None for
    anywhere in the plane.

    Raises as person and driver do.
    """
    origin = _touched(
        arm, person, Step("origin", 0, "Touch the table's origin (world 0, 0, 0)."), "origin"
    )
    while True:
        text = (
            f"Touch a point on the x axis, on its positive side, at least {APART_MM:g} mm from the"
            " origin; further is better."
        )
        on_x = _touched(arm, person, Step("x axis", 0, text), "x axis")
        text = (
            f"Touch a point of the table's plane on the side of positive y, at least {APART_MM:g}"
            " mm from the x axis; further is better."
        )
        in_plane = _touched(arm, person, Step("plane", 0, text), "plane")
        try:
            world_from_arm([origin.arm_mm, on_x.arm_mm, in_plane.arm_mm])
            break
        except FrameError as error:
            person.say(f"{error}. Once more, the second and the third point.")
    points = [origin, on_x, in_plane]
    for number, place in enumerate(checks):
        where = (
            "another point of the table's plane, well away from the three"
            if place is None
            else f"the point {_mm(place)} (world)"
        )
        step = Step(
            "check", number, f"Check point {number + 1} of {len(checks)}: touch {where}.", place
        )
        points.append(_touched(arm, person, step, f"check {number + 1}"))
    frame = TableFrame.from_touches(made, arm.identity.serial_number, points)
    if frame.hangs:
        person.ask(
            "In this frame the arm stands upside down. That is right only where it hangs; otherwise"
            " the third point was on the wrong side of the x axis: abort, and begin again."
        )
    return frame


def verify(arm: ReadableArm, person: Person, plan: Plan, made: datetime) -> Verification:
    """The readings that ``plan`` asks for, as a verification. Raises as person and driver do."""
    names = (
        DISTANCES
        if plan.distances == 3
        else ("near", "far")
        if plan.distances == 2
        else ("middle",)
    )
    locations = []
    for name in names:
        person.ask(
            f"Fix the divot {DIVOTS[name]}. It must not move until its {plan.touches} touches are"
            " done."
        )
        locations.append(_divot(arm, person, name, plan.touches))
        test = locations[-1]
        person.say(
            f"{name}: within {test.largest_mm:.2f} mm of the mean, 2 sd {test.two_sd_mm:.2f} mm,"
            f" swung by {test.swing_deg:.0f} degrees."
        )
    lengths = [
        _length(arm, person, number, plan.length_mm)
        for number in range(plan.directions)
        if plan.length_mm is not None
    ]
    return Verification(made, arm.identity.serial_number, tuple(locations), tuple(lengths))


def _divot(arm: ReadableArm, person: Person, name: str, touches: int) -> LocationTest:
    readings = []
    for number in range(touches):
        lean = LEANS[number % len(LEANS)]
        further = (
            ", turned about itself and with the elbow elsewhere" if number >= len(LEANS) else ""
        )
        text = (
            f"Divot {name}, touch {number + 1} of {touches}: tip in the divot, the stylus"
            f" {lean}{further}."
        )
        readings.append(_read(arm, person, Step(name, number, text)))
    return LocationTest(
        name, np.array([r.tip_mm for r in readings]), np.array([r.axis for r in readings])
    )


def _length(arm: ReadableArm, person: Person, number: int, length_mm: float) -> LengthTest:
    where = DIRECTIONS[number % len(DIRECTIONS)]
    person.ask(
        f"Fix the calibrated length {where}. It must not move until both its ends are touched."
    )
    a = _read(arm, person, Step("length a", number, f"Length {where}: touch its first end."))
    b = _read(arm, person, Step("length b", number, f"Length {where}: touch its second end."))
    test = LengthTest(where, a.tip_mm, b.tip_mm, length_mm)
    person.say(f"{where}: {test.measured_mm:.2f} mm, error {test.error_mm:+.2f} mm.")
    return test


def _touched(arm: ReadableArm, person: Person, step: Step, name: str) -> TouchedPoint:
    reading = _read(arm, person, step)
    x, y, z = (float(v) for v in reading.tip_mm)
    return TouchedPoint(name, (x, y, z), float(reading.spread_mm), step.world_mm)


def _read(arm: ReadableArm, person: Person, step: Step) -> Reading:
    """One reading of what ``step`` asks for; asked again while the arm moves."""
    while True:
        person.touch(step)
        try:
            reading = arm.read()
        except ArmMovesError as refused:
            person.say(str(refused))
            continue
        person.say(f"  read {_mm(reading.tip_mm)} (arm), spread {reading.spread_mm:.2f} mm")
        return reading


def _mm(point: Sequence[float] | np.ndarray[tuple[int], np.dtype[np.float64]]) -> str:
    return ", ".join(f"{v:.1f}" for v in chain(point)) + " mm"
