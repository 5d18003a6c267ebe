"""An emulated arm in virtual time, whose hand follows the dialogue."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime

from bench.calibrate.simulated_arm import PLACED, Step, TryingArm
from detector.geometry import Motion
from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.microscribe.driver import MicroScribe

MADE = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


@dataclass
class Follower:
    """A person who does as told, or ``instead`` another step, and remembers it."""

    hand: TryingArm
    instead: Callable[[Step], Step] = lambda step: step
    said: list[str] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)

    def ask(self, text: str) -> None:
        self.said.append(text)

    def say(self, text: str) -> None:
        self.said.append(text)

    def touch(self, step: Step) -> None:
        self.steps.append(step)
        self.hand.go(self.instead(step))


@contextmanager
def emulated(
    seed: int = 0, accuracy_mm: float = 0.23, placed: Motion = PLACED, length_mm: float = 300.0
) -> Iterator[tuple[MicroScribe, TryingArm]]:
    """A signed-on, homed emulated arm under virtual time, and what brings its tip to places."""
    clock = VirtualClock()
    with TryingArm(
        clock, seed=seed, accuracy_mm=accuracy_mm, placed=placed, length_mm=length_mm
    ) as trying:
        arm = MicroScribe(Link(trying.url, clock, who="arm"), clock)
        try:
            arm.sign_on()
            arm.confirm_homed()
            yield arm, trying
        finally:
            arm.close()
