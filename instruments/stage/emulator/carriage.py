"""The mechanics: from the counted position to the carriage and the plate on it.

The motor turns with the steps, less the lost ones. The carriage follows after the play is taken up,
and stands at the rails' ends, where further steps are lost. Exact when fed with the ends of
straight lines in order. Scale, squareness and yaw of the mounting give the plate's pose. The moment
is an argument and never goes back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from instruments.stage.emulator.motion import (
    SOON_S,
    AxisRates,
    Motion,
    Run,
    Vector,
)
from instruments.world.phantom import PlatePose

PRESSED_MM = 0.005  # how far past its edge a limit switch is closed
SEARCH = 1.5  # times the longest travel of the pass, before a switch counts as missing
LOCATE = 5.0  # times the pull-off


class Switch(Enum):
    """How a homing switch is broken."""

    MISSING = "never closes"
    STUCK = "never opens again"
    CROOKED = "of the axis's two motors, one finds its switch too late"


class Homing(NamedTuple):
    """How a controller homes: axes pass by pass, mm, mm/s and s; the alarm of a crooked gantry."""

    passes: tuple[tuple[int, ...], ...]
    travel_mm: Vector
    accel_mm_s2: Vector
    seek_mm_s: float
    creep_mm_s: float
    pull_off_mm: float
    debounce_s: float
    at_far_end: frozenset[int]
    crooked_alarm: int


@dataclass
class AxisDrive:
    """One axis between ``low`` and 0 mm. ``play``: the motor's travel after a reversal before the
    carriage moves; ``at_far_end``: its switch is at ``low``; ``count``: the controller's position.
    """

    place: float
    low: float
    play: float = 0.0
    at_far_end: bool = False
    count: float = 0.0
    motor: float = 0.0
    to_lose: float = 0.0
    stalled: bool = False
    pressed: bool = False

    def __post_init__(self) -> None:
        self.motor = self.place

    def follow(self, count: float) -> None:
        """The count goes straight to ``count``."""
        way = count - self.count
        self.count = count
        if self.stalled or not way:
            return
        lost = min(abs(way), self.to_lose)
        self.to_lose -= lost
        self.motor += way - lost if way > 0 else way + lost
        below, above = (0.0, self.play) if self.at_far_end else (self.play, 0.0)
        wanted = min(max(self.place, self.motor - below), self.motor + above)
        self.place = min(max(wanted, self.low), 0.0)  # at the rail's end steps are lost
        over = wanted - self.place
        self.motor -= over
        self.pressed = (-over if self.at_far_end else over) > PRESSED_MM or (
            self.pressed and self.place == (self.low if self.at_far_end else 0.0)
        )

    def recount(self, count: float, place: float | None = None) -> None:
        """Nothing moves; from now on the controller counts from here. With ``place`` the carriage
        stands there with the play taken up.
        """
        if place is not None:
            self.place = self.motor = place
            self.pressed = False
        self.count = count
        self.to_lose, self.stalled = 0.0, False


class HomingRun:
    """The homing cycle as a function of time from ``start_s``: the axes of a pass seek their
    switches fast, back off, find them again slowly and back off. ``alarm``: what ends it.
    """

    def __init__(
        self, start_s: float, place_mm: Vector, homing: Homing, broken: Mapping[int, Switch]
    ) -> None:
        self.end_s = start_s
        self.alarm: int | None = None
        self._homing, self._broken = homing, broken
        self._place = list(place_mm)  # at the end of what is laid out
        self._runs: list[tuple[int, float, float, Run]] = []  # axis, start, direction, run
        for axes in homing.passes:
            if self.alarm is None:
                self._home(axes)

    def position(self, now_s: float) -> Vector:
        """Where the carriage is, mm."""
        place = list(self._place)
        for axis, start_mm, sign, run in reversed(self._runs):
            if now_s < run.end_s:
                place[axis] = start_mm + sign * run.at(now_s)[0]
        return tuple(place)

    def _home(self, axes: Sequence[int]) -> None:
        homing = self._homing
        search = SEARCH * max(homing.travel_mm[axis] for axis in axes)
        locate = LOCATE * homing.pull_off_mm
        for reach, speed in ((search, homing.seek_mm_s), (locate, homing.creep_mm_s)):
            if self.alarm is None:
                self._stage([self._approach(axis, reach, speed) for axis in axes])
            if self.alarm is None:
                self._stage([self._back_off(axis) for axis in axes])

    def _stage(self, ends_s: list[float]) -> None:
        self.end_s = max(self.end_s, *ends_s) + self._homing.debounce_s

    def _towards(self, axis: int) -> float:
        return -1.0 if axis in self._homing.at_far_end else 1.0

    def _back_off(self, axis: int) -> float:
        if self._broken.get(axis) is Switch.STUCK or not self._homing.pull_off_mm:
            self.alarm = 8
        return self._run(
            axis, -self._towards(axis), self._homing.pull_off_mm, self._homing.seek_mm_s
        )

    def _approach(self, axis: int, reach: float, speed: float) -> float:
        towards, homing = self._towards(axis), self._homing
        switch = -homing.travel_mm[axis] if axis in homing.at_far_end else 0.0
        gap = max(0.0, towards * (switch - self._place[axis]))
        broken = self._broken.get(axis)
        if broken is Switch.MISSING or gap > reach:
            # the carriage stops at the end of its rails, the motor goes on
            self.alarm = 9
            return max(self._run(axis, towards, min(gap, reach), speed), self.end_s + reach / speed)
        if broken is Switch.CROOKED:
            self.alarm = homing.crooked_alarm
        return self._run(axis, towards, gap, speed)

    def _run(self, axis: int, sign: float, way_mm: float, speed: float) -> float:
        """One axis's run from ``end_s`` on; when it ends."""
        if not way_mm:
            return self.end_s
        run = Run(self.end_s, way_mm, speed, self._homing.accel_mm_s2[axis])
        self._runs.append((axis, self._place[axis], sign, run))
        self._place[axis] += sign * way_mm
        return run.end_s


