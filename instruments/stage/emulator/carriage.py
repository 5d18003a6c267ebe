"""The mechanics: the counted position, the carriage's place, and what parts the two.

The controller counts steps; whether the carriage follows it can't know. A stall, lost steps or a power cut
make them differ, homing brings them together. It may not know the protocol, or a clock: the moment is an argument.
"""

from __future__ import annotations

from instruments.stage.emulator.homing import HomingRates, HomingRun, Switch, homing
from instruments.stage.emulator.motion import Motion
from instruments.stage.emulator.phases import SOON_S, Vector
from instruments.stage.emulator.planner import AxisRates, Block


def shifted(a: Vector, b: Vector, times: float = 1.0) -> Vector:
    """``a + times * b``."""
    return a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]


class Carriage:
    """Motors, screws, carriage. All places in mm in machine coordinates: 0 at the switches."""

    def __init__(self, start_mm: Vector) -> None:
        self._motion = Motion((0.0, 0.0, 0.0))
        self._slip = start_mm  # the carriage's place less the counted position
        self._stalled_at: Vector | None = None
        self._homing: tuple[HomingRun, float] | None = None
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
        if self._stalled_at:
            return self._stalled_at
        if self._homing:
            return self._homing[0].position(now_s - self._homing[1])
        return shifted(self._motion.position(now_s), self._slip)

    def blocks(self, now_s: float) -> tuple[Block, ...]:
        return self._motion.blocks(now_s)

    def due_s(self, now_s: float) -> float:
        """When the running block or the homing cycle ends; ``inf`` at rest."""
        if self._homing:
            return self._homing[1] + self._homing[0].end_s
        return self._motion.next_end_s(now_s)

    def go(self, target_mm: Vector, feed_mm_s: float | None, rates: AxisRates, now_s: float) -> None:
        """Plan a move after all that is planned; None is as fast as possible."""
        still = not self.moving(now_s)
        if still:
            self._grip(now_s)
        if self._motion.go(target_mm, feed_mm_s, rates, now_s) and still:
            self.starts += 1

    def hold(self, now_s: float) -> None:
        """Brake and keep what is left of the plan."""
        self._motion.hold(now_s)

    def resume(self, now_s: float) -> None:
        """Go on with what a hold has left."""
        self._motion.resume(now_s)

    def cancel(self, now_s: float) -> None:
        """Brake and forget what is left of the plan."""
        self._motion.cancel(now_s)

    def override(self, feed: int, rapid: int, now_s: float) -> None:
        """Change the overrides, in percent."""
        self._motion.override(feed, rapid, now_s)

    def halt(self, now_s: float) -> None:
        """Cut the steps."""
        if self._homing:
            self._slip = shifted(self.place_mm(now_s), self._motion.position(now_s), -1.0)
            self._homing = self._stalled_at = None
        self._motion.halt(now_s)

    def cut_power(self, now_s: float) -> None:
        """Off and on again: the count starts at nought, the carriage stays."""
        self._slip = self.place_mm(now_s)
        self._stalled_at = self._homing = None
        self._motion = Motion((0.0, 0.0, 0.0))

    def start_homing(self, rates: HomingRates, broken: dict[int, Switch], now_s: float) -> None:
        self._grip(now_s)
        self._homing = homing(self.place_mm(now_s), rates, broken), now_s
        self.starts += 1

    def finish_homing(self, home_mm: Vector, now_s: float) -> int | None:
        """At the cycle's end: set the count, or give the alarm that ended it."""
        alarm = self._homing[0].alarm if self._homing else None
        stalled = self._stalled_at
        self.halt(now_s)
        if alarm is None:
            self._motion = Motion(home_mm)
            self._slip = shifted(stalled or home_mm, home_mm, -1.0)
        return alarm

    def homing_over(self, now_s: float) -> bool:
        return now_s >= self.due_s(now_s) - SOON_S if self._homing else True

    def stall(self, now_s: float) -> None:
        """The carriage stands until the next motion; the count goes on."""
        self._stalled_at = self.place_mm(now_s)

    def lose_steps(self, lost_mm: Vector) -> None:
        """Shift the carriage against the count."""
        self._slip = shifted(self._slip, lost_mm)

    def _grip(self, now_s: float) -> None:
        """The motor holds again, as far off as a stall has left it."""
        if self._stalled_at:
            self._slip = shifted(self._stalled_at, self._motion.position(now_s), -1.0)
            self._stalled_at = None
