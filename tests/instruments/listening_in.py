"""A device that answers on a link, and a tap that notes what passes."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from instruments.clock import Clock
from instruments.link import Link, Tap
from instruments.listener import Connection, Device, Listener


class Heard(Tap):
    """``told``: each event with its fact, in order."""

    def __init__(self) -> None:
        self.text: list[tuple[str, bytes | str]] = []

    def opened(self, url: str) -> None:
        self.text.append(("opened", url))

    def sent(self, data: bytes) -> None:
        self.text.append(("sent", data))

    def received(self, data: bytes) -> None:
        self.text.append(("received", data))

    def closed(self, why: str = "") -> None:
        self.text.append(("closed", why))


class Echo:
    """Greets and answers in capitals at once, and with ``done`` once more after ``later_s``;
    ``bye`` is answered with ``farewell`` and a hang-up, ``silent`` not at all.
    """

    def __init__(
        self, later_s: float | None = None, *, greeting: bytes = b"hello\n", farewell: bytes = b""
    ) -> None:
        self.later_s = later_s
        self.greeting = greeting
        self.farewell = farewell
        self.bye = b"x"
        self.heard: list[bytes] = []
        self.connections: list[Connection] = []
        self.gone = 0

    @property
    def connection(self) -> Connection:
        """The latest."""
        return self.connections[-1]

    def connect(self, connection: Connection) -> None:
        self.connections.append(connection)
        connection.send(self.greeting)

    def receive(self, connection: Connection, data: bytes) -> None:
        self.heard.append(data)
        if data == self.bye:
            connection.send(self.farewell)
            connection.hang_up()
        elif data != b"silent":
            connection.send(data.upper())
            if self.later_s is not None:
                connection.after(self.later_s, lambda: connection.send(b"done\n"))

    def disconnect(self, connection: Connection) -> None:
        self.gone += 1


@contextmanager
def linked(
    device: Device,
    clock: Clock,
    *,
    baud: int | None = None,
    latency_s: float = 0.0,
    tap: Tap | None = None,
) -> Iterator[tuple[Link, Listener]]:
    """A host's link to the device, and the device's listener; both are closed at the end."""
    lock = threading.RLock()
    listener = Listener(device, clock, lock=lock, name="echo", baud=baud, latency_s=latency_s)
    link = Link(listener.url, clock, who="echo", tap=tap)
    try:
        yield link, listener
    finally:
        link.close()
        listener.close()
