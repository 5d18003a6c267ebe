"""Straight moves with limited acceleration, one after the other without stopping where the corner allows it.

A plan is a row of legs, each a line in space and its phases. It may not know G-code or a clock: the moment is
an argument.

Source: S.-K. Jeon's description of GRBL's planner (look-ahead in two passes; the speed at a corner is that on
a circle which leaves the corner by at most the junction deviation, setting $11).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from instruments.stage.emulator.phases import Phase, Vector, lay, profile


@dataclass(frozen=True, slots=True)
class AxisRates:
    """What each axis can do: mm/s and mm/s²; and the junction deviation in mm."""

    speed_mm_s: Vector
    accel_mm_s2: Vector
    deviation_mm: float

    def along(self, unit: Vector, of: Vector) -> float:
        """The most that a motion along ``unit`` may have without any axis exceeding ``of``."""
        return min((most / abs(u) for u, most in zip(unit, of, strict=True) if abs(u) > 1e-12), default=math.inf)


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
        return self.top_mm_s * rapid_percent / 100 if self.rapid else min(self.feed_mm_s * feed_percent / 100, self.top_mm_s)

    def place(self, along_mm: float) -> Vector:
        if along_mm >= self.length_mm:
            return self.target_mm
        return tuple([start + u * along_mm for start, u in zip(self.start_mm, self.unit, strict=True)])


def block_to(start: Vector, target: Vector, feed_mm_s: float | None, rates: AxisRates, before: Block | None) -> Block | None:
    """The block from ``start`` to ``target``; None where there is nothing to go. ``feed_mm_s`` None is a rapid move.

    ``before`` is the block that it follows without a stop.
    """
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
    """The speed at a corner: that on a circle which touches both lines and passes the corner at the deviation."""
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


def plan(blocks: Sequence[Block], now_s: float, speed_mm_s: float, percent: tuple[int, int]) -> tuple[Leg, ...]:
    """Legs through all ``blocks``, from ``speed_mm_s`` to rest. ``percent``: the feed and rapid overrides."""
    cruise = [block.cruise_mm_s(*percent) for block in blocks]
    entry = [speed_mm_s] + [min(b.junction_mm_s, cruise[i], cruise[i + 1]) for i, b in enumerate(blocks[1:])] + [0.0]
    for i in range(len(blocks) - 1, 0, -1):
        entry[i] = min(entry[i], math.sqrt(entry[i + 1] ** 2 + 2 * blocks[i].accel_mm_s2 * blocks[i].left_mm))
    legs = []
    for i, block in enumerate(blocks):
        entry[i + 1] = min(entry[i + 1], math.sqrt(entry[i] ** 2 + 2 * block.accel_mm_s2 * block.left_mm))
        phases = lay(profile(block.left_mm, entry[i], cruise[i], entry[i + 1], block.accel_mm_s2), now_s, block.from_mm)
        now_s = phases[-1].end_s if phases else now_s
        legs.append(Leg(block, phases, now_s, block.length_mm))
    return tuple(legs)


def brake(blocks: Sequence[Block], now_s: float, speed_mm_s: float) -> tuple[tuple[Leg, ...], tuple[Block, ...]]:
    """Legs that stop as soon as the acceleration allows, and what is left of the blocks then."""
    legs: list[Leg] = []
    left = list(blocks)
    while left and speed_mm_s > 0:
        block = left.pop(0)
        way = speed_mm_s**2 / (2 * block.accel_mm_s2)
        after = math.sqrt(max(0.0, speed_mm_s**2 - 2 * block.accel_mm_s2 * block.left_mm)) if way > block.left_mm else 0.0
        end = min(block.from_mm + way, block.length_mm)
        phases = lay([((speed_mm_s - after) / block.accel_mm_s2, speed_mm_s, -block.accel_mm_s2)], now_s, block.from_mm)
        now_s, speed_mm_s = phases[-1].end_s, after
        legs.append(Leg(block, phases, now_s, end))
        if end < block.length_mm:
            left.insert(0, replace(block, from_mm=end))
    return tuple(legs), tuple(left)
