"""An emulated arm in virtual time, whose hand follows the dialogue."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from io import StringIO

from bench.calibrate.arm import ArmSession
from bench.calibrate.simulated_arm import PLACED, SimulatedArm, TouchStep
from detector.geometry import Motion
from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.microscribe.driver import MicroScribe
from instruments.operators.console import Console

MADE = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


class Follower(ArmSession):
    """With a person who does each step, or ``instead`` another one, and remembers it."""

    def __init__(
        self,
        arm: MicroScribe,
        hand: SimulatedArm,
        instead: Callable[[TouchStep], TouchStep] = lambda step: step,
    ) -> None:
        console = Console(StringIO(), StringIO(), hand.clock)
        super().__init__(arm, hand.clock, console, hand)
        self.hand, self.instead = hand, instead
        self.said: list[str] = []
        self.steps: list[TouchStep] = []

    def ask(self, text: str) -> None:
        self.said.append(text)

    def say(self, text: str) -> None:
        self.said.append(text)

    def touch(self, step: TouchStep) -> None:
        self.steps.append(step)
        self.hand.go(self.instead(step))


@contextmanager
def emulated(
    seed: int = 0, accuracy_mm: float = 0.23, placed: Motion = PLACED, length_mm: float = 300.0
) -> Iterator[tuple[MicroScribe, SimulatedArm]]:
    """A signed-on, homed emulated arm under virtual time, and what brings its tip to places."""
    clock = VirtualClock()
    with SimulatedArm(
        clock, seed=seed, accuracy_mm=accuracy_mm, placed=placed, length_mm=length_mm
    ) as simulated:
        arm = MicroScribe(Link(simulated.url, clock, who="arm"), clock)
        try:
            arm.sign_on()
            arm.confirm_homed()
            yield arm, simulated
        finally:
            arm.close()
