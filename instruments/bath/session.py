"""One connection of pymodbus's asyncio client, run from the calling thread and only while a question is open.

No thread, no hand-over, nothing to leak. The event loop's time is the clock's: under virtual time it stops where it
would have to wait, and time moves on outside of it, so an event of that time may ask a question of its own. It may
not know what is asked.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Awaitable
from typing import TypeVar

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusException
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU
from pymodbus.transaction import TransactionManager
from pymodbus.transport import CommParams

from instruments.clock import Clock, VirtualClock, Wire

PATIENCE_S = 10.0  # real time that an emulator's thread gets before we call it hung
REMEMBERED = 300  # bytes kept for messages: more than the longest answer

T = TypeVar("T")


class Session:
    """A client and the loop that it lives in. ``connect`` first; ``close`` last, and at any moment."""

    def __init__(self, host: str, port: int, clock: Clock, *, timeout_s: float, retries: int) -> None:
        self._clock = clock
        self._loop = _ClockLoop(clock)
        self._books: _Books | None = None
        self.client, self._books = self.run(_make_client(host, port, timeout_s, retries))

    @property
    def connected(self) -> bool:
        """Whether the connection is up, as far as anybody has noticed."""
        return not self._loop.is_closed() and self.client.connected

    @property
    def seen(self) -> bytes:
        """What has come since ``forget_seen``."""
        return self._books.seen if self._books else b""

    def forget_seen(self) -> None:
        """Start ``seen`` anew."""
        if self._books:
            self._books.seen = b""

    def connect(self) -> bool:
        """Whether somebody took the connection."""
        if not self.run(self.client.connect()):
            return False
        if self._books and isinstance(self._clock, VirtualClock):
            self._loop.watch(self._books.open(self._clock))
        return True

    def run(self, work: Awaitable[T]) -> T:
        """Run ``work`` to its end and return what it returns.

        Interrupted, it closes the session, so that a late answer can't meet the next question. Raises what
        ``work`` raises, CancelledError when somebody closed the session meanwhile, and TimeoutError when an
        emulator's thread hangs.
        """
        loop = self._loop
        task = asyncio.ensure_future(work, loop=loop)
        task.add_done_callback(lambda _: loop.stop())
        try:
            while not task.done():
                loop.run_forever()
                if not task.done():
                    loop.let_time_pass()
        except BaseException:
            self.close()
            raise
        return task.result()

    def close(self) -> None:
        """Close the connection and end what is still under way; once more is no error."""
        if self._loop.is_closed():
            return
        if self._books:
            self._books.close()
        try:
            for task in asyncio.all_tasks(self._loop):
                task.cancel()
            self._loop.turn()
        finally:
            self._loop.close()


async def _make_client(host: str, port: int, timeout_s: float, retries: int) -> tuple[AsyncModbusTcpClient, _Books]:
    client = AsyncModbusTcpClient(host, port=port, timeout=timeout_s, retries=retries, reconnect_delay=0)
    client.ctx = books = _Books(client.comm_params, retries)
    return client, books


class _ClockLoop(asyncio.SelectorEventLoop):
    """An event loop whose time is the clock's. With virtual time it stops where it would have to wait."""

    def __init__(self, clock: Clock) -> None:
        self._time_source = clock
        self._virtual = clock if isinstance(clock, VirtualClock) else None
        self._patient = _PatientSelector(self) if self._virtual else None
        super().__init__(self._patient)
        self.set_exception_handler(lambda *_: None)  # what matters reaches the open question

    def time(self) -> float:
        return self._time_source.now()

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

    def __init__(self, loop: _ClockLoop) -> None:
        super().__init__()
        self._stopped_loop = loop
        self.wire: Wire | None = None
        self.quiet_s: float | None = None

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        events = super().select(0)
        if events or (timeout is not None and timeout <= 0):
            return events
        if self.wire is None:
            events = super().select(timeout)  # while connecting
        elif self.wire.settle(PATIENCE_S):
            events = super().select(PATIENCE_S)
        if not events:
            self.quiet_s = timeout
            self._stopped_loop.stop()
        return events


class _Books(TransactionManager):
    """pymodbus's transactions with an account of the bytes, and with an end to a question whose link has gone."""

    def __init__(self, params: CommParams, retries: int) -> None:
        super().__init__(params, FramerSocket(DecodePDU(False)), retries, False, self._note_sent, None, None)
        self.seen = b""
        self._wire: Wire | None = None
        self._virtual: VirtualClock | None = None
        self._near_end = 0

    def open(self, clock: VirtualClock) -> Wire:
        """Keep the virtual clock's account from now on."""
        self._near_end = self.transport.get_extra_info("sockname")[1]
        self._virtual, self._wire = clock, clock.wire(self._near_end)
        return self._wire

    def close(self, reconnect: bool = False) -> None:
        """Close the connection and drop the account."""
        super().close(reconnect)
        if self._virtual:
            self._virtual.forget_wire(self._near_end)
        self._virtual = self._wire = None

    def data_received(self, data: bytes) -> None:
        self.seen = (self.seen + data)[-REMEMBERED:]
        if self._wire:
            self._wire.add(to_host=-len(data))
        super().data_received(data)

    def callback_disconnected(self, exc: Exception | None) -> None:
        super().callback_disconnected(exc)
        if self._lock.locked() and not self.response_future.done():
            broken = exc if isinstance(exc, ModbusException) else ConnectionException("the other end hung up")
            self.response_future.set_exception(broken)

    def _note_sent(self, sending: bool, data: bytes) -> bytes:
        if sending and self._wire:
            self._wire.add(to_device=len(data))
        return data
