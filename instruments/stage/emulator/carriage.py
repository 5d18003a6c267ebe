"""The mechanics: from the counted position to the carriage and the plate on it.

The motor turns with the steps, less the lost ones. The carriage follows after the play is taken up,
and stands at the rails' ends, where further steps are lost. Exact when fed with the ends of
straight lines in order. Scale, squareness and yaw of the mounting give the plate's pose. The moment
is an argument and never goes back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from instruments.stage.emulator.motion import AxisRates, CountedMotion, Vector
from instruments.world.phantom import PlatePose

PRESSED_MM = 0.005  # how far past its edge a limit switch is closed


class Switch(Enum):
    """How a homing switch is broken."""

    MISSING = "never closes"
    STUCK = "never opens again"
    CROOKED = "of the axis's two motors, one finds its switch too late"


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

    def follow(self, count: float, *, homing: bool = False) -> None:
        """The count goes straight to ``count``; play is taken up while ``homing``."""
        way = count - self.count
        self.count = count
        if self.stalled or not way:
            return
        if homing:
            self.place = self.motor = min(max(self.place + way, self.low), 0.0)
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

    def recount(self, count: float) -> None:
        """Nothing moves; from now on the controller counts from here."""
        self.count = count
        self.to_lose, self.stalled, self.pressed = 0.0, False, False


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
        self.motion = CountedMotion((0.0,) * len(self._axes))
        self.starts = 0
        self._seen_s = -math.inf  # up to when the axes have followed the motion
        self.homing = False

    def moving(self, now_s: float) -> bool:
        return self.homing or self.motion.moving(now_s)

    def follow(self, now_s: float) -> CountedMotion:
        """Bring the axes up to this moment; the motion."""
        if now_s > self._seen_s:
            for counts in self.motion.turns(self._seen_s, now_s):
                for axis, count in zip(self._axes, counts, strict=True):
                    axis.follow(count, homing=self.homing)
            self._seen_s = now_s
        return self.motion

    def place_mm(self, now_s: float) -> Vector:
        self.follow(now_s)
        return tuple([axis.place for axis in self._axes])

    def pressed(self, now_s: float) -> list[int]:
        """The axes whose limit switch is closed."""
        self.follow(now_s)
        return [at for at, axis in enumerate(self._axes) if axis.pressed and not self.homing]

    def to_end_mm(self, axis: int, towards: float, now_s: float) -> float:
        """How far the carriage is from the rail's end on the side ``towards``, 1 or -1."""
        place = self.place_mm(now_s)[axis]
        return place - self._axes[axis].low if towards < 0 else -place

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
        """Cut the steps, of homing too."""
        self.follow(now_s).halt(now_s)
        self.homing = False

    def count_from(self, count_mm: Vector, now_s: float) -> None:
        """The controller counts from here, by power or at the end of homing."""
        self.halt(now_s)
        self.motion = CountedMotion(count_mm)
        for axis, count in zip(self._axes, count_mm, strict=True):
            axis.recount(count)

    def start_homing(self, now_s: float) -> None:
        """From now on moves home it."""
        self.follow(now_s)
        self._stall(False)
        self.homing = True
        self.starts += 1

    def stall(self, now_s: float) -> None:
        """The carriage stands until the next motion; the count goes on."""
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
