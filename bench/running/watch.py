"""Reads the bath once a second through everything the bench does: feeds the stability gate, the interlocks and the record.

It is planned on the clock, so with virtual time it runs as time moves and with real time on the clock's own thread, which no
prompt stops. A trip acts there and at once: ``act`` makes safe, and is called again every few seconds until it has; the
engine learns of it with ``check``. Nothing is raised on the clock's thread.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from typing import Protocol

from bench.running.stability import StabilityGate, State
from bench.safety.interlocks import Interlocks, InterlockTrip
from bench.store import Row
from instruments.bath.reading import BathReading
from instruments.clock import Clock
from instruments.errors import InstrumentError, LinkError

PERIOD_S = 1.0
AGAIN_S = 5.0  # between attempts to make safe


class ReadableBath(Protocol):
    def read(self) -> BathReading: ...


class Watch:
    """Watches ``bath`` from ``start`` to ``stop``.

    ``record`` gets each reading as a row. ``act`` gets the first trip, makes safe, and says whether it has. ``pump_on`` tells
    whether the pump turns, None where nothing knows. ``also`` is asked with each reading what else there is to trip for;
    ``moving`` tells what of a reading has to change for the gate to believe that the controller lives.
    """

    def __init__(
        self,
        bath: ReadableBath,
        clock: Clock,
        gate: StabilityGate,
        interlocks: Interlocks,
        record: Callable[[Row], None],
        act: Callable[[Exception], bool],
        *,
        pump_on: Callable[[BathReading], bool | None] = lambda _: None,
        also: Callable[[], InterlockTrip | None] = lambda: None,
        moving: Callable[[BathReading], Hashable] = lambda reading: reading.raw,
    ) -> None:
        self._bath = bath
        self._clock = clock
        self._gate = gate
        self._interlocks = interlocks
        self._record = record
        self._act = act
        self._pump_on = pump_on
        self._also = also
        self._moving = moving
        self._lock = threading.RLock()
        self._running = False
        self._trip: Exception | None = None
        self._safe = False
        self._act_again_s = clock.now()
        self._heard_s = self._planned_s = clock.now()
        self._heating_s: float | None = None
        self.last: BathReading | None = None

    @property
    def state(self) -> State:
        """Of the stability gate, after the last reading."""
        return self._gate.state

    @property
    def why_not_stable(self) -> str:
        """What the gate still waits for."""
        return "; ".join(self._gate.report.reasons)

    def stable_in_s(self, expected_s: float) -> float:
        """How long until the gate opens, expected ``expected_s`` after heating began; once that is over, what it needs at the least."""
        if self.state is State.STABLE:
            return 0.0
        heated_s = 0.0 if self._heating_s is None else self._clock.now() - self._heating_s
        return max(expected_s - heated_s, self._gate.at_least_s)

    @property
    def tripped(self) -> Exception | None:
        """What ``check`` would raise."""
        return self._trip

    def start(self) -> None:
        """Read now and then every second."""
        self._running = True
        self._heard_s = self._planned_s = self._clock.now()
        self._tick()

    def heating(self) -> None:
        """The bath has been started: what was read before is no evidence of stability."""
        with self._lock:
            self._gate.restart()
            self._heating_s = self._clock.now()
            self._interlocks.heating(self._gate.set_point_c)

    def end(self) -> None:
        """No further readings: the bath is about to be stopped. Doesn't wait for one that is under way; ``stop`` does."""
        self._running = False

    def stop(self) -> None:
        """No further readings; returns once none is under way."""
        self.end()
        with self._lock:
            pass

    def check(self) -> None:
        """Raise what has tripped since: InterlockTrip, or a mistake of the bench's own."""
        if self._trip is not None:
            raise self._trip

    def trip(self, trip: Exception) -> None:
        """Go to safe for a reason that is in no reading. The first trip stays."""
        with self._lock:
            self._trip = self._trip or trip
            self._make_safe()

    def _tick(self) -> None:
        with self._lock:
            if not self._running:
                return
            self._heard_s += self._clock.now() - self._planned_s  # while this process did not run, the bath was not silent
            try:
                self._trip = self._trip or self._also()
                self._look()
            except Exception as error:
                self._trip = self._trip or error
            self._make_safe()
        self._planned_s = max(self._planned_s + PERIOD_S, self._clock.now())  # from start to start, however long a reading takes
        self._clock.call_at(self._planned_s, self._tick)

    def _look(self) -> None:
        try:
            reading = self._bath.read()
            pump_on = self._pump_on(reading)
        except InstrumentError as error:
            silent_s = self._clock.now() - self._heard_s
            trip = self._interlocks.silent(silent_s, error, answered=not isinstance(error, LinkError))
        else:
            if not self._running:
                return  # the run has ended while we waited for it, and with it the heating
            trip = self._take(reading, pump_on)
        self._trip = self._trip or trip

    def _take(self, reading: BathReading, pump_on: bool | None) -> InterlockTrip | None:
        self._heard_s = reading.t_s
        self.last = reading
        raw, teat_c = self._moving(reading), reading.external_c
        state = self._gate.add(reading.t_s, reading.temp_c, raw=raw, alarm=bool(reading.alarm), teat_c=teat_c)
        self._record(
            {
                "t_s": reading.t_s,
                "temp_c": reading.temp_c,
                "external_c": reading.external_c,
                "power_percent": reading.power_percent,
                "state": state.value,
            }
        )
        return self._interlocks.add(reading, pump_on)

    def _make_safe(self) -> None:
        if self._trip is None or self._safe or self._clock.now() < self._act_again_s:
            return
        self._act_again_s = self._clock.now() + AGAIN_S
        try:
            self._safe = self._act(self._trip)
        except Exception as error:
            self._trip = error
