"""A press is an answer whenever it comes: within a turn of watching, between two, or across their
border.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import pytest

from bench.rig.opening import pedal_watch
from instruments.clock import VirtualClock
from instruments.microscribe.driver import MicroScribe


@dataclass
class Foot:
    """A pedal that is down while the clock is in one of ``down_s``."""

    clock: VirtualClock
    down_s: list[tuple[float, float]]

    def buttons(self) -> int:
        return int(any(start <= self.clock.now() < end for start, end in self.down_s))


def answered_after(down_s: list[tuple[float, float]], turn_s: float = 0.2) -> float | None:
    clock = VirtualClock()
    pressed = pedal_watch(cast(MicroScribe, Foot(clock, down_s)), clock)
    while clock.now() < 3.0:
        if pressed(turn_s):
            return clock.now()
    return None


@pytest.mark.parametrize("start_s", [0.1, 0.17, 0.181, 0.195, 0.2, 0.201, 0.21, 0.399])
def test_a_press_counts_wherever_it_falls(start_s: float) -> None:
    after = answered_after([(start_s, start_s + 0.4)])
    assert after == pytest.approx(start_s + 0.02, abs=0.015)


def test_a_bounce_is_no_press_and_a_foot_that_was_there_has_to_come_up() -> None:
    assert answered_after([(0.5, 0.508), (0.7, 0.71)]) is None
    assert answered_after([(0.0, 3.0)]) is None
    after = answered_after([(0.0, 1.0), (1.5, 2.0)])
    assert after == pytest.approx(1.52, abs=0.015)
