"""Reads the bath once a second through everything the bench does: feeds the stability gate, the interlocks and the record.

It is planned on the clock, so with virtual time it runs as time moves and with real time on the clock's own
thread. It never raises there: a trip waits until the engine asks with ``check``.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Protocol

from bench.interlocks import COMMUNICATIONS, COMMUNICATIONS_THEN, RATE_SPAN_S, InterlockTrip, first_broken
from bench.rig import Limits
from bench.stability import StabilityGate, State
from bench.store import Row
from instruments.bath.reading import BathReading
from instruments.clock import Clock
from instruments.errors import InstrumentError

PERIOD_S = 1.0


class ReadableBath(Protocol):
    def read(self) -> BathReading: ...


class Watch:
    """Watches ``bath`` from ``start`` to ``stop``; ``record`` gets each reading as a row."""

    def __init__(self, bath: ReadableBath, clock: Clock, gate: StabilityGate, limits: Limits, record: Callable[[Row], None]) -> None:
        self._bath = bath
        self._clock = clock
        self._gate = gate
        self._limits = limits
        self._record = record
        self._recent: deque[BathReading] = deque()
        self._lock = threading.Lock()
        self._running = False
        self._trip: Exception | None = None
        self._heard_s = clock.now()
        self.last: BathReading | None = None

    @property
    def state(self) -> State:
        """Of the stability gate, after the last reading."""
        return self._gate.state

    @property
    def why_not_stable(self) -> str:
        """What the gate still waits for."""
        return "; ".join(self._gate.report.reasons)

    def start(self) -> None:
        """Read now and then every second."""
        self._running = True
        self._heard_s = self._clock.now()
        self._tick()

    def stop(self) -> None:
        """No further readings; returns once none is under way."""
        self._running = False
        with self._lock:
            pass

    def check(self) -> None:
        """Raise what has tripped since: InterlockTrip, or the InstrumentError of a bath that is no longer heard."""
        if self._trip is not None:
            raise self._trip

    def _tick(self) -> None:
        with self._lock:
            if not self._running or self._trip is not None:
                return
            try:
                self._take(self._bath.read())
            except InstrumentError as error:
                self._not_heard(error)
            except Exception as error:
                self._trip = error
        self._clock.call_at(self._clock.now() + PERIOD_S, self._tick)

    def _take(self, reading: BathReading) -> None:
        self._heard_s = reading.t_s
        self.last = reading
        earlier = self._earlier(reading)
        self._trip = first_broken(reading, earlier, self._limits)
        state = self._gate.add(reading.t_s, reading.temp_c, raw=(reading.raw, reading.power_percent), alarm=bool(reading.alarm))
        self._record(
            {
                "t_s": reading.t_s,
                "temp_c": reading.temp_c,
                "external_c": reading.external_c,
                "power_percent": reading.power_percent,
                "state": state.value,
            }
        )

    def _earlier(self, reading: BathReading) -> BathReading | None:
        self._recent.append(reading)
        while len(self._recent) > 1 and reading.t_s - self._recent[1].t_s >= RATE_SPAN_S:
            self._recent.popleft()
        oldest = self._recent[0]
        return oldest if reading.t_s - oldest.t_s >= RATE_SPAN_S else None

    def _not_heard(self, error: InstrumentError) -> None:
        silent_s = self._clock.now() - self._heard_s
        if silent_s >= self._limits.bath_silence_s:
            self._trip = InterlockTrip(COMMUNICATIONS, f"no bath reading for {silent_s:.0f} s ({error})", COMMUNICATIONS_THEN)
