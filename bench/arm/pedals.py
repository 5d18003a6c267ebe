"""A pedal press as an answer at the terminal: watched in short turns, so that the keyboard is heard too, and none is lost between two.

It may not know what the press answers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from instruments.clock import Clock
from instruments.microscribe.pedals import Debouncer
from instruments.microscribe.protocol import Packet

INTERVAL_S = 0.005


class PolledArm(Protocol):
    """What is asked of the driver."""

    def poll(self) -> Packet: ...


def pedal_watch(arm: PolledArm, clock: Clock) -> Callable[[float], bool]:
    """For one prompt: what watches the pedals for some seconds, and says whether one was pressed since the first time it was asked.

    A foot that is down at first has to come up before its press counts. What is given back raises as polling does.
    """
    debouncer = Debouncer()

    def pressed(seconds: float) -> bool:
        end_s = clock.now() + seconds
        while True:
            if any(event.pressed for event in debouncer.feed(clock.now(), arm.poll().buttons)):
                return True
            if clock.now() >= end_s:
                return False
            clock.sleep(INTERVAL_S)

    return pressed
