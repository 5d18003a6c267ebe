"""An asyncio event loop whose time is the project's clock, for one connection and no thread.

With virtual time it waits for bytes in flight and for nothing else: where it would have to wait it
stops, and time moves on outside of it, so that an event of that time may use the loop too. It may
not know what the bytes are.

One connection of pymodbus's asyncio client, run from the calling thread and only while somebody
waits for bytes.

No thread, no hand-over, nothing to leak. The event loop's time is the clock's: under virtual time
it stops where it would have to wait, and time moves on outside of it, so an event of that time may
ask a question of its own. It moves bytes and may not know what they mean.
"""

from __future__ import annotations

import asyncio
import os
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU
from pymodbus.transaction import TransactionManager
from pymodbus.transport import CommParams

from instruments.bath.connection import BAUD, Line
from instruments.clock import Clock, VirtualClock, Wire
from instruments.tap import Tap

PATIENCE_S = 10.0  # real time that an emulator's thread gets before we call it hung
# pymodbus looks at serial ports by turns there, so the loop does not know
FORCED_TO_POLL = os.name == "nt"


class ClockLoop(asyncio.SelectorEventLoop):
    """An event loop whose time is the clock's. With virtual time it stops where it would have to
    wait.
    """

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
    """Waits for bytes in flight and for nothing else: then it stops the loop and says how long it
    would have waited.
    """

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
            # while connecting, or where nobody keeps an account of the bytes
            events = super().select(timeout)
        elif self.wire.settle(PATIENCE_S):
            events = super().select(PATIENCE_S)
        if not events:
            self.quiet_s = timeout
            self._stopped_loop.stop()
        return events


try:
    import termios

    # the last two where a port can't be set so
    PORT_ERRORS: tuple[type[Exception], ...] = (OSError, ValueError, termios.error)
except ImportError:  # Windows
    PORT_ERRORS = (OSError, ValueError)
REMEMBERED = 300  # bytes kept for messages: more than the longest answer
ROUNDING_S = 1e-8  # an event loop takes an appointment for due up to 1e-9 s before its time

T = TypeVar("T")


class Session:
    """A client and the loop that it lives in. ``connect`` first; ``close`` last, and at any moment.

    ``hear`` is given all bytes that came and were not yet used, whenever some have come, and says
    how many it has used.
    """

    def __init__(
        self, line: Line, clock: Clock, hear: Callable[[bytes], int], *, timeout_s: float, tap: Tap
    ) -> None:
        self._line = line
        self._clock = clock
        self._loop = ClockLoop(clock)
        self._client, self._books = self._run(_make_client(line, timeout_s, hear, tap))

    @property
    def connected(self) -> bool:
        """Whether the connection is up, as far as anybody has noticed."""
        return not self._loop.is_closed() and self._client.connected

    @property
    def seen(self) -> bytes:
        """What has come since the last ``send``."""
        return self._books.seen

    @property
    def refusal(self) -> str:
        """Why the last ``connect`` failed, in the system's words."""
        return self._books.refusal

    def connect(self) -> bool:
        """Whether somebody took the connection."""
        if not self._run(self._client.connect()):
            return False
        self._books.tell_opened(self._line.url)
        if isinstance(self._clock, VirtualClock) and self._line.kind != "serial":
            self._loop.watch(self._books.open(self._clock))
        return True

    def drain(self) -> None:
        """Take in, and drop, what has come unasked."""
        if self._loop.has_input():
            self.wait(self._clock.now(), lambda: False)

    def send(self, data: bytes) -> None:
        """Send ``data``; what came before it is dropped."""
        self._books.put(data)

    def wait(self, until_s: float, done: Callable[[], bool]) -> None:
        """Take in what comes until ``done``, the clock shows ``until_s``, or the link breaks, be it
        by an event of virtual time.

        Interrupted, it closes the session. Raises TimeoutError when an emulator's thread hangs.
        """
        if done() or not self.connected:
            return
        loop = self._loop
        timer = loop.call_at(until_s, loop.stop)
        try:
            while True:
                loop.run_forever()
                if done() or self._clock.now() >= until_s - ROUNDING_S or not self.connected:
                    return
                loop.let_time_pass()
                # an event of that time may have closed this very session
                if done() or not self.connected:
                    return
        except BaseException:
            self.close()
            raise
        finally:
            timer.cancel()

    def close(self) -> None:
        """Close the connection and end what is still under way; once more is no error."""
        if self._loop.is_closed():
            return
        self._books.close()
        try:
            for task in asyncio.all_tasks(self._loop):
                task.cancel()
            self._loop.turn()
        finally:
            self._loop.close()

    def _run(self, work: Coroutine[Any, Any, T]) -> T:
        task = self._loop.create_task(work)
        task.add_done_callback(lambda _: self._loop.stop())
        try:
            while not task.done():
                self._loop.run_forever()
                if not task.done():
                    self._loop.let_time_pass()
        except BaseException:
            self._loop.close()
            raise
        return task.result()


