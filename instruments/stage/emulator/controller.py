"""What all emulated firmwares share: a line in, a generator that waits for the carriage, homing,
and the count's place in machine coordinates.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace

from instruments.clock import Clock
from instruments.stage.emulator.carriage import Carriage, Switch
from instruments.stage.emulator.motion import SOON_S, Vector
from instruments.stage.emulator.store import Store

Work = Generator[float, None, str | None]
SEARCH = 1.5  # times the axis's travel, before a switch counts as missing
LOCATE = 5.0  # times the pull-off
LINE_BYTES = 95  # what follows in a line is dropped, as Marlin does


class Controller(ABC):
    """One board's firmware. ``answer`` gets the answer of each line; ``out`` is what is pushed."""

    def __init__(
        self, clock: Clock, settings: Store, carriage: Carriage, answer: Callable[[str], None]
    ) -> None:
        self._clock = clock
        self.settings = settings
        self.dialect = settings.dialect
        self.carriage = carriage
        self._answer = answer
        self.out = bytearray()
        self.broken_switches: dict[int, Switch] = {}
        self.probe_closed = False
        self.power_up()
        self.out.clear()

    def power_up(self) -> None:
        """Power comes, or an opened port resets the board: the count is 0 where the carriage is."""
        self.carriage.count_from((0.0,) * self.settings.axes, self.now)
        self._half = b""
        self.drop()
        # machine coordinates less the motion's: right by axis once it is homed
        self.offset_mm = [0.0] * self.settings.axes
        self.homed: set[int] = set()

    def drop(self) -> None:
        """Drop the line under way and those that wait."""
        self._lines: deque[str] = deque()
        self._work: Work | None = None
        self._due_s = math.inf  # when the line under way goes on

    @property
    def now(self) -> float:
        return self._clock.now()

    @property
    def moving(self) -> bool:
        return self.carriage.moving(self.now)

    @property
    def next_s(self) -> float:
        """When something happens by itself next."""
        return self._due_s

    def check_limit_switches(self) -> None:  # noqa: B027 - Marlin and Zaber look while homing only
        """Notice a limit switch that the carriage has run into."""

    def say(self, text: str) -> None:
        self.out += text.encode("ascii", "replace") + b"\r\n"

    def take(self, data: bytes) -> None:
        """Bytes from the host, cut anywhere."""
        *lines, self._half = (self._half + data).split(b"\n")
        for line in lines:
            text = line[:LINE_BYTES].decode("ascii", "replace").strip()
            self.seen(text)
            self._lines.append(text)
        self.pump()

    def seen(self, text: str) -> None:  # noqa: B027 - most firmwares read their lines in order
        """A whole line has come; those before it may not be done yet."""

    def pump(self) -> None:
        """Take lines until one has to wait, or there are none."""
        self._due_s = math.inf
        while not self.ignores_input:
            if self._work is None:
                line = self.next_line()
                if line is None:
                    return
                self._work = self.work(line)
            try:
                self._due_s = next(self._work)
                return
            except StopIteration as end:
                self._work = None
                if end.value:
                    self._answer(end.value)

    @property
    def ignores_input(self) -> bool:
        """Whether lines have to wait, the one under way too."""
        return False

    def next_line(self) -> str | None:
        return self._lines.popleft() if self._lines else None

    @abstractmethod
    def work(self, text: str) -> Work:
        """Execute a line. Yields when it goes on; returns its answer, None where it was sent."""

    @abstractmethod
    def alarm(self, code: int, *, critical: bool = False) -> None:
        """A limit switch was hit, or homing failed: stop dead and say so."""

    # The count in machine coordinates

    def place_mm(self) -> Vector:
        return self._machine(self.carriage.motion.position(self.now))

    def target_mm(self) -> Vector:
        return self._machine(self.carriage.motion.target)

    def _machine(self, count_mm: Vector) -> Vector:
        return tuple([at + off for at, off in zip(count_mm, self.offset_mm, strict=True)])

    def go(self, target_mm: Sequence[float], feed_mm_s: float | None) -> None:
        """Plan a straight move to machine coordinates; no feed is a rapid move."""
        count = [at - off for at, off in zip(target_mm, self.offset_mm, strict=True)]
        there = self.settings.whole_steps(count, self.carriage.motion.target)
        self.carriage.go(there, feed_mm_s, self.settings.rates, self.now)

    def plan(self, target_mm: Sequence[float], feed_mm_s: float | None) -> Iterator[float]:
        """As `go`, once the planner has a free place."""
        while len(self.carriage.motion.left(self.now)) >= self.dialect.planner_blocks:
            yield self.carriage.motion.next_end_s(self.now)
        self.go(target_mm, feed_mm_s)

    def until_still(self) -> Iterator[float]:
        while self.carriage.motion.moving(self.now):
            yield self.carriage.motion.next_end_s(self.now)

    def run_home(self, axes: Sequence[int]) -> Iterator[float]:
        """Home ``axes`` one after the other; ends in an alarm where a switch is broken, and without
        one where the steps were cut.
        """
        axes = [axis for one in self.settings.passes for axis in one if axis in axes]
        self.homed -= set(axes)
        self.carriage.start_homing(self.now)
        broken = dict(self.broken_switches)
        if self.settings.limits_inverted:
            broken = dict.fromkeys(axes, Switch.STUCK)
        for axis in axes:
            if alarm := (yield from self._find_switch(axis, broken.get(axis))):
                self.alarm(alarm)
        if not self.carriage.homing:
            return
        home_mm = self.settings.home_mm(axes, self.carriage.motion.target)
        self.carriage.count_from(home_mm, self.now)
        for axis in axes:
            self.offset_mm[axis] = self.settings.origin_mm[axis]
        self.homed |= set(axes)

    def _find_switch(self, axis: int, broken: Switch | None) -> Generator[float, None, int | None]:
        """Seek it fast, back off, find it again slowly and back off; the alarm that ends it."""
        store = self.settings
        towards = -1.0 if axis in store.at_far_end else 1.0
        pull_off, seek, creep = store[27], store[25], store[24]
        gap = self.carriage.to_end_mm(axis, towards, self.now)
        for reach, rate in ((SEARCH * store.travel_mm[axis], seek), (LOCATE * pull_off, creep)):
            missing = broken is Switch.MISSING or gap > reach
            yield from self._home_way(axis, towards * (reach if missing else gap), rate)
            if not self.carriage.homing:
                return None
            if missing:
                return 9
            if broken is Switch.CROOKED:
                return self.dialect.crooked_alarm
            yield from self._home_way(axis, -towards * pull_off, seek)
            if self.carriage.homing and (broken is Switch.STUCK or not pull_off):
                return 8
            gap = pull_off
        return None

    def _home_way(self, axis: int, way_mm: float, mm_min: float) -> Iterator[float]:
        if not self.carriage.homing:
            return
        count = list(self.carriage.motion.target)
        count[axis] += way_mm
        rates = replace(self.settings.rates, speed_mm_s=(mm_min / 60,) * self.settings.axes)
        self.carriage.go(tuple(count), None, rates, self.now)
        yield from self.until_still()
        end_s = self.now + self.settings[26] / 1000
        while self.carriage.homing and self.now < end_s - SOON_S:
            yield end_s
