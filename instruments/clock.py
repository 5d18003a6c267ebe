"""Real and virtual time: the only place that reads the time of day for work, or sleeps.

Virtual time moves only when a thread waits, so two runs see the same times to the last bit. Actions
of ``call_at`` run in the thread that moves the time.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import os
import queue
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Protocol


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
    """Real seconds from an arbitrary start, to measure software, never to wait."""
    return time.perf_counter()


def processor_s() -> float:
    """Seconds of processors that this process has used so far, all its threads together."""
    return time.process_time()


def load_per_processor() -> float | None:
    """Processes that want a processor over a minute, for each; None on Windows."""
    return os.getloadavg()[0] / (os.cpu_count() or 1) if hasattr(os, "getloadavg") else None


HUNG_S = 10.0  # real time that an emulator's thread gets to take bytes before it is called hung


class RealClock:
    """Time from ``start_s`` on. Planned actions run on a thread, which ``close`` ends."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._start = time.monotonic() - start_s
        self._planned: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._lock = threading.Lock()
        self._wake: queue.SimpleQueue[bool] = queue.SimpleQueue()  # False ends the thread
        self._worker: threading.Thread | None = None
        self._looked: Callable[[float], None] | None = None

    def now(self) -> float:
        if self._looked:
            self._looked(0.0)
        return time.monotonic() - self._start

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            if self._looked:
                self._looked(seconds)
            time.sleep(seconds)

    def subscribe(self, looked: Callable[[float], None] | None) -> None:
        """Call ``looked`` with the coming sleep on every thread that uses the clock: a
        heartbeat.
        """
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
    """Time that moves only when a thread waits. Not to be shared by two threads that both wait."""

    def __init__(self) -> None:
        self._now = 0.0
        self._planned: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._lock = threading.Lock()
        self._wires: dict[int, Wire] = {}

    def now(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        end = self._now + max(0.0, seconds)
        while self.step(end):
            pass

    def call_at(self, when_s: float, action: Callable[[], None]) -> None:
        with self._lock:
            heapq.heappush(self._planned, (when_s, next(self._order), action))

    def step(self, limit_s: float) -> bool:
        """Run the next planned action, or move to ``limit_s`` (False), once all bytes are taken."""
        for wire in list(self._wires.values()):
            wire.wait_taken(HUNG_S)
        with self._lock:
            due = bool(self._planned) and self._planned[0][0] <= limit_s
            when, _, action = heapq.heappop(self._planned) if due else (limit_s, 0, None)
        self._now = max(self._now, when)
        if action is None:
            return False
        action()
        return True

    def wire(self, port: int) -> Wire:
        """The bytes in flight on the loopback connection whose near end is TCP port ``port``."""
        with self._lock:
            return self._wires.setdefault(port, Wire())

    def forget_wire(self, port: int) -> None:
        """Drop an account; the system may give its port number to another connection later."""
        with self._lock:
            self._wires.pop(port, None)


class PacedClock(VirtualClock):
    """Virtual time from ``start_s`` on that a person can watch: it passes ``speed`` times as fast
    as the world's, and stands still while something is computed for longer or on its way.
    """

    def __init__(self, speed: float, start_s: float = 0.0) -> None:
        super().__init__()
        self.speed = speed
        self._now = start_s
        self._moved = time.monotonic()

    def step(self, limit_s: float) -> bool:
        with self._lock:
            until_s = min([limit_s, *(planned[0] for planned in self._planned[:1])])
        due = self._moved + (until_s - self._now) / self.speed
        time.sleep(max(0.0, due - time.monotonic()))
        self._moved = time.monotonic()
        return super().step(limit_s)


class Wire:
    """Counts the bytes between a link and an emulator: time stands still while any is in flight,
    and so doesn't depend on load. Ctrl-C may come anywhere: only the interpreter's own locks are
    used, which `with` always releases.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiter: threading.Lock | None = None
        self._accepted = False
        self._closed = False
        self._to_device = 0
        self._to_host = 0
        self.sending = False  # bytes were counted that may not be on their way yet

    def accepted(self) -> None:
        """The emulator has the connection and has said what it says unasked."""
        with self._lock:
            self._accepted = True
            self._notify()

    def closed(self) -> None:
        """The emulator has hung up; nothing more will come."""
        with self._lock:
            self._closed = True
            self._notify()

    def add(self, *, to_device: int = 0, to_host: int = 0) -> None:
        """Bytes sent (positive) or taken (negative) in either direction."""
        with self._lock:
            self._to_device += to_device
            self._to_host += to_host
            self._notify()

    def send(self, count: int, write: Callable[[], None]) -> None:
        """The emulator's ``write`` of ``count`` bytes, counted first, so the host waits for it."""
        try:
            self.sending = True
            self.add(to_host=count)
            write()
        finally:
            self.sending = False

    def settle(self, timeout_s: float) -> bool:
        """Wait for bytes for the host (True) or nothing in flight (False). Raises TimeoutError."""
        self._wait_for(self._settled, timeout_s)
        return self._to_host > 0 or self._closed

    def wait_taken(self, timeout_s: float) -> None:
        """Wait until the emulator took all bytes. Raises TimeoutError as ``settle``."""
        self._wait_for(lambda: self._closed or self._to_device <= 0, timeout_s)

    def before_write(self) -> None:
        """Forget bytes that were taken and never counted: an interrupt came between the two."""
        if self._to_device < 0:
            with self._lock:
                self._to_device = max(0, self._to_device)

    def nothing_came(self) -> None:
        """Reset the count: an interrupt came between reading and counting."""
        with self._lock:
            self._to_host = 0

    def _wait_for(self, done: Callable[[], bool], timeout_s: float) -> None:
        if done():  # most often: each count is read whole, and `_to_host` last
            return
        deadline = time.monotonic() + timeout_s
        while True:
            with self._lock:
                if done():
                    return
                waiter = self._waiter = threading.Lock()
                waiter.acquire()
            if not waiter.acquire(timeout=max(0.0, deadline - time.monotonic())):
                raise TimeoutError(f"{self._to_device} bytes stayed untaken for {timeout_s} s")

    def _notify(self) -> None:
        if self._waiter is not None:
            waiter, self._waiter = self._waiter, None
            waiter.release()

    def _settled(self) -> bool:
        return self._to_host > 0 or self._closed or (self._accepted and self._to_device <= 0)
