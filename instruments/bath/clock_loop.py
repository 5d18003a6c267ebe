"""An asyncio event loop whose time is the project's clock, for one connection and no thread.

With virtual time it waits for bytes in flight and for nothing else: where it would have to wait it stops, and time moves on
outside of it, so that an event of that time may use the loop too. It may not know what the bytes are.
"""

from __future__ import annotations

import asyncio
import os
import selectors

from instruments.clock import Clock, VirtualClock, Wire

PATIENCE_S = 10.0  # real time that an emulator's thread gets before we call it hung
FORCED_TO_POLL = os.name == "nt"  # pymodbus looks at serial ports by turns there, so the loop does not know


class ClockLoop(asyncio.SelectorEventLoop):
    """An event loop whose time is the clock's. With virtual time it stops where it would have to wait."""

    def __init__(self, clock: Clock) -> None:
        self._time_source = clock
        self._virtual = clock if isinstance(clock, VirtualClock) else None
        self._patient = _PatientSelector(self) if self._virtual else None
        self._any = self._patient or selectors.DefaultSelector()
        super().__init__(self._any)
        self.set_exception_handler(lambda *_: None)  # what matters reaches the open question

    def time(self) -> float:
        return self._time_source.now()

    def has_input(self) -> bool:
        """Whether anything is there to be read at once."""
        if self._patient:
            return bool(self._patient.look())
        return bool(self._any.select(0)) or FORCED_TO_POLL

    def watch(self, wire: Wire) -> None:
        """From now on, time may pass only while nothing is in flight on ``wire``."""
        if self._patient:
            self._patient.wire = wire
        wire.settle(PATIENCE_S)

    def let_time_pass(self) -> None:
        """Move virtual time on to the loop's next appointment, or to an event before it."""
        if self._virtual and self._patient and self._patient.quiet_s is not None:
            quiet_s, self._patient.quiet_s = self._patient.quiet_s, None
            self._virtual.step(self._virtual.now() + quiet_s)

    def turn(self) -> None:
        """Run what is ready, and what that makes ready."""
        for _ in range(3):
            self.call_soon(self.stop)
            self.run_forever()


class _PatientSelector(selectors.DefaultSelector):
    """Waits for bytes in flight and for nothing else: then it stops the loop and says how long it would have waited."""

    def __init__(self, loop: ClockLoop) -> None:
        super().__init__()
        self._stopped_loop = loop
        self.wire: Wire | None = None
        self.quiet_s: float | None = None

    def look(self) -> list[tuple[selectors.SelectorKey, int]]:
        """What is ready now, without any wait."""
        return super().select(0)

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self.quiet_s = None
        events = super().select(0)
        if events or (timeout is not None and timeout <= 0):
            return events
        if self.wire is None:
            events = super().select(timeout)  # while connecting, or where nobody keeps an account of the bytes
        elif self.wire.settle(PATIENCE_S):
            events = super().select(PATIENCE_S)
        if not events:
            self.quiet_s = timeout
            self._stopped_loop.stop()
        return events
