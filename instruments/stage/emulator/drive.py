"""From the counted position to the carriage's place, axis by axis: lost steps, a stall, play in the screws, the rails' ends.

The motor turns as the steps do, less those that it has lost. The carriage follows within the play: nothing moves
after a reversal until the play is taken up. At the rails' ends the carriage stands, and the motor loses the steps that
push further. Fed with the ends of straight lines, in order, this is exact. It may not know time, plans or the protocol.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

from instruments.stage.emulator.phases import Vector

PRESSED_MM = 0.005  # how far past its edge a limit switch is closed


@dataclass
class AxisDrive:
    """One axis. ``low``, ``high``: the rails' ends, mm; ``play``: how far the motor turns after a reversal before the carriage
    moves; ``at_far_end``: its switch is at ``low``, and homing leaves it by moving up. ``count`` is what the controller counts.
    """

    place: float
    low: float
    high: float
    play: float = 0.0
    at_far_end: bool = False
    count: float = 0.0
    motor: float = 0.0
    to_lose: float = 0.0
    stalled: bool = False
    pressed: bool = False

    def __post_init__(self) -> None:
        self.motor = self.place

    def follow(self, count: float) -> None:
        """The count goes straight to ``count``."""
        way = count - self.count
        self.count = count
        if self.stalled:
            return
        lost = min(abs(way), self.to_lose)
        self.to_lose -= lost
        self.motor += way - lost if way > 0 else way + lost
        below, above = (0.0, self.play) if self.at_far_end else (self.play, 0.0)
        self._carry(min(max(self.place, self.motor - below), self.motor + above))

    def _carry(self, wanted: float) -> None:
        """Bring the carriage to ``wanted``, or to the rail's end; what is missing, the motor has lost."""
        self.place = min(max(wanted, self.low), self.high)
        over = wanted - self.place
        if over:
            self.motor -= over
            self.pressed = self.pressed or (over < -PRESSED_MM if self.at_far_end else over > PRESSED_MM)

    def recount(self, count: float) -> None:
        """Nothing moves; from now on the controller counts from here."""
        self.count = count
        self.to_lose, self.stalled = 0.0, False

    def settle(self, place: float, count: float) -> None:
        """The carriage stands at ``place`` with the play taken up, and this counts as ``count``."""
        self.place = self.motor = place
        self.pressed = False
        self.recount(count)

    def knock(self, way: float) -> None:
        """The carriage, and the motor with it, is pushed by ``way`` while the count stays."""
        self.motor += way
        self._carry(self.place + way)

    def past_switch(self, count: float) -> bool:
        """Whether going straight to ``count`` would close the limit switch."""
        trial = copy.copy(self)
        trial.pressed = False
        trial.follow(count)
        return trial.pressed


class Drive:
    """All axes, as a carriage at ``place_mm`` on rails of ``travel_mm``; ``play_mm`` and ``at_far_end`` by axis."""

    def __init__(self, place_mm: Vector, travel_mm: Vector, play_mm: Vector, at_far_end: frozenset[int]) -> None:
        self.axes = [
            AxisDrive(place, low=-travel, high=0.0, play=play, at_far_end=axis in at_far_end)
            for axis, (place, travel, play) in enumerate(zip(place_mm, travel_mm, play_mm, strict=True))
        ]

    @property
    def place_mm(self) -> Vector:
        """Where the carriage is."""
        return tuple([axis.place for axis in self.axes])

    @property
    def pressed(self) -> bool:
        """Whether a limit switch has closed since this was last forgotten."""
        return any(axis.pressed for axis in self.axes)

    def follow(self, count_mm: Vector) -> None:
        """The count goes straight to ``count_mm``."""
        for axis, count in zip(self.axes, count_mm, strict=True):
            axis.follow(count)

    def settle(self, place_mm: Vector, count_mm: Vector) -> None:
        """The carriage stands at ``place_mm``, which counts as ``count_mm``."""
        for axis, place, count in zip(self.axes, place_mm, count_mm, strict=True):
            axis.settle(place, count)

    def recount(self, count_mm: Vector) -> None:
        """Nothing moves; from now on the controller counts from here."""
        for axis, count in zip(self.axes, count_mm, strict=True):
            axis.recount(count)

    def stall(self, on: bool) -> None:
        """The motors stand while the count goes on, or hold again."""
        for axis in self.axes:
            axis.stalled = on

    def forget_pressed(self) -> None:
        """The switches have been heard."""
        for axis in self.axes:
            axis.pressed = False

    def closes_switch(self, count_mm: Vector) -> bool:
        """Whether going straight to ``count_mm`` closes a limit switch on the way."""
        return any(axis.past_switch(count) for axis, count in zip(self.axes, count_mm, strict=True))

    def lose(self, axis: int, amount_mm: float) -> None:
        """From now on ``axis`` loses all steps, until it has lost this much."""
        self.axes[axis].to_lose += amount_mm

    def copy(self) -> Drive:
        """Another one in the same state, to look ahead with."""
        twin = copy.copy(self)
        twin.axes = [copy.copy(axis) for axis in self.axes]
        return twin
