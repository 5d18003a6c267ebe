"""One arm alone: connected by its URL, signed on, homing confirmed by the person who stands beside
it; and the dialogues of `arm frame` and `arm verify`. A touch that can't be used
(the arm moved, or its link was lost; two points are too near) is asked for again; nothing is lost
but that touch.

`emulator:` means an emulated arm of this process that goes where the dialogue asks. Time is real: a
person takes part.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bench.calibrate.simulated_arm import SimulatedArm, TouchStep
from bench.config import ConfigError, check_within
from bench.rig.arm_files import (
    APART_MM,
    TOUCHES,
    LengthTest,
    LocationTest,
    TableFrame,
    TableFrameError,
    TouchedPoint,
    Triple,
    Verification,
    axes_of,
    swing_text,
    world_from_arm,
)
from bench.rig.model import ArmTable, Baud, SafetyLimits
from bench.rig.opening import open_instruments, pedal_watch, rig_of
from bench.rig.reconnecting import Reconnecting
from bench.rig.urls import EMULATED, arm_url
from bench.script.model import ArmRequirement, find_script, load_script
from bench.truth.touching import same_place_mm
from instruments.captures.capture import CaptureFile
from instruments.clock import Clock, RealClock, wall_time
from instruments.drivers.protocols import Arm
from instruments.errors import TouchAgainError
from instruments.microscribe.driver import Reading
from instruments.operators.console import Console
from instruments.operators.operator import Operator, Request, Task
from textfiles.bounds import ABOVE_0, COUNT, Bounds

Floats = NDArray[np.float64]

HOMED = (
    "Was the stylus on its peg when the arm was last switched on, or the arm homed since"
    " ('teatbench arm home')?"
)
PEG = "Put the arm's stylus on its peg and let go of it. Homed elsewhere, positions are wrong."
DISTANCES = Bounds("1, 2 or 3", least=1, below=4, whole=True)
SEVERAL = Bounds("a whole number of 2 or more", least=2, whole=True)
SD = Bounds("a number of 0 or more", least=0.0)
AWAY_S = float(SafetyLimits.model_fields["away_s"].default)
LEANS = ("upright", "leaning left", "leaning right", "leaning towards you", "leaning away from you")
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


@dataclass
class ArmSession:
    """A signed-on arm and the person beside it. Questions raise OperatorAbort."""

    arm: Arm
    clock: Clock
    operator: Operator
    simulated: SimulatedArm | None
    away_s: float = AWAY_S
    homings: int = 0  # since it was lost

    def ask(self, text: str) -> None:
        self.operator.ask(Task(text))

    def touch(self, step: TouchStep) -> None:
        """Something to be touched; the emulated hand goes there first."""
        if self.simulated:
            self.simulated.go(step)
        self.operator.ask(Task(step.text, pedal=True))

    def count_homing(self) -> None:
        """The arm was homed once more."""
        self.homings += 1

    def say(self, text: str) -> None:
        if isinstance(self.operator, Console):
            self.operator.say(text)


@contextmanager
def open_arm(
    port: str,
    baud: Baud,
    answer_s: float,
    capture: CaptureFile | None,
    *,
    homed: bool,
    ask: bool = True,
    on_peg: bool | None = None,
    length_mm: float | None = None,
    operator: Operator | None = None,
) -> Iterator[ArmSession]:
    """The arm at ``port``, signed on; unless ``homed``, the ``operator`` is asked (None: a person
    at the terminal). ``on_peg``: home it now; False: ask for the stylus on its peg before. Of an
    emulated arm ``length_mm`` is its bar. Raises ConfigError.
    """
    check_within(ABOVE_0, answer_s=answer_s)
    asks = bool(operator or (sys.stdin and sys.stdin.isatty()))
    if on_peg is False and not asks:
        what = "homing with the stylus off its peg ruins every position"
        raise ConfigError.plain(f"{what}. Put it there, and give `on_peg` to say so.")
    if ask and not (homed or asks):
        raise ConfigError.plain(
            "no positions before homing is confirmed, and there is no terminal to confirm it at."
            " Give `homed` where the stylus was on its peg when the arm was last switched on, or"
            " the arm was homed since: otherwise positions are wrong, with no sign of it."
        )
    try:
        arm_url(port)
    except ValueError as error:
        raise ConfigError.plain(f"{port}: {error}") from error
    with ExitStack() as stack:
        clock = stack.enter_context(closing(RealClock()))
        simulated = None
        if port == EMULATED:
            simulated = stack.enter_context(SimulatedArm(clock, length_mm=length_mm or 300.0))
        url = simulated.url if simulated else port
        rig = rig_of(arm=ArmTable.model_construct(url=url, baud=baud, answer_s=answer_s))
        with open_instruments(rig, ("arm",), clock, capture=capture) as devices:
            arm = devices.arm
            arm.sign_on()
            if operator is None:
                watch = partial(pedal_watch, arm, clock) if arm.pedals else None
                operator = console = Console(sys.stdin, sys.stdout, clock, watch=watch)
                console.in_run = False
            arm.asked_of(operator)
            if on_peg is not None and not arm.pedals:
                what = "only a MicroScribe can be homed: the software of another arm does that"
                raise ConfigError.plain(what)
            text = PEG if on_peg is False else HOMED if arm.pedals else arm.homing
            if on_peg is False or (ask and not homed):
                operator.ask(Task(text))
            if on_peg is not None:
                arm.home()
            if ask or homed:
                arm.confirm_homed()
            yield ArmSession(arm, clock, operator, simulated)


def today() -> datetime:
    """For the files: to the second, in UTC."""
    return wall_time().replace(microsecond=0).astimezone(UTC)


def limits_of(script: str | None) -> ArmRequirement:
    """What a script asks of an arm. Raises ConfigError where it asks for nothing."""
    loaded = load_script(find_script(script))
    for rule in loaded.script.requirements:
        if isinstance(rule, ArmRequirement):
            return rule
    what = f"{loaded.path} has no requirement of the kind arm_verified"
    raise ConfigError.plain(f"{what}, so it has no limits for an arm. Name another one.")


@dataclass(frozen=True, slots=True)
class VerificationPlan:
    """Divots at 1 to 3 ``distances``, ``touches`` each, and a ``length_mm`` in ``directions``, with
    ``length_u_mm`` and ``gauge`` of its certificate, between ``spheres`` or cones.
    """

    distances: int = 3
    touches: int = TOUCHES
    length_mm: float | None = None
    directions: int = len(DIRECTIONS)
    length_u_mm: float = 0.0
    gauge: str = ""
    spheres: bool = False

    def __post_init__(self) -> None:
        check_within(DISTANCES, distances=self.distances)
        check_within(SEVERAL, touches=self.touches)
        check_within(COUNT, directions=self.directions)
        check_within(ABOVE_0, length_mm=self.length_mm)
        check_within(SD, length_u_mm=self.length_u_mm)


# places on a sphere, outwards, and what they are called: five, as ISO 10360 touches a sphere
ROUND: tuple[tuple[str, Triple], ...] = (
    ("on top", (0.0, 0.0, 1.0)),
    ("on the left, a little above its middle", (-0.94, 0.0, 0.3412)),
    ("on the right, a little above its middle", (0.94, 0.0, 0.3412)),
    ("on your side, a little above its middle", (0.0, -0.94, 0.3412)),
    ("on the far side, a little above its middle", (0.0, 0.94, 0.3412)),
)


def touch_frame(session: ArmSession, checks: Sequence[Triple | None], made: datetime) -> TableFrame:
    """A frame from three touches and one for each of ``checks`` (None: anywhere in the plane)."""
    while True:
        touched = list[str]()
        try:
            return _frame(session, checks, made, touched)
        except _HomedElsewhereError as why:
            session.say(f"{why} All points are touched anew.")
        except BaseException:
            if touched:
                lost = f"Touched so far, and lost: {', '.join(touched)}."
                session.say(f"{lost} Nothing was written: a frame is touched in one go.")
            raise


class _HomedElsewhereError(Exception):
    """An arm that was homed again reads another place of the point that it touched before."""


def _frame(
    session: ArmSession, checks: Sequence[Triple | None], made: datetime, names: list[str]
) -> TableFrame:
    """``names`` gets those of the touched points. Raises _HomedElsewhereError, and as a touch."""
    first: list[tuple[TouchStep, Reading]] = []

    def touched(step: TouchStep, name: str) -> TouchedPoint:
        homings, reading = session.homings, read_touch(session, step)
        if session.homings != homings and first:  # the origin is a point, not any of a line
            again, before = first[0]
            text = f"The arm was homed again. {again.text} It shows whether those before count."
            seen = read_touch(session, replace(again, text=text))
            off_mm = float(np.linalg.norm(seen.tip_mm - before.tip_mm))
            if off_mm > (limit_mm := same_place_mm(ArmTable.model_construct(url=EMULATED))):
                what = f"The origin is {off_mm:.2f} mm from where it was, limit {limit_mm:.2f} mm."
                raise _HomedElsewhereError(what)
        first.append((step, reading))
        names.append(name)
        x, y, z = (float(v) for v in reading.tip_mm)
        return TouchedPoint(name, (x, y, z), float(reading.spread_mm), step.world_mm)

    origin = touched(TouchStep("origin", 0, "Touch the table's origin (world 0, 0, 0)."), "origin")
    while True:
        text = (
            f"Touch a point on the x axis, on its positive side, at least {APART_MM:g} mm from the"
            " origin; further is better."
        )
        on_x = touched(TouchStep("x axis", 0, text), "x axis")
        text = (
            f"Touch a point of the table's plane on the side of positive y, at least {APART_MM:g}"
            " mm from the x axis; further is better."
        )
        in_plane = touched(TouchStep("plane", 0, text), "plane")
        try:
            world_from_arm([origin.arm_mm, on_x.arm_mm, in_plane.arm_mm])
            break
        except TableFrameError as error:
            session.say(f"{error}. Once more, the second and the third point.")
    points = [origin, on_x, in_plane]
    for number, place in enumerate(checks):
        where = f"the point {mm(place)} (world)" if place else "another point of the table's plane,"
        where += "" if place else " well away from the three"
        text = f"Check point {number + 1} of {len(checks)}: touch {where}."
        points.append(touched(TouchStep("check", number, text, place), f"check {number + 1}"))
    frame = TableFrame.from_touches(made, session.arm.identity.serial_number, points)
    if frame.hangs:
        session.ask(
            "In this frame the arm stands upside down. That is right only where it hangs; otherwise"
            " the third point was on the wrong side of the x axis: abort, and begin again."
        )
    return frame


def verify(
    session: ArmSession,
    plan: VerificationPlan,
    made: datetime,
    keep: Callable[[Verification], None] = lambda _: None,
) -> Verification:
    """The readings that ``plan`` asks for, as a verification; ``keep`` gets what there is of it
    after each divot and each length. Raises as its touches do.
    """
    serial_number, lengths = session.arm.identity.serial_number, list[LengthTest]()

    def so_far() -> Verification:
        return Verification(made, serial_number, tuple(locations), tuple(lengths), plan.gauge)

    names = {1: ("middle",), 2: ("near", "far"), 3: ("near", "middle", "far")}[plan.distances]
    locations = list[LocationTest]()
    for name in names:
        still = f"It must not move until its {plan.touches} touches are done."
        session.ask(f"Fix the divot {DIVOTS[name]}. {still}")
        test = _divot(session, name, plan.touches)
        locations.append(test)
        keep(so_far())
        session.say(
            f"{name}: within {test.largest_mm:.2f} mm of the mean, 2 sd {test.two_sd_mm:.2f} mm,"
            f" {swing_text(test)}."
        )
    for number in range(plan.directions):
        if plan.length_mm is None:
            break
        where = DIRECTIONS[number % len(DIRECTIONS)]
        still = "It must not move until both its ends are touched."
        session.ask(f"Fix the calibrated length {where}. {still}")
        (a, own_a), (b, own_b) = (
            _end(session, f"length {end}", number, f"Length {where}: touch its {nth} end", plan)
            for end, nth in (("a", "first"), ("b", "second"))
        )
        ends_mm2 = None if own_a is None or own_b is None else own_a + own_b
        length = LengthTest(where, a, b, plan.length_mm, plan.length_u_mm, ends_mm2)
        lengths.append(length)
        keep(so_far())
        session.say(f"{where}: {length.measured_mm:.2f} mm, error {length.error_mm:+.2f} mm.")
    return so_far()


def _end(
    session: ArmSession, what: str, number: int, text: str, plan: VerificationPlan
) -> tuple[Floats, Floats | None]:
    """An end of a length (3,), as touched; or a sphere's centre, with its covariance for 1 mm."""
    if not plan.spheres:
        return read_touch(session, TouchStep(what, number, f"{text}.")).tip_mm, None
    steps = (TouchStep(what, number, f"{text}, {where}.", off=off) for where, off in ROUND)
    points = np.array([read_touch(session, step).tip_mm for step in steps])
    return sphere_centre(points), sphere_centre_mm2(points)


