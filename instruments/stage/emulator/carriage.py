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

from instruments.stage.emulator.homing import HomingRates, HomingRun, Switch, homing
from instruments.stage.emulator.motion import SOON_S, AxisRates, Block, Leg, Motion, Vector
from instruments.world.phantom import PlatePose

PRESSED_MM = 0.005  # how far past its edge a limit switch is closed


@dataclass
class AxisDrive:
    """One axis. ``low``, ``high``: rails' ends, mm; ``play``: the motor's travel after a reversal
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
        self._carry(min(max(self.place, self.motor - below), self.motor + above))

    def _carry(self, wanted: float) -> None:
        """Move the carriage to ``wanted`` or the rail's end; the motor loses the rest."""
        self.place = min(max(wanted, self.low), self.high)
        over = wanted - self.place
        if over:
            self.motor -= over
            self.pressed = self.pressed or (
                over < -PRESSED_MM if self.at_far_end else over > PRESSED_MM
            )

    def recount(self, count: float) -> None:
        """Nothing moves; from now on the controller counts from here."""
        self.count = count
        self.to_lose, self.stalled = 0.0, False

    def settle(self, place: float, count: float) -> None:
        """The carriage stands at ``place`` with the play taken up, and this counts as ``count``."""
        self.place = self.motor = place
        self.pressed = False
        self.recount(count)

    def knock(self, way: float) -> None:
        """The carriage, and the motor with it, is pushed by ``way`` while the count stays."""
        self.motor += way
        self._carry(self.place + way)

    def past_switch(self, count: float) -> bool:
        """Whether going straight to ``count`` would close the limit switch."""
        trial = copy.copy(self)
        trial.pressed = False
        trial.follow(count)
        return trial.pressed


class Drive:
    """All axes: a carriage at ``place_mm`` on rails of ``travel_mm``."""

    def __init__(
        self, place_mm: Vector, travel_mm: Vector, play_mm: Vector, at_far_end: frozenset[int]
    ) -> None:
        self.axes = [
            AxisDrive(place, low=-travel, high=0.0, play=play, at_far_end=axis in at_far_end)
            for axis, (place, travel, play) in enumerate(
                zip(place_mm, travel_mm, play_mm, strict=True)
            )
        ]

    @property
    def place_mm(self) -> Vector:
        """Where the carriage is."""
        return tuple([axis.place for axis in self.axes])

    @property
    def pressed(self) -> bool:
        """Whether a limit switch has closed since this was last forgotten."""
        return any(axis.pressed for axis in self.axes)

    def follow(self, count_mm: Vector) -> None:
        """The count goes straight to ``count_mm``."""
        for axis, count in zip(self.axes, count_mm, strict=True):
            axis.follow(count)

    def settle(self, place_mm: Vector, count_mm: Vector) -> None:
        """The carriage stands at ``place_mm``, which counts as ``count_mm``."""
        for axis, place, count in zip(self.axes, place_mm, count_mm, strict=True):
            axis.settle(place, count)

    def recount(self, count_mm: Vector) -> None:
        """Nothing moves; from now on the controller counts from here."""
        for axis, count in zip(self.axes, count_mm, strict=True):
            axis.recount(count)

    def stall(self, on: bool) -> None:
        """The motors stand while the count goes on, or hold again."""
        for axis in self.axes:
            axis.stalled = on

    def forget_pressed(self) -> None:
        """The switches have been heard."""
        for axis in self.axes:
            axis.pressed = False

    def closes_switch(self, count_mm: Vector) -> bool:
        """Whether going straight to ``count_mm`` closes a limit switch on the way."""
        return any(axis.past_switch(count) for axis, count in zip(self.axes, count_mm, strict=True))

    def lose(self, axis: int, amount_mm: float) -> None:
        """From now on ``axis`` loses all steps, until it has lost this much."""
        self.axes[axis].to_lose += amount_mm

    def copy(self) -> Drive:
        """Another one in the same state, to look ahead with."""
        twin = copy.copy(self)
        twin.axes = [copy.copy(axis) for axis in self.axes]
        return twin


