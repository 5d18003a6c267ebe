"""The emulators' end of a link: listens on loopback TCP and hands bytes to a device that never
waits. Under virtual time a host of this process needs no socket.

One listener a device, on a port that the system chooses. A device answers at once or through
``Connection.after``. All emulators of a world share one lock, so no device is called by two threads
at once.
"""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Protocol
from weakref import WeakSet

from instruments.clock import Clock, VirtualClock, unbroken
from instruments.pacing import Pacer, Port, ServedPort, check_pace

# to wait for a thread's end: one that reads what another thread has closed may never end
END_S = 3.0


class Device(Protocol):
    """The emulated instrument behind a wire."""

    def connect(self, connection: Connection) -> None:
        """A host has connected; what the device sends unasked goes to ``connection``."""

    def receive(self, connection: Connection, data: bytes) -> None:
        """The host has sent ``data``, which may begin and end anywhere in a message."""

    def disconnect(self, connection: Connection) -> None:
        """The connection has ended."""


class Connection:
    """One host's connection to a device. ``pacer``: between it and the port."""

    def __init__(
        self, port: Port, clock: Clock, lock: threading.RLock, *, pacer: Pacer | None = None
    ) -> None:
        self._port = port
        self._clock = clock
        self._lock = lock
        self._pacer = pacer
        self.open = True

    def send(self, data: bytes) -> None:
        """Send now. Bytes for a host that has gone are dropped, as on a real wire."""
        if not self.open or not data:
            return
        if self._pacer:
            self._pacer.send(data)
            return
        try:  # noqa: SIM105 - suppress() takes longer than the rest of this
            self._port.write(data)
        except OSError:
            pass

    def after(self, seconds: float, action: Callable[[], None], *, when_gone: bool = False) -> None:
        """Run ``action`` in ``seconds``; ``when_gone``: also where the host has gone by then."""

        def run() -> None:
            with self._lock:
                if self.open or when_gone:
                    action()

        self._clock.call_at(self._clock.now() + seconds, run)

    def busy_s(self) -> float:
        """Time left on the line for what was sent; 0 without a pace."""
        return self._pacer.busy_s() if self._pacer else 0.0

    def baud(self) -> int | None:
        """The rate that the host's port is set to; None where the device's end can't tell."""
        return self._port.baud()

    def hang_up(self) -> None:
        """Break the connection: a cable or power loss. What was sent before arrives."""
        self.open = False
        if self._pacer:
            self._pacer.hang_up()
        else:
            self._port.hang_up()

    def abort(self) -> None:
        """Break the connection because the listener closes: what is still on the line is lost."""
        self.hang_up()
        if self._pacer:
            self._pacer.abort()


class ServedConnection(Connection):
    """One that a thread of the listener serves. ``pace``: baud and latency, as of `Listener`."""

    def __init__(
        self, port: ServedPort, clock: Clock, lock: threading.RLock, pace: tuple[int | None, float]
    ) -> None:
        pacer = None if pace == (None, 0.0) else Pacer(port, clock, *pace)
        super().__init__(port, clock, lock, pacer=pacer)
        self._read = port.read

    def serve(self, device: Device) -> None:
        """Hand ``device`` what comes until the connection ends."""

        def receive(data: bytes) -> None:
            with self._lock:
                device.receive(self, data)

        with self._lock:
            device.connect(self)
        try:
            if self._pacer:
                self._pacer.run(receive)
            else:
                for data in self._pieces():
                    receive(data)
        finally:
            with self._lock:
                self.open = False
                device.disconnect(self)

    def _pieces(self) -> Iterator[bytes]:
        with contextlib.suppress(OSError):
            while data := self._read(65536):
                yield data


class Loopback(Connection):
    """A connection to a host in this process under virtual time; it is that host's port, too. The
    device takes bytes on the thread that sends them, so no run depends on how fast threads are.
    """

    def __init__(self, device: Device, clock: VirtualClock, lock: threading.RLock) -> None:
        self._answers = _HostBuffer()
        super().__init__(self._answers, clock, lock)
        self._device, self._time = device, clock
        self._connected = False

    @unbroken
    def connect(self) -> None:
        """The cable is in."""
        with self._lock:
            self._connected = True
            self._device.connect(self)

    def read_some(self, timeout_s: float) -> bytes:
        """As `HostPort`; time moves where nothing has come."""
        until_s = self._time.now() + timeout_s
        while not self._answers.data:
            if self._answers.ended:
                self.close()
                raise ConnectionResetError("the other end hung up")
            if self._time.now() >= until_s:
                return b""
            self._time.step(until_s)
        data, self._answers.data = self._answers.data, b""
        return data

    @unbroken
    def write(self, data: bytes) -> None:
        """As `HostPort`. A device that has hung up gets nothing; the host notices as it reads."""
        with self._lock:
            if self.open:
                self._device.receive(self, data)

    def set_baud(self, baud: int) -> None:
        """As `HostPort`: there is no rate."""

    @unbroken
    def close(self) -> None:
        """As `HostPort`: the cable is out."""
        with self._lock:
            self.open = False
            if self._connected:
                self._connected = False
                self._device.disconnect(self)

    def abort(self) -> None:
        self.hang_up()
        self.close()