def sphere_centre(points_mm: Floats) -> Floats:
    """Centre (3,) of the sphere through points (n, 3), n >= 4: |p|^2 = 2 c.p + k (Coope, 1993)."""
    middle = points_mm.mean(axis=0)
    off = points_mm - middle
    found = np.linalg.lstsq(_columns(off), (off**2).sum(axis=1), rcond=None)[0]
    return np.asarray(middle + found[:3])


def sphere_centre_mm2(points_mm: Floats) -> Floats:
    """Covariance (3, 3) of that centre for points of 1 mm along each axis: an error e of a point
    moves |p|^2 - 2 c.p by 2 (p - c).e. Of `ROUND` 0.75 mm sideways, 1.7 mm upwards.
    """
    centre, off = sphere_centre(points_mm), points_mm - points_mm.mean(axis=0)
    solved = np.linalg.pinv(_columns(off))[:3]
    return np.asarray((solved * (4.0 * np.sum((points_mm - centre) ** 2, axis=1))) @ solved.T)


def _columns(off: Floats) -> Floats:
    return np.column_stack([2.0 * off, np.ones(len(off))])


def _divot(session: ArmSession, name: str, touches: int) -> LocationTest:
    readings = []
    for number in range(touches):
        again = number >= len(LEANS)
        further = ", turned about itself and with the elbow elsewhere" if again else ""
        text = (
            f"Divot {name}, touch {number + 1} of {touches}: tip in the divot, the stylus"
            f" {LEANS[number % len(LEANS)]}{further}."
        )
        readings.append(read_touch(session, TouchStep(name, number, text)))
    axes = axes_of([one.axis for one in readings])
    return LocationTest(name, np.array([one.tip_mm for one in readings]), axes)


def read_touch(session: ArmSession, step: TouchStep) -> Reading:
    """One reading of what ``step`` asks for; asked again while the arm moves, or was lost."""

    def touched() -> Reading:
        session.touch(step)  # a pedal's watch sees a loss here
        return session.arm.read()

    def ask(request: Request) -> None:
        if session.simulated:
            session.simulated.rest()
        session.operator.ask(request)

    who = session.arm, ask, session.clock, session.say, session.away_s
    again = Reconnecting.of_arm(*who, homed=session.count_homing)
    while True:
        try:
            reading = again.keep(touched)
        except TouchAgainError as refused:
            session.say(str(refused))
            continue
        spread = f", spread {reading.spread_mm:.2f} mm" if reading.n > 1 else ""
        session.say(f"  read {mm(reading.tip_mm)} (arm){spread}")
        return reading


def mm(point: Iterable[float]) -> str:
    return ", ".join(f"{v:.1f}" for v in point) + " mm"