class Carriage:
    """Motors, screws, carriage; mm (degrees for A) in machine coordinates, 0 at the switches."""

    def __init__(self, drive: Drive) -> None:
        self._zero = tuple(0.0 for _ in drive.axes)
        self._motion = Motion(self._zero)
        self._drive = drive
        self._seen_s = -math.inf  # up to when the drive has followed the motion
        self._homing: tuple[HomingRun, float] | None = None
        self._stalled_homing: Vector | None = None
        self.starts = 0  # how often it has set out from rest

    @property
    def homing(self) -> bool:
        return self._homing is not None

    @property
    def percent(self) -> tuple[int, int]:
        """The feed and rapid overrides."""
        return self._motion.percent

    @property
    def target_mm(self) -> Vector:
        """Where the count will be when all that is planned is done."""
        return self._motion.target

    def moving(self, now_s: float) -> bool:
        return self.homing or self._motion.moving(now_s)

    def count_mm(self, now_s: float) -> Vector:
        """What the controller believes."""
        return self._motion.position(now_s)

    def speed_mm_s(self, now_s: float) -> float:
        return self._motion.speed(now_s)

    def place_mm(self, now_s: float) -> Vector:
        """Where the carriage is."""
        if self._homing:
            return self._stalled_homing or self._homing[0].position(now_s - self._homing[1])
        self._follow(now_s)
        return self._drive.place_mm

    def blocks(self, now_s: float) -> tuple[Block, ...]:
        return self._motion.blocks(now_s)

    def due_s(self, now_s: float) -> float:
        """When the running block or the homing cycle ends; ``inf`` at rest."""
        if self._homing:
            return self._homing[1] + self._homing[0].end_s
        return self._motion.next_end_s(now_s)

    def go(
        self, target_mm: Vector, feed_mm_s: float | None, rates: AxisRates, now_s: float
    ) -> None:
        """Plan a move after all that is planned; None is as fast as possible."""
        self._follow(now_s)
        still = not self.moving(now_s)
        if still:
            self._drive.stall(False)  # the motor holds again, as far off as a stall has left it
        if self._motion.go(target_mm, feed_mm_s, rates, now_s) and still:
            self.starts += 1

    def hold(self, now_s: float) -> None:
        """Brake and keep what is left of the plan."""
        self._follow(now_s)
        self._motion.hold(now_s)

    def resume(self, now_s: float) -> None:
        """Go on with what a hold has left."""
        self._follow(now_s)
        self._motion.resume(now_s)

    def cancel(self, now_s: float) -> None:
        """Brake and forget what is left of the plan."""
        self._follow(now_s)
        self._motion.cancel(now_s)

    def override(self, feed: int, rapid: int, now_s: float) -> None:
        """Change the overrides, in percent."""
        self._follow(now_s)
        self._motion.override(feed, rapid, now_s)

    def halt(self, now_s: float) -> None:
        """Cut the steps."""
        place = self.place_mm(now_s)
        self._motion.halt(now_s)
        if self._homing:
            self._end_homing(place, now_s)

    def cut_power(self, now_s: float) -> None:
        """Off and on again: the count starts at nought, the carriage stays."""
        self.halt(now_s)
        self._motion = Motion(self._zero)
        self._drive.recount(self._zero)

    def start_homing(self, rates: HomingRates, broken: dict[int, Switch], now_s: float) -> None:
        """Begin the cycle from where the carriage stands."""
        place = self.place_mm(now_s)
        self._drive.stall(False)
        self._homing, self._stalled_homing = (homing(place, rates, broken), now_s), None
        self.starts += 1

    def finish_homing(self, home_mm: Vector, now_s: float) -> int | None:
        """At the cycle's end: set the count, or give the alarm that ended it."""
        if self._homing is None:
            return None
        run, place = self._homing[0], self.place_mm(now_s)
        if run.alarm is not None:
            self.halt(now_s)
        else:
            homed = (
                home if track else at
                for home, at, track in zip(home_mm, place, run.tracks, strict=True)
            )
            self._motion = Motion(home_mm)
            self._end_homing(self._stalled_homing or tuple(homed), now_s)
        return run.alarm

    def homing_over(self, now_s: float) -> bool:
        return now_s >= self.due_s(now_s) - SOON_S if self._homing else True

    def stall(self, now_s: float) -> None:
        """The carriage stands until the next motion; the count goes on."""
        if self._homing:
            self._stalled_homing = self.place_mm(now_s)
        else:
            self._follow(now_s)
            self._drive.stall(True)

    def lose_steps(self, amount_mm: float, now_s: float) -> None:
        """Lose that much on the linear axis that the running move takes furthest."""
        self._follow(now_s)
        blocks = self.blocks(now_s)
        unit = blocks[0].unit[:3] if blocks else (1.0,)
        self._drive.lose(max(range(len(unit)), key=lambda axis: abs(unit[axis])), amount_mm)

    def knock(self, way_mm: Vector, now_s: float) -> None:
        """Push the carriage against the count."""
        self._follow(now_s)
        for axis, way in zip(self._drive.axes, way_mm, strict=False):
            axis.knock(way)

    def take_pressed(self, now_s: float) -> bool:
        """Whether a limit switch has closed since this was last asked."""
        if self._homing:
            return False
        self._follow(now_s)
        pressed = self._drive.pressed
        self._drive.forget_pressed()
        return pressed

    def switch_due_s(self, now_s: float) -> float:
        """When the motion that is planned closes a limit switch; ``inf`` where it doesn't."""
        if self._homing or not (legs := self._motion.legs(now_s)):
            return math.inf
        self._follow(now_s)
        ahead, start = self._drive.copy(), now_s
        for leg in legs:
            end = leg.block.place(leg.end_mm)
            if ahead.closes_switch(end):
                return _closing_s(ahead, leg, start)
            ahead.follow(end)
            start = leg.end_s
        return math.inf

    def _follow(self, now_s: float) -> None:
        """Bring the drive up to this moment."""
        if not self._homing and now_s > self._seen_s:
            for count in self._motion.turns(self._seen_s, now_s):
                self._drive.follow(count)
            self._seen_s = now_s

    def _end_homing(self, place_mm: Vector, now_s: float) -> None:
        self._homing = self._stalled_homing = None
        self._drive.settle(place_mm, self._motion.position(now_s))
        self._seen_s = now_s


