"""Real and virtual time: the only place that reads the time of day for work, or sleeps.

Virtual time moves only when a thread waits, so two runs see the same times to the last bit. Actions
of ``call_at`` run in the thread that moves the time.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import math
import os
import queue
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from types import CodeType
from typing import ParamSpec, Protocol, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class Clock(Protocol):
    """Seconds since the clock was made, a way to wait, and a way to plan something for later."""

    def now(self) -> float:
        """Seconds since the clock was made; never goes back."""

    def sleep(self, seconds: float) -> None:
        """Wait; with virtual time, run all that is planned for that while."""

    def call_at(self, when_s: float, action: Callable[[], None]) -> None:
        """Run ``action`` once the clock shows ``when_s``, or at once when that has passed."""


def sleep_looking(clock: Clock, seconds: float, look: Callable[[], None], each_s: float) -> None:
    """Wait, with a ``look``, which may raise, at the beginning and after every ``each_s``."""
    end_s = clock.now() + seconds
    look()
    while (left_s := end_s - clock.now()) > 0.0:
        clock.sleep(min(each_s, left_s))
        look()


def wall_time() -> datetime:
    """The time of day in UTC, for the record only: nothing may depend on it."""
    return datetime.now(UTC)


def stopwatch_s() -> float:
    """Real seconds from an arbitrary start; `time.monotonic` has steps of 16 ms on Windows before
    Python 3.13.
    """
    return time.perf_counter()


def processor_s() -> float:
    """Seconds of processors that this process has used so far, all its threads together."""
    return time.process_time()


def load_per_processor() -> float | None:
    """Processes that want a processor over a minute, for each; None where no system says it."""
    try:
        return os.getloadavg()[0] / (os.cpu_count() or 1)
    except (AttributeError, OSError):  # Windows; no /proc
        return None


UNBROKEN: set[CodeType] = set()


def unbroken(work: Callable[P, T]) -> Callable[P, T]:
    """A request to end the program, such as Ctrl-C, waits until ``work`` is done."""
    UNBROKEN.add(work.__code__)
    return work


class HostPort(Protocol):
    """The host's end of a link."""

    def read_some(self, timeout_s: float) -> bytes:
        """What has come, after ``timeout_s`` at most; empty for nothing. Raises OSError."""

    def write(self, data: bytes) -> None:
        """Send all of ``data``. Raises OSError."""

    def set_baud(self, baud: int) -> None:
        """Change the rate. Raises OSError, ValueError."""

    def close(self) -> None:
        """May be repeated."""


class RealClock:
    """Time from ``start_s`` on. Planned actions run on a thread, which ``close`` ends."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._start = stopwatch_s() - start_s
        self._planned: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._lock = threading.Lock()
        self._wake: queue.SimpleQueue[bool] = queue.SimpleQueue()  # False ends the thread
        self._worker: threading.Thread | None = None
        self._looked: Callable[[float], None] | None = None

    def now(self) -> float:
        if self._looked:
            self._looked(0.0)
        return stopwatch_s() - self._start

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            if self._looked:
                self._looked(seconds)
            time.sleep(seconds)

    def subscribe(self, looked: Callable[[float], None] | None) -> None:
        """Call ``looked`` with the coming sleep on every thread that sleeps: a heartbeat."""
        self._looked = looked

    def call_at(self, when_s: float, action: Callable[[], None]) -> None:
        with self._lock:
            heapq.heappush(self._planned, (when_s, next(self._order), action))
            if self._worker is None:
                self._worker = threading.Thread(target=self._work, name="clock", daemon=True)
                self._worker.start()
        self._wake.put(True)

    def close(self) -> None:
        """Drop what is still planned and end the thread."""
        with self._lock:
            self._planned.clear()
        self._wake.put(False)
        if self._worker is not None and self._worker is not threading.current_thread():
            self._worker.join()

    def _work(self) -> None:
        while True:
            with self._lock:
                wait_s = self._planned[0][0] - self.now() if self._planned else None
                due = wait_s is not None and wait_s <= 0
                action = heapq.heappop(self._planned)[2] if due else None
            if action:
                action()
            with contextlib.suppress(queue.Empty):
                if not self._wake.get(timeout=0 if action else wait_s):
                    return


class VirtualClock:
    """Time from ``start_s`` on that moves only when a thread waits; no two may wait at once."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now = start_s
        self._planned: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._lock = threading.Lock()
        # by TCP port: what links a host of this process to the emulator there
        self.emulators: dict[int, Callable[[], HostPort]] = {}

    def now(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        end = self._now + max(0.0, seconds)
        if end == math.inf:  # as `time.sleep`
            raise OverflowError("it can't sleep for ever")
        while self.step(end):
            pass

    def call_at(self, when_s: float, action: Callable[[], None]) -> None:
        with self._lock:
            heapq.heappush(self._planned, (when_s, next(self._order), action))

    def step(self, limit_s: float) -> bool:
        """Run the next planned action, or move to ``limit_s`` (False)."""
        with self._lock:
            due = bool(self._planned) and self._planned[0][0] <= limit_s
            when, _, action = heapq.heappop(self._planned) if due else (limit_s, 0, None)
        self._now = max(self._now, when)
        if action is None:
            return False
        action()
        return True


class PacedClock(VirtualClock):
    """Virtual time from ``start_s`` on that a person can watch: it passes ``speed`` times as fast
    as the world's, and stands still while something is computed for longer.
    """

    def __init__(self, speed: float, start_s: float = 0.0) -> None:
        super().__init__(start_s)
        self.speed = speed
        self._moved = stopwatch_s()

    def step(self, limit_s: float) -> bool:
        with self._lock:
            until_s = min([limit_s, *(planned[0] for planned in self._planned[:1])])
        due = self._moved + (until_s - self._now) / self.speed
        time.sleep(max(0.0, due - stopwatch_s()))
        self._moved = stopwatch_s()
        return super().step(limit_s)
