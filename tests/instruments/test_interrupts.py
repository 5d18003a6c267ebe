"""Ctrl-C at any instruction of a conversation under virtual time: the link can go on, and nothing
hangs.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from types import FrameType

import pytest

from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.listener import Connection, Listener

INTERRUPTS = 300


class Echo:
    """Answers at once, and once more after half a second."""

    def connect(self, connection: Connection) -> None: ...

    def receive(self, connection: Connection, data: bytes) -> None:
        connection.send(data)
        connection.after(0.5, lambda: connection.send(b"later\n"))

    def disconnect(self, connection: Connection) -> None: ...


class Alarm:
    """Raises KeyboardInterrupt wherever the main thread is, while it is armed."""

    def __init__(self) -> None:
        self.armed = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self.armed:
            self.armed = False
            raise KeyboardInterrupt


def talk(link: Link, alarm: Alarm) -> None:
    alarm.armed = True
    while True:
        link.write(b"x\n")
        link.read_until(b"later\n", 5.0)


@pytest.fixture
def alarm() -> Iterator[Alarm]:
    if not hasattr(signal, "setitimer"):
        pytest.skip("needs interval timers, which this system has none of")
    handler = Alarm()
    before = signal.signal(signal.SIGALRM, handler)
    yield handler
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)


def test_a_conversation_that_was_interrupted_anywhere_goes_on(
    alarm: Alarm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("instruments.link.COUNTED_S", 0.05)
    clock = VirtualClock()
    listener = Listener(Echo(), clock, lock=threading.RLock(), name="echo")
    link = Link(listener.url, clock, who="echo")
    for number in range(INTERRUPTS):
        signal.setitimer(signal.ITIMER_REAL, 0.0005 + (number % 37) * 0.00003)
        with pytest.raises(KeyboardInterrupt):
            talk(link, alarm)
    monkeypatch.undo()  # from here on nothing is cut: a starved emulator has its time
    link.drain(2.0)
    link.write(b"still there\n")
    assert link.read_until(b"later\n", 5.0) == b"still there\nlater\n"
    link.close()
    listener.close()