def _closing_s(drive: Drive, leg: Leg, start_s: float) -> float:
    """When on ``leg`` a switch closes, by halving; at least when it has closed."""
    low, high = start_s, leg.end_s
    for _ in range(50):
        middle = (low + high) / 2
        if drive.closes_switch(leg.block.place(leg.place_mm(middle))):
            high = middle
        else:
            low = middle
    return high


@dataclass(frozen=True, slots=True)
class Mounting:
    """A stage of ``axes`` (as "XYZA") that carries the plate; the pose is zero at ``reference``.

    ``scale_errors`` by axis: 0.001 moves a thousandth too far. ``squareness_rad``: angle from X to
    Y, less a right angle. ``yaw_rad``: from the world's x to the X axis, x towards y. A turns the
    plate x towards y on top of X and Y.
    """

    axes: str
    reference: tuple[float, float, float, float]
    scale_errors: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    squareness_rad: float = 0.0
    yaw_rad: float = 0.0

    def pose(self, place: Sequence[float]) -> PlatePose:
        """The plate's pose for X Y Z in mm and A in degrees; below its reference it rests on the
        table.
        """
        x, y, z, a = (
            self._way(axis, at)
            for axis, at in zip("XYZA", (*place, self.reference[3])[:4], strict=True)
        )
        lean = math.pi / 2 + self.squareness_rad + self.yaw_rad
        return PlatePose(
            x_mm=x * math.cos(self.yaw_rad) + y * math.cos(lean),
            y_mm=x * math.sin(self.yaw_rad) + y * math.sin(lean),
            z_mm=max(0.0, z),
            yaw_rad=math.radians(a),
        )

    def _way(self, axis: str, at: float) -> float:
        """The plate's way along ``axis`` from the reference; 0 where nothing is carried."""
        index = "XYZA".index(axis)
        return (
            (1.0 + self.scale_errors[index]) * (at - self.reference[index])
            if axis in self.axes
            else 0.0
        )