class _HostBuffer:
    """A device's end of a `Loopback`: keeps what it sends until the host reads."""

    def __init__(self) -> None:
        self.data, self.ended = b"", False

    def write(self, data: bytes) -> None:
        self.data += data

    def hang_up(self) -> None:
        self.ended = True

    def baud(self) -> int | None:
        """It isn't known."""
        return None


class Listener:
    """Serves ``device`` at ``url`` until closed. ``baud``: real time of a serial line;
    ``latency_s``: of an adapter. Raises OSError for a taken address, ValueError for a pace under
    virtual time.
    """

    def __init__(
        self,
        device: Device,
        clock: Clock,
        *,
        lock: threading.RLock,
        name: str,
        host: str = "127.0.0.1",
        port: int = 0,
        baud: int | None = None,
        latency_s: float = 0.0,
    ) -> None:
        check_pace(clock, baud, latency_s)
        self.name = name
        self._device = device
        self._clock = clock
        self._lock = lock
        self._pace = baud, latency_s
        self._server = socket.create_server((host, port))
        self.port: int = self._server.getsockname()[1]
        self.url = f"socket://{host}:{self.port}"
        self._connections: WeakSet[Connection] = WeakSet()
        self._threads: list[threading.Thread] = []
        self._closing = False
        self.pulled = False
        if isinstance(clock, VirtualClock):
            clock.emulators[self.port] = partial(self._connected, clock)
        self._start(self._accept)

    def pull(self, *, out: bool) -> None:
        """Pull the cable, or put it back: while it is out no host keeps a connection."""
        with self._lock:
            self.pulled = out
            for connection in self._connections if out else ():
                connection.hang_up()

    def close(self) -> None:
        """Stop listening, break all connections and wait for the threads to end."""
        self._closing = True
        if isinstance(self._clock, VirtualClock):
            self._clock.emulators.pop(self.port, None)
        with (
            contextlib.suppress(OSError),
            socket.create_connection(self._server.getsockname(), timeout=1.0),
        ):
            pass  # wakes the accepting thread on every system
        with contextlib.suppress(OSError):  # on Linux also where no more files can be opened
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        with self._lock:
            connections = list(self._connections)
        for connection in connections:
            connection.abort()
        for thread in self._threads:
            if thread.ident:  # else a limit of memory or of threads has refused it
                thread.join(END_S)

    def _start(self, work: Callable[[], None]) -> None:
        thread = threading.Thread(target=work, name=f"{self.name} emulator", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while True:
            try:
                sock = self._server.accept()[0]
            except OSError:
                return
            if self._closing:
                sock.close()
                return
            self._start(partial(self._serve, sock))

    def _serve(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with sock:
            with self._lock:
                if self._closing or self.pulled:
                    return
                connection = ServedConnection(_TcpEnd(sock), self._clock, self._lock, self._pace)
                self._connections.add(connection)
            connection.serve(self._device)

    def _connected(self, clock: VirtualClock) -> Loopback:
        """The port of a host in this process; broken from the start while the cable is out."""
        with self._lock:
            loop = Loopback(self._device, clock, self._lock)
            if self.pulled:
                loop.hang_up()
            else:
                self._connections.add(loop)
                loop.connect()
            return loop


class _TcpEnd:
    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock
        self.fileno = sock.fileno
        self.read = self.take = sock.recv
        self.write = sock.sendall

    def ready(self) -> bool:
        return bool(select.select([self._socket], [], [], 0)[0])

    def hang_up(self) -> None:
        with contextlib.suppress(OSError):  # gone already
            self._socket.shutdown(socket.SHUT_RDWR)

    def baud(self) -> int | None:
        """TCP doesn't carry it."""
        return None
