"""The mechanics: from the counted position to the carriage and the plate on it.

The motor turns with the steps, less the lost ones. The carriage follows after the play is taken up,
and stands at the rails' ends, where further steps are lost. Exact when fed with the ends of
straight lines in order. Scale, squareness and yaw of the mounting give the plate's pose. The moment
is an argument and never goes back.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

from instruments.stage.emulator.motion import (
    SOON_S,
    AxisRates,
    HomingRun,
    Leg,
    Motion,
    Switch,
    Vector,
)
from instruments.stage.emulator.store import Store
from instruments.world.phantom import PlatePose

PRESSED_MM = 0.005  # how far past its edge a limit switch is closed


@dataclass
class AxisDrive:
    """One axis between ``low`` and ``high`` mm. ``play``: the motor's travel after a reversal
    before the carriage moves; ``at_far_end``: its switch is at ``low``; ``count``: the controller's
    position.
    """

    place: float
    low: float
    high: float
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
        if self.stalled:
            return
        lost = min(abs(way), self.to_lose)
        self.to_lose -= lost
        self.motor += way - lost if way > 0 else way + lost
        below, above = (0.0, self.play) if self.at_far_end else (self.play, 0.0)
        wanted = min(max(self.place, self.motor - below), self.motor + above)
        self.place = min(max(wanted, self.low), self.high)  # at the rail's end steps are lost
        over = wanted - self.place
        if over:
            self.motor -= over
            self.pressed |= (-over if self.at_far_end else over) > PRESSED_MM

    def recount(self, count: float) -> None:
        """Nothing moves; from now on the controller counts from here."""
        self.count = count
        self.to_lose, self.stalled = 0.0, False

    def settle(self, place: float, count: float) -> None:
        """The carriage stands at ``place`` with the play taken up, and this counts as ``count``."""
        self.place = self.motor = place
        self.pressed = False
        self.recount(count)

    def past_switch(self, count: float) -> bool:
        """Whether going straight to ``count`` would close the limit switch."""
        trial = copy.copy(self)
        trial.pressed = False
        trial.follow(count)
        return trial.pressed


class Carriage:
    """Motors, screws, carriage in machine coordinates, 0 at the switches. ``motion`` is the
    controller's count, changed only as `follow` gives it; ``starts``: how often it set out from
    rest.
    """

    def __init__(
        self, place_mm: Vector, travel_mm: Vector, play_mm: Vector, at_far_end: frozenset[int]
    ) -> None:
        axes = zip(place_mm, travel_mm, play_mm, strict=True)
        self._axes = [
            AxisDrive(place, low=-travel, high=0.0, play=play, at_far_end=axis in at_far_end)
            for axis, (place, travel, play) in enumerate(axes)
        ]
        self._zero = tuple(0.0 for _ in self._axes)
        self.motion = Motion(self._zero)
        self.starts = 0
        self._seen_s = -math.inf  # up to when the axes have followed the motion
        self._homing: tuple[HomingRun, float] | None = None
        self._stalled_homing: Vector | None = None

    @property
    def homing(self) -> bool:
        return self._homing is not None

    def moving(self, now_s: float) -> bool:
        return self.homing or self.motion.moving(now_s)

    def follow(self, now_s: float) -> Motion:
        """Bring the axes up to this moment; the motion."""
        if not self._homing and now_s > self._seen_s:
            for count in self.motion.turns(self._seen_s, now_s):
                _follow(self._axes, count)
            self._seen_s = now_s
        return self.motion

    def place_mm(self, now_s: float) -> Vector:
        if self._homing:
            return self._stalled_homing or self._homing[0].position(now_s - self._homing[1])
        self.follow(now_s)
        return tuple([axis.place for axis in self._axes])

    def due_s(self, now_s: float) -> float:
        """When the running block or the homing cycle ends; ``inf`` at rest."""
        if self._homing:
            return self._homing[1] + self._homing[0].end_s
        return self.motion.next_end_s(now_s)

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
        self.motion = Motion(self._zero)
        for axis in self._axes:
            axis.recount(0.0)

    def start_homing(self, settings: Store, broken: dict[int, Switch], now_s: float) -> None:
        """Begin the cycle from where the carriage stands."""
        place = self.place_mm(now_s)
        self._stall(False)
        self._homing, self._stalled_homing = (HomingRun(place, settings, broken), now_s), None
        self.starts += 1

    def finish_homing(self, home_mm: Vector, now_s: float) -> int | None:
        """At the cycle's end: set the count, or give the alarm that ended it."""
        if self._homing is None:
            return None
        run, place = self._homing[0], self.place_mm(now_s)
        if run.alarm is not None:
            self.halt(now_s)
        else:
            tracked = zip(home_mm, place, run.tracks, strict=True)
            homed = tuple(home if track else at for home, at, track in tracked)
            self.motion = Motion(home_mm)
            self._end_homing(self._stalled_homing or homed, now_s)
        return run.alarm

    def homing_over(self, now_s: float) -> bool:
        return now_s >= self.due_s(now_s) - SOON_S if self._homing else True

    def stall(self, now_s: float) -> None:
        """The carriage stands until the next motion; the count goes on."""
        if self._homing:
            self._stalled_homing = self.place_mm(now_s)
        else:
            self.follow(now_s)
            self._stall(True)

    def lose_steps(self, amount_mm: float, now_s: float) -> None:
        """Lose that much on the linear axis that the running move takes furthest."""
        blocks = self.follow(now_s).blocks(now_s)
        unit = blocks[0].unit[:3] if blocks else (1.0,)
        self._axes[max(range(len(unit)), key=lambda axis: abs(unit[axis]))].to_lose += amount_mm

    def take_pressed(self, now_s: float) -> bool:
        """Whether a limit switch has closed since this was last asked."""
        if self._homing:
            return False
        self.follow(now_s)
        pressed = any(axis.pressed for axis in self._axes)
        for axis in self._axes:
            axis.pressed = False
        return pressed

    def switch_due_s(self, now_s: float) -> float:
        """When the motion that is planned closes a limit switch; ``inf`` where it doesn't."""
        if self._homing or not (legs := self.motion.legs(now_s)):
            return math.inf
        self.follow(now_s)
        ahead, start = [copy.copy(axis) for axis in self._axes], now_s
        for leg in legs:
            end = leg.block.place(leg.end_mm)
            if _closes_switch(ahead, end):
                return _closing_s(ahead, leg, start)
            _follow(ahead, end)
            start = leg.end_s
        return math.inf

    def _stall(self, on: bool) -> None:
        for axis in self._axes:
            axis.stalled = on

    def _end_homing(self, place_mm: Vector, now_s: float) -> None:
        self._homing = self._stalled_homing = None
        count_mm = self.motion.position(now_s)
        for axis, place, count in zip(self._axes, place_mm, count_mm, strict=True):
            axis.settle(place, count)
        self._seen_s = now_s


def _follow(axes: list[AxisDrive], count_mm: Vector) -> None:
    for axis, count in zip(axes, count_mm, strict=True):
        axis.follow(count)


def _closes_switch(axes: list[AxisDrive], count_mm: Vector) -> bool:
    """Whether going straight to ``count_mm`` closes a limit switch on the way."""
    return any(axis.past_switch(count) for axis, count in zip(axes, count_mm, strict=True))


def _closing_s(axes: list[AxisDrive], leg: Leg, start_s: float) -> float:
    """When on ``leg`` a switch closes, by halving; at least when it has closed."""
    low, high = start_s, leg.end_s
    for _ in range(50):
        middle = (low + high) / 2
        if _closes_switch(axes, leg.block.place(leg.place_mm(middle))):
            high = middle
        else:
            low = middle
    return high


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