class Carriage:
    """Motors, screws, carriage in machine coordinates, 0 at the high ends. ``motion`` is the
    controller's count, changed only as `follow` gives it; ``starts``: how often it set out from
    rest.
    """

    def __init__(
        self, place_mm: Vector, travel_mm: Vector, play_mm: Vector, at_far_end: frozenset[int]
    ) -> None:
        axes = zip(place_mm, travel_mm, play_mm, strict=True)
        self._axes = [
            AxisDrive(place, -travel, play, axis in at_far_end)
            for axis, (place, travel, play) in enumerate(axes)
        ]
        self.motion = Motion((0.0,) * len(self._axes))
        self.starts = 0
        self._seen_s = -math.inf  # up to when the axes have followed the motion
        self._homing: HomingRun | None = None
        self._stalled_homing: Vector | None = None

    @property
    def homing(self) -> bool:
        return self._homing is not None

    def moving(self, now_s: float) -> bool:
        return self.homing or self.motion.moving(now_s)

    def follow(self, now_s: float) -> Motion:
        """Bring the axes up to this moment; the motion."""
        if not self._homing and now_s > self._seen_s:
            for counts in self.motion.turns(self._seen_s, now_s):
                for axis, count in zip(self._axes, counts, strict=True):
                    axis.follow(count)
            self._seen_s = now_s
        return self.motion

    def place_mm(self, now_s: float) -> Vector:
        if self._homing:
            return self._stalled_homing or self._homing.position(now_s)
        self.follow(now_s)
        return tuple([axis.place for axis in self._axes])

    def pressed(self, now_s: float) -> list[int]:
        """The axes whose limit switch is closed."""
        self.follow(now_s)
        return [at for at, axis in enumerate(self._axes) if axis.pressed and not self._homing]

    def due_s(self, now_s: float) -> float:
        """When the running move or the homing cycle ends; ``inf`` at rest."""
        return self._homing.end_s if self._homing else self.motion.next_end_s(now_s)

    def go(
        self, target_mm: Vector, feed_mm_s: float | None, rates: AxisRates, now_s: float
    ) -> None:
        """Plan a move after all that is planned; None is as fast as possible."""
        self.follow(now_s)
        still = not self.moving(now_s)
        if still:
            self._stall(False)  # the motor holds again, as far off as a stall has left it
        if self.motion.go(target_mm, feed_mm_s, rates, now_s) and still:
            self.starts += 1

    def halt(self, now_s: float) -> None:
        """Cut the steps."""
        place = self.place_mm(now_s)
        self.motion.halt(now_s)
        if self._homing:
            self._end_homing(place, now_s)

    def cut_power(self, now_s: float) -> None:
        """Off and on again: the count starts at nought, the carriage stays."""
        self.halt(now_s)
        self.motion = Motion((0.0,) * len(self._axes))
        for axis in self._axes:
            axis.recount(0.0)

    def start_homing(self, homing: Homing, broken: Mapping[int, Switch], now_s: float) -> None:
        """Begin the cycle from where the carriage stands."""
        self._homing = HomingRun(now_s, self.place_mm(now_s), homing, broken)
        self._stall(False)
        self._stalled_homing = None
        self.starts += 1

    def finish_homing(self, home_mm: Vector, axes: Sequence[int], now_s: float) -> int | None:
        """At the cycle's end: set the count of ``axes``, or give the alarm that ended it."""
        if self._homing is None:
            return None
        alarm, place = self._homing.alarm, self.place_mm(now_s)
        if alarm is not None:
            self.halt(now_s)
            return alarm
        at_home = [home_mm[at] if at in axes else here for at, here in enumerate(place)]
        self.motion = Motion(home_mm)
        self._end_homing(self._stalled_homing or tuple(at_home), now_s)
        return None

    def homing_over(self, now_s: float) -> bool:
        return self._homing is None or now_s >= self._homing.end_s - SOON_S

    def stall(self, now_s: float) -> None:
        """The carriage stands until the next motion; the count goes on."""
        if self._homing:
            self._stalled_homing = self.place_mm(now_s)
        else:
            self.follow(now_s)
            self._stall(True)

    def lose_steps(self, amount_mm: float, now_s: float) -> None:
        """Lose that much on the linear axis that the running move takes furthest."""
        if left := self.follow(now_s).left(now_s):
            move = left[0][0]
            ways = [abs(e - s) for s, e in zip(move.start_mm[:3], move.target_mm[:3], strict=True)]
            self._axes[ways.index(max(ways))].to_lose += amount_mm

    def _stall(self, on: bool) -> None:
        for axis in self._axes:
            axis.stalled = on

    def _end_homing(self, place_mm: Vector, now_s: float) -> None:
        self._homing = self._stalled_homing = None
        count_mm = self.motion.position(now_s)
        for axis, place, count in zip(self._axes, place_mm, count_mm, strict=True):
            axis.recount(count, place)
        self._seen_s = now_s


@dataclass(frozen=True, slots=True)
class Mounting:
    """A stage that carries the plate; the pose is zero at ``reference``. ``squareness_rad``: angle
    from X to Y, less a right angle; ``yaw_rad``: from the world's x to X. A turns the plate x
    towards y.
    """

    axes: str
    reference: tuple[float, float, float, float]
    scale_errors: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    squareness_rad: float = 0.0
    yaw_rad: float = 0.0

    def pose(self, place: Sequence[float]) -> PlatePose:
        """The plate's pose for X Y Z in mm and A in degrees; it never sinks below its reference."""
        ways = [0.0] * 4
        for at, (axis, here) in enumerate(zip("XYZA", place, strict=False)):
            if axis in self.axes:
                ways[at] = (1.0 + self.scale_errors[at]) * (here - self.reference[at])
        x, y, z, a = ways
        lean = math.pi / 2 + self.squareness_rad + self.yaw_rad
        return PlatePose(
            x_mm=x * math.cos(self.yaw_rad) + y * math.cos(lean),
            y_mm=x * math.sin(self.yaw_rad) + y * math.sin(lean),
            z_mm=max(0.0, z),
            yaw_rad=math.radians(a),
        )
