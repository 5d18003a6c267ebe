"""Straight moves with limited acceleration as a function of time, joined without a stop where
corners allow it; and the homing cycle.

A plan is a row of legs, each a line and its phases; what is left is planned anew when a block is
added, an override changes, or a hold begins. Source: S.-K. Jeon's GRBL planner (two-pass
look-ahead; the corner speed is that on a circle which leaves the corner by at most the junction
deviation, $11).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from instruments.stage.emulator.store import Store

# one number an axis: X Y Z, and A where the board has it; mm, and degrees for A
Vector = tuple[float, ...]
SOON_S = 1e-9  # two moments nearer than this are one: sums of times differ in their last bits


@dataclass(frozen=True, slots=True)
class Phase:
    """Constant acceleration along a line; s from any origin, mm along the line."""

    start_s: float
    seconds: float
    start_mm: float
    speed_mm_s: float
    accel_mm_s2: float

    @property
    def end_s(self) -> float:
        return self.start_s + self.seconds

    def place_mm(self, now_s: float) -> float:
        t = min(max(now_s - self.start_s, 0.0), self.seconds)
        return self.start_mm + self.speed_mm_s * t + self.accel_mm_s2 * t * t / 2

    def speed_at(self, now_s: float) -> float:
        t = min(max(now_s - self.start_s, 0.0), self.seconds)
        return self.speed_mm_s + self.accel_mm_s2 * t


def profile(
    length_mm: float, entry: float, cruise: float, leave: float, accel: float
) -> list[tuple[float, float, float]]:
    """The fastest way along ``length_mm`` from speed ``entry`` to ``leave`` at most ``cruise``, as
    phases (seconds, first speed, acceleration). A higher ``entry`` is braked first.
    """
    if length_mm <= 0:
        return []
    if entry**2 - leave**2 >= 2 * accel * length_mm:
        return [(2 * length_mm / (entry + leave), entry, (leave**2 - entry**2) / (2 * length_mm))]
    peak = min(cruise, math.sqrt((2 * accel * length_mm + entry**2 + leave**2) / 2))
    first = accel if peak >= entry else -accel
    first_mm = (peak**2 - entry**2) / (2 * first)
    last_mm = max(0.0, (peak**2 - leave**2) / (2 * accel))
    phases = [
        ((peak - entry) / first, entry, first),
        (max(0.0, length_mm - first_mm - last_mm) / peak, peak, 0.0),
        (max(0.0, peak - leave) / accel, peak, -accel),
    ]
    return [phase for phase in phases if phase[0] > 0]


def lay(
    phases: Sequence[tuple[float, float, float]], start_s: float, start_mm: float = 0.0
) -> tuple[Phase, ...]:
    """Phases one after the other from ``start_s`` and ``start_mm`` on."""
    laid = []
    for seconds, speed, accel in phases:
        laid.append(Phase(start_s, seconds, start_mm, speed, accel))
        start_s += seconds
        start_mm += speed * seconds + accel * seconds * seconds / 2
    return tuple(laid)


@dataclass(frozen=True, slots=True)
class AxisRates:
    """What each axis can do: mm/s and mm/s²; and the junction deviation in mm."""

    speed_mm_s: Vector
    accel_mm_s2: Vector
    deviation_mm: float

    def along(self, unit: Vector, of: Vector) -> float:
        """The most that a motion along ``unit`` may have without any axis exceeding ``of``."""
        limits = (most / abs(u) for u, most in zip(unit, of, strict=True) if abs(u) > 1e-12)
        return min(limits, default=math.inf)


@dataclass(frozen=True, slots=True)
class Block:
    """A straight move, or what is left of one from ``from_mm`` on."""

    start_mm: Vector
    target_mm: Vector
    unit: Vector
    length_mm: float
    feed_mm_s: float
    rapid: bool
    top_mm_s: float
    accel_mm_s2: float
    junction_mm_s: float
    from_mm: float = 0.0

    @property
    def left_mm(self) -> float:
        return self.length_mm - self.from_mm

    def cruise_mm_s(self, feed_percent: int, rapid_percent: int) -> float:
        """The speed asked for, under the overrides."""
        if self.rapid:
            return self.top_mm_s * rapid_percent / 100
        return min(self.feed_mm_s * feed_percent / 100, self.top_mm_s)

    def place(self, along_mm: float) -> Vector:
        if along_mm >= self.length_mm:
            return self.target_mm
        pairs = zip(self.start_mm, self.unit, strict=True)
        return tuple([start + u * along_mm for start, u in pairs])


def block_to(
    start: Vector, target: Vector, feed_mm_s: float | None, rates: AxisRates, before: Block | None
) -> Block | None:
    """The block from ``start`` to ``target``; None for no way. No ``feed_mm_s`` is a rapid."""
    length = math.dist(start, target)
    if length == 0:
        return None
    unit = tuple([(t - s) / length for s, t in zip(start, target, strict=True)])
    top = rates.along(unit, rates.speed_mm_s)
    return Block(
        start_mm=start,
        target_mm=target,
        unit=unit,
        length_mm=length,
        feed_mm_s=top if feed_mm_s is None else min(feed_mm_s, top),
        rapid=feed_mm_s is None,
        top_mm_s=top,
        accel_mm_s2=rates.along(unit, rates.accel_mm_s2),
        junction_mm_s=junction_speed(before.unit, unit, rates) if before else 0.0,
    )


def junction_speed(before: Vector, after: Vector, rates: AxisRates) -> float:
    """The speed on a circle that touches both lines and passes the corner at the deviation."""
    cosine = -sum(b * a for b, a in zip(before, after, strict=True))
    if cosine > 0.999999:
        return 0.0
    if cosine < -0.999999:
        return math.inf
    turn = [a - b for a, b in zip(after, before, strict=True)]
    size = math.hypot(*turn)
    accel = rates.along(tuple([d / size for d in turn]), rates.accel_mm_s2)
    half_sine = math.sqrt((1 - cosine) / 2)
    return math.sqrt(accel * rates.deviation_mm * half_sine / (1 - half_sine))


@dataclass(frozen=True, slots=True)
class Leg:
    """A block and when it is where."""

    block: Block
    phases: tuple[Phase, ...]
    end_s: float
    end_mm: float

    def place_mm(self, now_s: float) -> float:
        """How far along the block, mm."""
        if now_s >= self.end_s:
            return self.end_mm
        return self._phase(now_s).place_mm(now_s)

    def speed_at(self, now_s: float) -> float:
        return 0.0 if now_s >= self.end_s else self._phase(now_s).speed_at(now_s)

    def _phase(self, now_s: float) -> Phase:
        return next((phase for phase in self.phases if now_s < phase.end_s), self.phases[-1])


def plan(
    blocks: Sequence[Block], now_s: float, speed_mm_s: float, percent: tuple[int, int]
) -> tuple[Leg, ...]:
    """Legs through ``blocks`` from ``speed_mm_s`` to rest. ``percent``: feed, rapid overrides."""
    cruise = [block.cruise_mm_s(*percent) for block in blocks]
    corners = [min(b.junction_mm_s, cruise[i], cruise[i + 1]) for i, b in enumerate(blocks[1:])]
    entry = [speed_mm_s, *corners, 0.0]
    gains = [2 * block.accel_mm_s2 * block.left_mm for block in blocks]
    for i in range(len(blocks) - 1, 0, -1):
        entry[i] = min(entry[i], math.sqrt(entry[i + 1] ** 2 + gains[i]))
    legs = []
    for i, block in enumerate(blocks):
        entry[i + 1] = min(entry[i + 1], math.sqrt(entry[i] ** 2 + gains[i]))
        steps = profile(block.left_mm, entry[i], cruise[i], entry[i + 1], block.accel_mm_s2)
        phases = lay(steps, now_s, block.from_mm)
        now_s = phases[-1].end_s if phases else now_s
        legs.append(Leg(block, phases, now_s, block.length_mm))
    return tuple(legs)


def brake(
    blocks: Sequence[Block], now_s: float, speed_mm_s: float
) -> tuple[tuple[Leg, ...], tuple[Block, ...]]:
    """Legs that stop as soon as the acceleration allows, and what is left of the blocks then."""
    legs: list[Leg] = []
    left = list(blocks)
    while left and speed_mm_s > 0:
        block = left.pop(0)
        accel = block.accel_mm_s2
        way = speed_mm_s**2 / (2 * accel)
        after = 0.0
        if way > block.left_mm:
            after = math.sqrt(max(0.0, speed_mm_s**2 - 2 * accel * block.left_mm))
        end = min(block.from_mm + way, block.length_mm)
        phases = lay([((speed_mm_s - after) / accel, speed_mm_s, -accel)], now_s, block.from_mm)
        now_s, speed_mm_s = phases[-1].end_s, after
        legs.append(Leg(block, phases, now_s, end))
        if end < block.length_mm:
            left.insert(0, replace(block, from_mm=end))
    return tuple(legs), tuple(left)


class Motion:
    """The stage's counted position over time, mm. Moments must not go back."""

    def __init__(self, at_mm: Vector) -> None:
        self._rest = at_mm
        self._legs: tuple[Leg, ...] = ()
        self._held: tuple[Block, ...] = ()
        self.percent = (100, 100)

    def position(self, now_s: float) -> Vector:
        for leg in self._legs:
            if now_s < leg.end_s:
                return leg.block.place(leg.place_mm(now_s))
        return self._end

    def turns(self, since_s: float, now_s: float) -> list[Vector]:
        """Where it was at each end of a straight line after ``since_s``, and where it is now."""
        ends = [leg.block.place(leg.end_mm) for leg in self._legs if since_s < leg.end_s <= now_s]
        return [*ends, self.position(now_s)]

    def legs(self, now_s: float) -> tuple[Leg, ...]:
        """The straight lines that are still to go, the running one first."""
        return tuple(leg for leg in self._legs if leg.end_s > now_s + SOON_S)

    def speed(self, now_s: float) -> float:
        """Along the path, mm/s."""
        return next((leg.speed_at(now_s) for leg in self._legs if now_s < leg.end_s), 0.0)

    def moving(self, now_s: float) -> bool:
        return bool(self._legs) and self._legs[-1].end_s > now_s + SOON_S

    def blocks(self, now_s: float) -> tuple[Block, ...]:
        """What is not finished, the running one first."""
        # A leg that ends short of its block is braking for a hold; what is left of its block is
        # among the held.
        legs = self.legs(now_s)
        return tuple(leg.block for leg in legs if leg.end_mm >= leg.block.length_mm) + self._held

    def next_end_s(self, now_s: float) -> float:
        """When the running block ends, or stops; ``inf`` at rest."""
        return next((leg.end_s for leg in self._legs if leg.end_s > now_s + SOON_S), math.inf)

    @property
    def target(self) -> Vector:
        """Where all that is planned ends."""
        return self._held[-1].target_mm if self._held else self._end

    @property
    def _end(self) -> Vector:
        return self._legs[-1].block.place(self._legs[-1].end_mm) if self._legs else self._rest

    def go(self, target: Vector, feed_mm_s: float | None, rates: AxisRates, now_s: float) -> bool:
        """Plan a move to ``target`` behind all others; False where there is nothing to go."""
        waiting = self.blocks(now_s)
        block = block_to(self.target, target, feed_mm_s, rates, waiting[-1] if waiting else None)
        if block:
            self._replan(now_s, block)
        return block is not None

    def hold(self, now_s: float) -> None:
        """Brake; what is left waits for ``resume``."""
        left, speed = self._left(now_s)
        self._rest = self.position(now_s)
        self._legs, self._held = brake(left, now_s, speed)

    def resume(self, now_s: float) -> None:
        """Go on with what a hold left. Only at rest."""
        self._replan(now_s)

    def override(self, feed: int, rapid: int, now_s: float) -> None:
        """Change the overrides, in percent, at once."""
        self.percent = (feed, rapid)
        if not self._held:
            self._replan(now_s)

    def cancel(self, now_s: float) -> None:
        """Brake, and forget what is left."""
        self.hold(now_s)
        self._held = ()

    def halt(self, now_s: float) -> None:
        """Stop dead and forget the plan: the steps are cut."""
        self._rest = self.position(now_s)
        self._legs = self._held = ()

    def _replan(self, now_s: float, *more: Block) -> None:
        left, speed = self._left(now_s)
        self._rest = self.position(now_s)
        self._held = ()
        self._legs = plan((*left, *more), now_s, speed, self.percent)

    def _left(self, now_s: float) -> tuple[tuple[Block, ...], float]:
        """The blocks to go, the first cut at where it is now, and the speed."""
        running = self.legs(now_s)
        if self._held or not running:
            return self._held, 0.0
        first = replace(running[0].block, from_mm=running[0].place_mm(now_s))
        return (first, *(leg.block for leg in running[1:])), running[0].speed_at(now_s)