async def _make_client(
    line: Line, timeout_s: float, hear: Callable[[bytes], int], tap: Tap
) -> tuple[AsyncModbusTcpClient | AsyncModbusSerialClient, _Books]:
    client: AsyncModbusTcpClient | AsyncModbusSerialClient
    if line.kind == "serial":
        settings = {
            "baudrate": line.baud or BAUD,
            "parity": line.parity or "N",
            "stopbits": line.stopbits or 1,
        }
        client = AsyncModbusSerialClient(
            line.device,
            timeout=timeout_s,
            retries=0,
            reconnect_delay=0,
            **settings,  # type: ignore[arg-type]
        )
    else:
        client = AsyncModbusTcpClient(
            line.host, port=line.port, timeout=timeout_s, retries=0, reconnect_delay=0
        )
    books = _Books(client.comm_params, hear, tap)
    client.ctx = books
    return client, books


class _Books(TransactionManager):
    """The client's transport with an account of its bytes, and with no transactions of its own: it
    stops the loop when bytes have come.
    """

    def __init__(self, params: CommParams, hear: Callable[[bytes], int], tap: Tap) -> None:
        super().__init__(params, FramerSocket(DecodePDU(False)), 0, False, None, None, None)
        self.seen = b""
        self.refusal = ""
        self._hear = hear
        self._tap = tap
        self._told_opened = False
        self._wire: Wire | None = None
        self._virtual: VirtualClock | None = None
        self._near_end = 0
        self._create = self.call_create
        self.call_create = self._noted_create

    def tell_opened(self, url: str) -> None:
        """Tell the tap that the link is up."""
        self._told_opened = True
        self._tap.opened(url)

    def open(self, clock: VirtualClock) -> Wire:
        """Keep the virtual clock's account from now on."""
        self._near_end = self.transport.get_extra_info("sockname")[1]
        self._virtual, self._wire = clock, clock.wire(self._near_end)
        return self._wire

    def put(self, data: bytes) -> None:
        """Send ``data``, and forget what came before."""
        self.seen = b""
        if self._wire:
            self._wire.add(to_device=len(data))
        self._tap.sent(data)
        self.send(data)

    def close(self, reconnect: bool = False) -> None:
        """Close the connection and drop the account."""
        super().close(reconnect)
        self._tell_closed("")
        if self._virtual:
            self._virtual.forget_wire(self._near_end)
        self._virtual = self._wire = None

    def data_received(self, data: bytes) -> None:
        self.seen = (self.seen + data)[-REMEMBERED:]
        if self._wire:
            self._wire.add(to_host=-len(data))
        self._tap.received(data)
        super().data_received(data)

    def callback_data(self, data: bytes, addr: tuple[str, int] | None = None) -> int:  # noqa: ARG002 - pymodbus's name for it
        used = self._hear(data)
        if used:
            self.loop.stop()
        return used

    def callback_disconnected(self, exc: Exception | None) -> None:
        self._tell_closed(str(exc) if exc else "the other end hung up")
        self.loop.stop()

    async def _noted_create(self) -> object:
        try:
            return await self._create()
        except PORT_ERRORS as error:
            self.refusal = (
                os.strerror(error.errno)
                if isinstance(error, ConnectionError) and error.errno
                else str(error)
            )
            raise OSError(self.refusal) from error

    def _tell_closed(self, why: str) -> None:
        if self._told_opened:
            self._told_opened = False
            self._tap.closed(why)
