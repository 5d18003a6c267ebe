"""Straight moves over time: constant acceleration, each from rest to rest, one after the other.

Where a real controller rounds corners without a stop, this one stops at each end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

# one number an axis: X Y Z, and A where the board has it; mm, and degrees for A
Vector = tuple[float, ...]
SOON_S = 1e-9  # two moments nearer than this are one: sums of times differ in their last bits
LEAST_MM_S = 1 / 60  # the firmware's slowest feed
LEAST_MM_S2 = 0.01  # for a setting of 0, which no board can do anything with
ROUNDED = 1e-12  # of a length: its parts differ from it in their last bits


@dataclass(frozen=True, slots=True)
class AxisRates:
    """What each axis can do: mm/s and mm/s²."""

    speed_mm_s: Vector
    accel_mm_s2: Vector

    def along(self, unit: Vector, of: Vector) -> float:
        """The most that a motion along ``unit`` may have without any axis exceeding ``of``."""
        return min([most / abs(u) for u, most in zip(unit, of, strict=True) if abs(u) > 1e-12])


@dataclass(frozen=True, slots=True)
class LinearMove:
    """A straight move. ``feed_mm_s``: what was asked for; None is as fast as possible."""

    start_mm: Vector
    target_mm: Vector
    length_mm: float
    feed_mm_s: float | None
    top_mm_s: float
    accel_mm_s2: float

    def speed_mm_s(self, feed_percent: int, rapid_percent: int) -> float:
        """The speed to go at, under the overrides."""
        speed = self.top_mm_s * rapid_percent / 100
        if self.feed_mm_s is not None:
            speed = min(self.feed_mm_s * feed_percent / 100, self.top_mm_s)
        return max(speed, LEAST_MM_S)

    def place(self, along_mm: float) -> Vector:
        if along_mm >= self.length_mm:
            return self.target_mm
        share = along_mm / self.length_mm
        pairs = zip(self.start_mm, self.target_mm, strict=True)
        return tuple([start + (end - start) * share for start, end in pairs])


class MoveSegment:
    """What is run of a move: ``way_mm`` > 0 from ``from_mm`` on, from ``entry_mm_s`` to rest, at
    ``speed_mm_s`` between.
    """

    def __init__(
        self,
        move: LinearMove,
        from_mm: float,
        way_mm: float,
        start_s: float,
        speed_mm_s: float,
        entry_mm_s: float = 0.0,
    ) -> None:
        self.move, self._from_mm, self._way_mm, self._start_s = move, from_mm, way_mm, start_s
        accel, entry = move.accel_mm_s2, entry_mm_s
        top = min(speed_mm_s, math.sqrt(accel * way_mm + entry**2 / 2))
        first = accel if top >= entry else -accel
        cruise_mm = way_mm - (top**2 - entry**2) / (2 * first) - top**2 / (2 * accel)
        # seconds, first speed and acceleration of each phase
        self._phases = (
            ((top - entry) / first, entry, first),
            (max(0.0, cruise_mm) / top, top, 0.0),
            (top / accel, top, -accel),
        )
        self.end_s = start_s + sum([seconds for seconds, _, _ in self._phases])

    def at(self, now_s: float) -> tuple[float, float]:
        """How far along its move, mm, and how fast, mm/s."""
        left_s, way = now_s - self._start_s, 0.0
        for seconds, speed, accel in self._phases:
            t = min(max(left_s, 0.0), seconds)
            way += speed * t + accel * t * t / 2
            if left_s < seconds:
                return self._from_mm + way, speed + accel * t
            left_s -= seconds
        return self._from_mm + self._way_mm, 0.0

    @property
    def end_mm(self) -> Vector:
        """The move's own target where it goes so far, whatever parts of it were run before."""
        along_mm = self._from_mm + self._way_mm
        whole = along_mm >= self.move.length_mm * (1.0 - ROUNDED)
        return self.move.target_mm if whole else self.move.place(along_mm)