SEARCH = 1.5  # times the longest travel of the pass, before a switch counts as missing
LOCATE = 5.0  # times the pull-off


class Switch(Enum):
    """How a homing switch is broken."""

    MISSING = "never closes"
    STUCK = "never opens again"
    CROOKED = "of the axis's two motors, one finds its switch too late"


class HomingRun:
    """The homing cycle from ``start_mm`` as a function of time from 0, pass by pass: each axis
    seeks its switch fast, backs off, finds it again slowly and backs off. ``end_s``: when it ends;
    ``alarm``: what ends it; ``tracks``: phases by axis.
    """

    def __init__(self, start_mm: Vector, settings: Store, broken: Mapping[int, Switch]) -> None:
        self.tracks: tuple[list[Phase], ...] = tuple([] for _ in start_mm)
        self.end_s = 0.0
        self.alarm: int | None = None
        self._start_mm = start_mm
        self._settings = settings
        self._broken = broken
        for axes in settings.passes:
            if not self._home(axes):
                break

    def position(self, now_s: float) -> Vector:
        """Where the carriage is, mm."""
        return tuple(self._axis(axis, now_s) for axis in range(len(self.tracks)))

    def _axis(self, axis: int, now_s: float) -> float:
        place = self._start_mm[axis]
        for phase in self.tracks[axis]:
            if now_s < phase.start_s:
                break
            place = phase.place_mm(now_s)
        return place

    def _home(self, axes: tuple[int, ...]) -> bool:
        """One pass; whether it ended without an alarm."""
        seek, creep = self._settings[25] / 60, self._settings[24] / 60
        pull_off = self._settings[27]
        search = SEARCH * max(self._settings.travel_mm[axis] for axis in axes)
        for approach, reach, speed in (
            (True, search, seek),
            (False, pull_off, seek),
            (True, LOCATE * pull_off, creep),
            (False, pull_off, seek),
        ):
            run = self._approach if approach else self._back_off
            self.end_s += max([run(axis, reach, speed) for axis in axes])
            if self.alarm:
                return False
            self.end_s += self._settings[26] / 1000
        return True

    def _towards(self, axis: int) -> float:
        return -1.0 if axis in self._settings.at_far_end else 1.0

    def _back_off(self, axis: int, reach: float, speed: float) -> float:
        if self._broken.get(axis) is Switch.STUCK:
            self.alarm = 8
        return self._run(axis, -self._towards(axis) * reach, speed, dead_stop=False)

    def _approach(self, axis: int, reach: float, speed: float) -> float:
        towards, fault = self._towards(axis), self._broken.get(axis)
        gap = towards * (self._settings.switch_mm(axis) - self._axis(axis, self.end_s))
        if fault is Switch.MISSING or gap > reach:
            # the carriage stops at the end of its rails, the motor goes on
            self.alarm = 9
            way = towards * max(0.0, min(gap, reach))
            return max(reach / speed, self._run(axis, way, speed, dead_stop=True))
        if fault is Switch.CROOKED:
            self.alarm = self._settings.dialect.crooked_alarm
        return self._run(axis, towards * max(0.0, gap), speed, dead_stop=True)

    def _run(self, axis: int, way_mm: float, speed: float, *, dead_stop: bool) -> float:
        """Append one axis's run of ``way_mm`` (with its sign) from ``end_s`` on; its seconds."""
        accel, place = self._settings.rates.accel_mm_s2[axis], self._axis(axis, self.end_s)
        sign = 1.0 if way_mm >= 0 else -1.0
        leave = min(speed, math.sqrt(2 * accel * abs(way_mm))) if dead_stop else 0.0
        steps = profile(abs(way_mm), 0.0, speed, leave, accel)
        phases = lay([(seconds, sign * v, sign * a) for seconds, v, a in steps], self.end_s, place)
        self.tracks[axis].extend(phases)
        return sum(seconds for seconds, _, _ in steps)
