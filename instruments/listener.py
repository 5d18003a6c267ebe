"""The emulators' end of a link: listens on loopback TCP and hands bytes to a device that never
waits.

One listener a device, on a port that the system chooses. A device answers at once or through
``Connection.after``. All emulators of a world share one lock, so no device is called by two threads
at once.
"""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections.abc import Callable
from typing import Protocol

from instruments.clock import Clock, VirtualClock, Wire
from instruments.pacing import Pacer, Port, check_pace


class Device(Protocol):
    """The emulated instrument behind a wire."""

    def connect(self, connection: Connection) -> None:
        """A host has connected; what the device says unasked is sent here."""

    def receive(self, connection: Connection, data: bytes) -> None:
        """Bytes came, cut anywhere."""

    def disconnect(self, connection: Connection) -> None:
        """The cable is out."""


class Connection:
    """One host's connection to a device. ``pace``: baud and latency, as of `Listener`."""

    def __init__(
        self,
        port: Port,
        clock: Clock,
        lock: threading.RLock,
        *,
        wire: Wire | None = None,
        pace: tuple[int | None, float] = (None, 0.0),
    ) -> None:
        self._port = port
        self._clock = clock
        self._lock = lock
        self._wire = wire
        self._pacer = None if pace == (None, 0.0) else Pacer(port, clock, *pace)
        self.open = True

    def send(self, data: bytes) -> None:
        """Send now. Bytes for a host that has gone are dropped, as on a real wire."""
        if not self.open or not data:
            return
        if self._wire:
            self._wire.send(len(data), lambda: self._write(data))
        else:
            self._write(data)

    def _write(self, data: bytes) -> None:
        if self._pacer:
            self._pacer.send(data)
            return
        with contextlib.suppress(OSError):
            self._port.write(data)

    def after(self, seconds: float, action: Callable[[], None], *, when_gone: bool = False) -> None:
        """Run ``action`` in ``seconds`` by the clock; ``when_gone``: though the host has gone."""

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
        if self._wire:
            # at once, so that virtual time does not run on while the host waits
            self._wire.closed()
        if self._pacer:
            self._pacer.hang_up()
        else:
            self._port.hang_up()

    def abort(self) -> None:
        """Break the connection because the listener closes: what is still on the line is lost."""
        self.hang_up()
        if self._pacer:
            self._pacer.abort()

    def serve(self, device: Device) -> None:
        """Hand ``device`` what comes until the connection ends: the listener's thread."""
        with self._lock:
            device.connect(self)
        if self._wire:
            self._wire.accepted()
        try:
            if self._pacer:
                self._pacer.run(lambda data: self._receive(device, data))
            else:
                while data := self._read():
                    self._receive(device, data)
        finally:
            with self._lock:
                self.open = False
                device.disconnect(self)
            if self._wire:
                self._wire.closed()

    def _read(self) -> bytes:
        try:
            return self._port.read(65536)
        except OSError:
            return b""

    def _receive(self, device: Device, data: bytes) -> None:
        with self._lock:
            device.receive(self, data)
        if self._wire:
            self._wire.add(to_device=-len(data))


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
        self._connections: set[Connection] = set()
        self._threads: list[threading.Thread] = []
        self._closing = False
        self.pulled = False
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
        with (
            contextlib.suppress(OSError),
            socket.create_connection(self._server.getsockname(), timeout=1.0),
        ):
            pass  # wakes the accepting thread on every system
        self._server.close()
        with self._lock:
            connections = list(self._connections)
        for connection in connections:
            connection.abort()
        for thread in self._threads:
            if thread.ident:  # else a limit of memory or of threads has refused it
                thread.join()

    def _start(self, work: Callable[[], None]) -> None:
        thread = threading.Thread(target=work, name=f"{self.name} emulator", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while True:
            try:
                sock, peer = self._server.accept()
            except OSError:
                return
            if self._closing:
                sock.close()
                return
            self._start(lambda sock=sock, port=peer[1]: self._serve(sock, port))  # type: ignore[misc]

    def _serve(self, sock: socket.socket, host_port: int) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        wire = self._clock.wire(host_port) if isinstance(self._clock, VirtualClock) else None
        with sock:
            with self._lock:
                if self._closing or self.pulled:
                    if wire:
                        wire.closed()
                    return
                port = _TcpPort(sock)
                connection = Connection(port, self._clock, self._lock, wire=wire, pace=self._pace)
                self._connections.add(connection)
            try:
                connection.serve(self._device)
            finally:
                with self._lock:
                    self._connections.discard(connection)


class _TcpPort:
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