class CountedMotion:
    """The stage's counted position over time, mm. Moments must not go back."""

    def __init__(self, at_mm: Vector) -> None:
        self._rest = at_mm
        self._legs: tuple[MoveSegment, ...] = ()
        self._held: tuple[tuple[LinearMove, float], ...] = ()  # and how far each has come
        self.percent = (100, 100)  # the overrides of feed and of rapid moves

    def position(self, now_s: float) -> Vector:
        for leg in self._legs:
            if now_s < leg.end_s:
                return leg.move.place(leg.at(now_s)[0])
        return self._legs[-1].end_mm if self._legs else self._rest

    def turns(self, since_s: float, now_s: float) -> list[Vector]:
        """Where it was at each end of a straight line after ``since_s``, and where it is now."""
        ends = [leg.end_mm for leg in self._legs if since_s < leg.end_s <= now_s]
        return [*ends, self.position(now_s)]

    def speed(self, now_s: float) -> float:
        """Along the path, mm/s."""
        return next((leg.at(now_s)[1] for leg in self._legs if now_s < leg.end_s), 0.0)

    def moving(self, now_s: float) -> bool:
        return bool(self._legs) and self._legs[-1].end_s > now_s + SOON_S

    def next_end_s(self, now_s: float) -> float:
        """When the running move ends, or stops; ``inf`` at rest."""
        return next((leg.end_s for leg in self._legs if leg.end_s > now_s + SOON_S), math.inf)

    def left(self, now_s: float) -> tuple[tuple[LinearMove, float], ...]:
        """The moves that are not over, the running one first, and how far each has come."""
        if self._held:
            return self._held
        legs = [leg for leg in self._legs if leg.end_s > now_s + SOON_S]
        return tuple([(leg.move, leg.at(now_s)[0]) for leg in legs])

    @property
    def target(self) -> Vector:
        """Where all that is planned ends."""
        if self._held:
            return self._held[-1][0].target_mm
        return self._legs[-1].end_mm if self._legs else self._rest

    def go(self, target: Vector, feed_mm_s: float | None, rates: AxisRates, now_s: float) -> bool:
        """Plan a move to ``target`` behind all others; False where there is nothing to go."""
        start = self.target
        length = math.dist(start, target)
        if length == 0:
            return False
        unit = tuple([(end - at) / length for at, end in zip(start, target, strict=True)])
        top, accel = (rates.along(unit, of) for of in (rates.speed_mm_s, rates.accel_mm_s2))
        move = LinearMove(start, target, length, feed_mm_s, top, max(accel, LEAST_MM_S2))
        self._plan((*self.left(now_s), (move, 0.0)), now_s)
        return True

    def hold(self, now_s: float) -> None:
        """Brake; what is left waits for ``resume``."""
        left, speed = self.left(now_s), self.speed(now_s)
        self._rest, self._legs, self._held = self.position(now_s), (), left
        if left and speed > 0:
            move, along = left[0]
            brake_mm = min(speed**2 / (2 * move.accel_mm_s2), move.length_mm - along)
            if brake_mm > 0:
                self._legs = (MoveSegment(move, along, brake_mm, now_s, speed, speed),)
                self._held = ((move, along + brake_mm), *left[1:])

    def resume(self, now_s: float) -> None:
        """Go on with what a hold left. Only at rest."""
        left, self._held = self._held, ()
        self._plan(left, now_s)

    def override(self, feed: int, rapid: int, now_s: float) -> None:
        """Change the overrides, in percent, at once."""
        self.percent = (feed, rapid)
        if not self._held:
            self._plan(self.left(now_s), now_s)

    def cancel(self, now_s: float) -> None:
        """Brake, and forget what is left."""
        self.hold(now_s)
        self._held = ()

    def halt(self, now_s: float) -> None:
        """Stop dead and forget the plan: the steps are cut."""
        self._rest = self.position(now_s)
        self._legs = self._held = ()

    def _plan(self, left: Sequence[tuple[LinearMove, float]], now_s: float) -> None:
        """Run what is left one after the other, the first from the speed that it has."""
        if self._held:  # a new move waits behind those held
            self._held = tuple(left)
            return
        speed, self._rest = self.speed(now_s), self.position(now_s)
        legs: list[MoveSegment] = []
        for move, along in left:
            if (way := move.length_mm - along) > 0:
                top = move.speed_mm_s(*self.percent)
                legs.append(MoveSegment(move, along, way, now_s, top, speed))
                now_s, speed = legs[-1].end_s, 0.0
        self._legs = tuple(legs)
