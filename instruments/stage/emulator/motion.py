"""The counted position as a function of time: one plan, looked into at any moment.

What is left of the plan is planned anew, from the speed of that moment, when a block is added, an override
changes, or a hold begins. It may not know what the carriage does with the count.
"""

from __future__ import annotations

import math
from dataclasses import replace

from instruments.stage.emulator.phases import SOON_S, Vector
from instruments.stage.emulator.planner import AxisRates, Block, Leg, block_to, brake, plan


class Motion:
    """The stage's counted position over time, mm. Moments must not go back."""

    def __init__(self, at_mm: Vector) -> None:
        self._rest = at_mm
        self._legs: tuple[Leg, ...] = ()
        self._held: tuple[Block, ...] = ()
        self.percent = (100, 100)

    def position(self, now_s: float) -> Vector:
        leg = next((leg for leg in self._legs if now_s < leg.end_s), self._legs[-1] if self._legs else None)
        return leg.block.place(leg.place_mm(now_s)) if leg else self._rest

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
        # A leg that ends short of its block is braking for a hold; what is left of its block is among the held.
        unfinished = (leg for leg in self._legs if leg.end_s > now_s + SOON_S)
        return tuple(leg.block for leg in unfinished if leg.end_mm >= leg.block.length_mm) + self._held

    def next_end_s(self, now_s: float) -> float:
        """When the running block ends, or stops; ``inf`` at rest."""
        return next((leg.end_s for leg in self._legs if leg.end_s > now_s + SOON_S), math.inf)

    @property
    def target(self) -> Vector:
        """Where all that is planned ends."""
        if self._held:
            return self._held[-1].target_mm
        return self._legs[-1].block.place(self._legs[-1].end_mm) if self._legs else self._rest

    def go(self, target: Vector, feed_mm_s: float | None, rates: AxisRates, now_s: float) -> bool:
        """Plan a move to ``target`` after all that is planned; False where there is nothing to go."""
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
        running = [leg for leg in self._legs if leg.end_s > now_s + SOON_S]
        if self._held or not running:
            return self._held, 0.0
        first = replace(running[0].block, from_mm=running[0].place_mm(now_s))
        return (first, *(leg.block for leg in running[1:])), running[0].speed_at(now_s)
