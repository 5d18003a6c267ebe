"""The mechanics: the counted position over time, and the carriage that follows it.

The controller counts steps; whether the carriage follows it can't know. A stall, lost steps, play or a power cut make them
differ, homing brings them together. It may not know the protocol, or a clock: the moment is an argument, and never goes back.
"""

from __future__ import annotations

import math

from instruments.stage.emulator.drive import Drive
from instruments.stage.emulator.homing import HomingRates, HomingRun, Switch, homing
from instruments.stage.emulator.motion import Motion
from instruments.stage.emulator.phases import SOON_S, Vector
from instruments.stage.emulator.planner import AxisRates, Block, Leg


class Carriage:
    """Motors, screws, carriage. All places in mm (degrees for A) in machine coordinates: 0 at the switches."""

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

    def go(self, target_mm: Vector, feed_mm_s: float | None, rates: AxisRates, now_s: float) -> None:
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
            homed = (home if track else at for home, at, track in zip(home_mm, place, run.tracks, strict=True))
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
        """From now on lose steps until this much is lost, on the linear axis that the running move takes furthest."""
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
