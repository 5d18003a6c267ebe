"""The homing cycle as a function of time from 0: pass by pass, the axes of a pass together.

Each axis seeks its switch fast, backs off, finds it again slowly and backs off, with a pause
between runs. A run to a switch stops dead, as the steps are cut when it closes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from instruments.stage.emulator.motion import Phase, Vector, lay, profile

SEARCH = 1.5  # times the longest travel of the pass, before a switch counts as missing
LOCATE = 5.0  # times the pull-off


class Switch(Enum):
    """How a homing switch is broken."""

    MISSING = "never closes"
    STUCK = "never opens again"
    CROOKED = "of the axis's two motors, one finds its switch too late"


@dataclass(frozen=True, slots=True)
class HomingRates:
    """Settings in mm, mm/s, mm/s², s. ``passes``: axes of each pass; ``at_far_end``: axes with the
    switch at minus the travel; ``crooked_alarm``: for two motors out of square.
    """

    travel_mm: Vector
    seek_mm_s: float
    feed_mm_s: float
    accel_mm_s2: Vector
    pull_off_mm: float
    debounce_s: float
    passes: tuple[tuple[int, ...], ...] = ((2,), (0, 1))
    at_far_end: frozenset[int] = frozenset()
    crooked_alarm: int = 10

    def switch_mm(self, axis: int) -> float:
        """Where the axis's switch is."""
        return -self.travel_mm[axis] if axis in self.at_far_end else 0.0

    def home_mm(self, before_mm: Vector) -> Vector:
        """Where the stage is said to stand after homing; an axis without a pass keeps its count."""
        homed = {axis for axes in self.passes for axis in axes}
        return tuple(
            self._home_of(axis) if axis in homed else count for axis, count in enumerate(before_mm)
        )

    def _home_of(self, axis: int) -> float:
        return (
            -self.travel_mm[axis] + self.pull_off_mm
            if axis in self.at_far_end
            else -self.pull_off_mm
        )


@dataclass
class HomingRun:
    """Tracks by axis over time from 0, how long it takes, and the alarm that ends it, if any."""

    start_mm: Vector
    tracks: tuple[list[Phase], ...] = field(init=False)
    end_s: float = 0.0
    alarm: int | None = None

    def __post_init__(self) -> None:
        self.tracks = tuple([] for _ in self.start_mm)

    def position(self, now_s: float) -> Vector:
        """Where the carriage is, mm."""
        return tuple(self._axis(axis, now_s) for axis in range(len(self.start_mm)))

    def _axis(self, axis: int, now_s: float) -> float:
        place = self.start_mm[axis]
        for phase in self.tracks[axis]:
            if now_s < phase.start_s:
                break
            place = phase.place_mm(now_s)
        return place

    def run(
        self, axis: int, way_mm: float, speed: float, accel: float, *, dead_stop: bool
    ) -> float:
        """Append one axis's run of ``way_mm`` (with its sign) from ``end_s`` on; its seconds."""
        place = self._axis(axis, self.end_s)
        sign = 1.0 if way_mm >= 0 else -1.0
        leave = min(speed, math.sqrt(2 * accel * abs(way_mm))) if dead_stop else 0.0
        steps = profile(abs(way_mm), 0.0, speed, leave, accel)
        phases = lay([(seconds, sign * v, sign * a) for seconds, v, a in steps], self.end_s, place)
        self.tracks[axis].extend(phases)
        return sum(seconds for seconds, _, _ in steps)


def homing(start_mm: Vector, rates: HomingRates, broken: Mapping[int, Switch]) -> HomingRun:
    """The whole cycle from the carriage's place. ``broken``: axes with a broken switch."""
    run = HomingRun(start_mm)
    for axes in rates.passes:
        _cycle(run, axes, rates, broken)
        if run.alarm:
            break
    return run


def _cycle(
    run: HomingRun, axes: tuple[int, ...], rates: HomingRates, broken: Mapping[int, Switch]
) -> None:
    search = SEARCH * max(rates.travel_mm[axis] for axis in axes)
    for approach, reach, speed in (
        (True, search, rates.seek_mm_s),
        (False, rates.pull_off_mm, rates.seek_mm_s),
        (True, LOCATE * rates.pull_off_mm, rates.feed_mm_s),
        (False, rates.pull_off_mm, rates.seek_mm_s),
    ):
        run.end_s += _together(run, axes, rates, broken, approach, reach, speed)
        if run.alarm:
            return
        run.end_s += rates.debounce_s


def _together(
    run: HomingRun,
    axes: tuple[int, ...],
    rates: HomingRates,
    broken: Mapping[int, Switch],
    approach: bool,
    reach: float,
    speed: float,
) -> float:
    """One run of all axes of a cycle; the seconds until the last has ended."""
    longest = 0.0
    for axis in axes:
        towards = -1.0 if axis in rates.at_far_end else 1.0
        gap = towards * (rates.switch_mm(axis) - run.position(run.end_s)[axis])
        fault = broken.get(axis)
        if not approach:
            way, dead = -towards * reach, False
            if fault is Switch.STUCK:
                run.alarm = 8
        elif fault is Switch.MISSING or gap > reach:
            # the carriage stops at the end of its rails, the motor goes on
            way, dead = towards * max(0.0, min(gap, reach)), True
            run.alarm = 9
            longest = max(longest, reach / speed)
        else:
            way, dead = towards * max(0.0, gap), True
            if fault is Switch.CROOKED:
                run.alarm = rates.crooked_alarm
        longest = max(longest, run.run(axis, way, speed, rates.accel_mm_s2[axis], dead_stop=dead))
    return longest
