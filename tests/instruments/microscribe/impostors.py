"""Far ends that are no emulator: what says an arm's words with other answers, and what only sends
something back.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from instruments.clock import VirtualClock
from instruments.errors import LimitError
from instruments.link import Link
from instruments.listener import Connection, Listener
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.session import ANSWER_S


class Ghost:
    """An arm as far as its words go, whose answers are what
    ``answer`` makes of the command byte.
    """

    def __init__(self, answer: Callable[[int], bytes]) -> None:
        self.answer = answer

    def connect(self, connection: Connection) -> None: ...

    def receive(self, connection: Connection, data: bytes) -> None:
        if data.endswith(b"IMMC"):
            connection.send(b"IMMC")
        elif data == b"BEGIN":
            connection.send(b"MSCR\0")
        else:
            connection.send(b"".join(map(self.answer, data)))

    def disconnect(self, connection: Connection) -> None: ...


class Parrot:
    """Sends back what it hears, as a loop-back plug does, after ``change``."""

    def __init__(self, change: Callable[[bytes], bytes]) -> None:
        self.change = change

    def connect(self, connection: Connection) -> None: ...

    def receive(self, connection: Connection, data: bytes) -> None:
        connection.send(self.change(data))

    def disconnect(self, connection: Connection) -> None: ...


def sign_on_to(
    device: Ghost | Parrot, rates: tuple[int, ...] | None = None, answer_s: float = ANSWER_S
) -> None:
    """Signs on, which has to fail and leave no session."""
    clock = VirtualClock()
    listener = Listener(device, clock, lock=threading.RLock(), name="ghost")
    driver = MicroScribe(
        Link(listener.url, clock, who="arm"), clock, rates=rates, answer_s=answer_s
    )
    try:
        driver.sign_on()
    finally:
        with pytest.raises(LimitError, match="no session"):
            driver.poll()
        driver.close()
        listener.close()
