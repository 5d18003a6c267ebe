"""The emulators' end of a link: listens on loopback TCP and hands bytes to a device that never waits.

One listener serves one device, on a port that the system chooses. It may not know what the bytes mean. A
device answers at once through its connection, or later through ``after``; it never sleeps, and it is never
called by two threads at the same time: all emulators of a world share one lock.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable
from typing import Protocol

from instruments.clock import Clock, VirtualClock, Wire


class Device(Protocol):
    """The emulated instrument behind a wire."""

    def connect(self, connection: Connection) -> None:
        """Somebody has plugged in; what the device says unasked is sent here."""
        ...

    def receive(self, connection: Connection, data: bytes) -> None:
        """Bytes came, cut anywhere."""
        ...

    def disconnect(self, connection: Connection) -> None:
        """The cable is out."""
        ...


class Connection:
    """One host's connection to a device: the device's way to answer."""

    def __init__(self, sock: socket.socket, clock: Clock, lock: threading.RLock, wire: Wire | None) -> None:
        self._socket = sock
        self._clock = clock
        self._lock = lock
        self._wire = wire
        self.open = True

    def send(self, data: bytes) -> None:
        """Send now. Bytes for a host that has gone are dropped, as on a real wire."""
        if not self.open or not data:
            return
        if self._wire:
            self._wire.add(to_host=len(data))
        with contextlib.suppress(OSError):
            self._socket.sendall(data)

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        """Run ``action`` once the clock has moved on by ``seconds``, unless the host has gone by then."""

        def run() -> None:
            with self._lock:
                if self.open:
                    action()

        self._clock.call_at(self._clock.now() + seconds, run)

    def hang_up(self) -> None:
        """Break the connection from the device's side: a pulled cable, a power cut."""
        self.open = False
        if self._wire:
            self._wire.closed()  # at once, so that virtual time does not run on while the host waits
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)


class Listener:
    """Serves ``device`` until closed. ``url`` is what a driver opens. Raises OSError when the address is taken."""

    def __init__(self, device: Device, clock: Clock, *, lock: threading.RLock, name: str, host: str = "127.0.0.1", port: int = 0) -> None:
        self.name = name
        self._device = device
        self._clock = clock
        self._lock = lock
        self._server = socket.create_server((host, port))
        self.port: int = self._server.getsockname()[1]
        self.url = f"socket://{host}:{self.port}"
        self._connections: set[Connection] = set()
        self._threads: list[threading.Thread] = []
        self._closing = False
        self._start(self._accept)

    def close(self) -> None:
        """Stop listening, break all connections and wait for the threads to end."""
        self._closing = True
        with contextlib.suppress(OSError), socket.create_connection(self._server.getsockname(), timeout=1.0):
            pass  # wakes the accepting thread on every system
        self._server.close()
        with self._lock:
            connections = list(self._connections)
        for connection in connections:
            connection.hang_up()
        for thread in self._threads:
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
        connection = Connection(sock, self._clock, self._lock, wire)
        with self._lock:
            self._connections.add(connection)
            self._device.connect(connection)
        if wire:
            wire.accepted()
        try:
            self._pump(sock, connection, wire)
        finally:
            with self._lock:
                connection.open = False
                self._connections.discard(connection)
                self._device.disconnect(connection)
            if wire:
                wire.closed()
            sock.close()

    def _pump(self, sock: socket.socket, connection: Connection, wire: Wire | None) -> None:
        while not self._closing:
            try:
                data = sock.recv(65536)
            except OSError:
                return
            if not data:
                return
            with self._lock:
                self._device.receive(connection, data)
            if wire:
                wire.add(to_device=-len(data))
