"""A serial line's speed and an adapter's latency, kept in real time between a port and a
connection.

Each direction carries one byte after another, 10 bits each, by absolute times, so a thread that
wakes late delays one byte and never the rate. Refused under virtual time.
"""

from __future__ import annotations

import collections
import contextlib
import math
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Protocol

from instruments.clock import Clock, VirtualClock

BITS_PER_BYTE = 10  # start, eight, stop
PIECE_S = 0.002  # bytes of so long are handed on together, when the last of them is through
# a thread may wake up so late: the rest of a wait is polled, not slept
SPIN_S = 0.00008


class Port(Protocol):
    """A device's end of one host's cable."""

    def write(self, data: bytes) -> None:
        """Hand all of ``data`` to the host. Raises OSError when it has gone."""

    def hang_up(self) -> None:
        """Break the cable, which ends a read. Called from any thread, more than once too."""

    def baud(self) -> int | None:
        """The rate that the host has set its end to; None where that can't be known."""


class ServedPort(Port, Protocol):
    """One that a thread reads."""

    def fileno(self) -> int:
        """What `select` waits for."""

    def ready(self) -> bool:
        """Whether anything has come, or the host has gone."""

    def take(self, count: int) -> bytes:
        """As ``read``, but never waits: raises BlockingIOError where there is nothing after all."""

    def read(self, count: int) -> bytes:
        """At most ``count`` bytes, waiting for the first; empty or OSError at the end."""


def check_pace(clock: Clock, baud: int | None, latency_s: float) -> None:
    """Raise ValueError for a pace that no line has, and for one under virtual time."""
    if baud is not None and baud < 1:
        what = f"a line's rate is 1 baud at least, not {baud}"
        raise ValueError(f"{what}; leave it out for one that is not paced")
    if not 0.0 <= latency_s < math.inf:
        raise ValueError(f"an adapter's latency is 0 s or more, not {latency_s}")
    if isinstance(clock, VirtualClock) and (baud is not None or latency_s):
        raise ValueError(
            "a paced line keeps real time and can't be had under virtual time; take a RealClock, or"
            " no pace"
        )


class PacedDirection:
    """One direction: when bytes are through. ``byte_s`` is 0 without a pace."""

    def __init__(self, byte_s: float) -> None:
        self.byte_s = byte_s
        self.free_s = -math.inf

    def carry(self, count: int, from_s: float) -> float:
        """Queue ``count`` bytes at ``from_s``; when the last one is through."""
        self.free_s = max(self.free_s, from_s) + count * self.byte_s
        return self.free_s


class Pacer:
    """Both directions of one host's cable. ``run`` is the listener's thread."""

    def __init__(self, port: ServedPort, clock: Clock, baud: int | None, latency_s: float) -> None:
        byte_s = BITS_PER_BYTE / baud if baud else 0.0
        self._port = port
        self._clock = clock
        self._latency_s = latency_s
        self._piece = max(1, int(PIECE_S / byte_s)) if byte_s else 65536
        self._to_device, self._to_host = PacedDirection(byte_s), PacedDirection(byte_s)
        self._for_host: collections.deque[tuple[float, bytes]] = collections.deque()
        self._received = b""  # on its way to the device
        self._received_s = math.inf  # when the last byte of it is through
        # the line's time of the byte that the device gets just now
        self._moment_s: float | None = None
        self._hung_up = self._aborted = False
        self._thread = 0
        # not a pipe: Windows selects sockets only
        self._wake_near, self._wake_far = socket.socketpair()
        self._wake_far.setblocking(False)

    def send(self, data: bytes) -> None:
        """Queue bytes for the host: an answer from its question's end, else from now."""
        answers = self._moment_s is not None and threading.get_ident() == self._thread
        start_s = self._moment_s if answers and self._moment_s is not None else self._clock.now()
        for at in range(0, len(data), self._piece):
            piece = data[at : at + self._piece]
            self._for_host.append(
                (self._to_host.carry(len(piece), start_s) + self._latency_s, piece)
            )
        if not answers:
            self._wake()

    def busy_s(self) -> float:
        """How long from now until the host's line is free."""
        return max(0.0, self._to_host.free_s - self._clock.now())

    def hang_up(self) -> None:
        """Break the cable once what is on the line is through."""
        self._hung_up = True
        self._wake()

    def abort(self) -> None:
        """Break the cable now; what is on the line is lost."""
        self._aborted = True
        self._wake()

    def run(self, receive: Callable[[bytes], None]) -> None:
        """Serve until the connection ends; ``receive`` gets each byte once it is through."""
        self._thread = threading.get_ident()
        try:
            if self._port.ready() and not self._receive(self._clock.now()):
                return
            while True:
                now, data = self._clock.now(), b""
                while self._for_host and self._for_host[0][0] <= now:
                    data += self._for_host.popleft()[1]
                if data:
                    with contextlib.suppress(OSError):  # the host has gone: the next read says so
                        self._port.write(data)
                if (
                    self._aborted
                    or (self._hung_up and not self._for_host)
                    or not self._turn(receive)
                ):
                    return
        finally:
            if self._hung_up:
                self._port.hang_up()
            self._wake_near.close()
            self._wake_far.close()

    def _turn(self, receive: Callable[[bytes], None]) -> bool:
        """Hand over what is through, or wait for the next; False when the host has gone."""
        if not self._received:
            return not self._wait(listen=True) or self._receive(self._clock.now())
        if self._clock.now() < self._received_s:
            self._wait(listen=False)
            return True
        # each byte by itself, so that each answer starts where its question ended
        data, self._received = self._received, b""
        step = 1 if self._to_device.byte_s else len(data)
        for end in range(step, len(data) + 1, step):
            self._moment_s = self._received_s - (len(data) - end) * self._to_device.byte_s
            if not (self._hung_up or self._aborted):
                receive(data[end - step : end])
        self._moment_s = None
        # What waits by now followed without a gap: it began when the last byte ended, not when this
        # thread looked.
        return not self._port.ready() or self._receive(self._received_s)

    def _receive(self, from_s: float) -> bool:
        try:
            self._received = self._port.take(self._piece)
        except BlockingIOError:
            return True
        except OSError:
            return False
        self._received_s = self._to_device.carry(len(self._received), from_s)
        return bool(self._received)

    def _wait(self, *, listen: bool) -> bool:
        """Wait for the next due time or a wake; True when the host has sent something."""
        due_s = min(
            self._received_s if self._received else math.inf,
            self._for_host[0][0] if self._for_host else math.inf,
        )
        sleep_s = None if due_s == math.inf else max(0.0, due_s - self._clock.now() - SPIN_S)
        wake, port = self._wake_near.fileno(), self._port.fileno()
        ready = select.select([wake, port] if listen else [wake], [], [], sleep_s)[0]
        if wake in ready:
            self._wake_near.recv(64)
        if not ready:
            while self._clock.now() < due_s:
                time.sleep(0)
        return port in ready

    def _wake(self) -> None:
        # full: a wake is on its way already; closed: no thread waits
        with contextlib.suppress(OSError):
            self._wake_far.send(b"w")
