"""The emulated stage: with raw bytes out and back, or on a link with its driver; and devices that
only pretend to be a stage.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any, cast

from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.listener import Connection, Device, Listener
from instruments.stage.driver import OwnStage, Spoken
from instruments.stage.emulator.board import StageEmulator

GREETING = WELCOME = b"\r\nGrbl 1.1h ['$' for help]\r\n"
LOCK = b"[MSG:'$H'|'$X' to unlock]\r\n"
UNLOCKED = b"[MSG:Caution: Unlocked]\r\nok\r\n"


def spoken_by(emulator: StageEmulator) -> Spoken:
    """What its driver has to speak."""
    return "marlin" if emulator.dialect.name == "Marlin" else "grbl"


class Board:
    """An emulator with the arguments of `StageEmulator` under virtual time, with nothing between:
    raw bytes out, raw bytes back. It is the emulator's connection.
    """

    def __init__(self, settings: Mapping[int, float] | None = None, **more: Any) -> None:
        self.clock = VirtualClock()
        self.emulator = StageEmulator(self.clock, settings=settings, **more)
        self.greeting = self.plug_in()

    def plug_in(self) -> bytes:
        self._said, self._said_s = b"", 0.0
        self.emulator.connect(cast(Connection, self))
        return self.hear(0.0)

    def unplug(self) -> None:
        self.emulator.disconnect(cast(Connection, self))

    def send(self, data: bytes) -> None:
        self._said += data
        self._said_s = self.clock.now()

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        self.clock.call_at(self.clock.now() + seconds, action)

    def write(self, data: bytes) -> None:
        self.emulator.receive(cast(Connection, self), data)

    def hear(self, seconds: float) -> bytes:
        """All that comes within ``seconds`` of virtual time, all of which passes."""
        self.clock.sleep(seconds)
        said, self._said = self._said, b""
        return said

    def say(self, data: bytes, seconds: float = 0.0) -> bytes:
        self.write(data)
        return self.hear(seconds)

    def lines(self, data: bytes, seconds: float) -> list[str]:
        """What it says, by line."""
        return [line for line in self.say(data, seconds).decode("ascii").split("\r\n") if line]

    def unlock(self) -> None:
        assert self.say(b"$X\n") == UNLOCKED

    def answered_at(self, data: bytes) -> float:
        """Seconds until the one answer to ``data`` comes."""
        start_s = self.clock.now()
        said = self.say(data)
        while not said:
            said = self.hear(0.05)
        assert said == b"ok\r\n"
        return self._said_s - start_s

    def state(self) -> bytes:
        return self.say(b"?")[1:].split(b"|")[0]


# a homing that takes its seconds, not its minutes: only `Board` looks at how it runs
QUICK_HOMING = {24: 1200, 25: 12000, 26: 10}


class Bench:
    """A driver for ``axes``, its emulator that homes quickly, on loopback under virtual time."""

    def __init__(
        self, settings: Mapping[int, float] | None = None, *, axes: str = "XYZ", **more: Any
    ) -> None:
        settings = QUICK_HOMING | dict(settings or {})
        self.clock = VirtualClock()
        count = 4 if "A" in axes else 3
        self.emulator = StageEmulator(self.clock, settings=settings, axes=count, **more)
        self.listener = Listener(self.emulator, self.clock, lock=threading.RLock(), name="stage")
        self.links: list[Link] = []
        self.axes = axes
        self.stage = self.plug_in()

    def link(self) -> Link:
        self.links.append(Link(self.listener.url, self.clock, who="stage"))
        return self.links[-1]

    def close(self) -> None:
        for link in self.links:
            link.close()
        self.listener.close()

    def plug_in(self) -> OwnStage:
        return OwnStage(self.link(), self.clock, self.axes, dialect=spoken_by(self.emulator))

    def again(self, *, axes: str | None = None, device: Device | None = None) -> Bench:
        """With a new driver: for other ``axes``, or with ``device`` before the board."""
        self.stage.close()
        self.axes = axes or self.axes
        self.listener._device = device or self.emulator
        self.stage = self.plug_in()
        return self

    def homed(self) -> OwnStage:
        self.stage.connect()
        self.stage.home()
        return self.stage


class Parrot:
    """A device that answers every byte stream with the same words, after a greeting."""

    def __init__(self, greeting: bytes, answers: Mapping[bytes, bytes]) -> None:
        self.greeting = greeting
        self.answers = answers

    def connect(self, connection: Connection) -> None:
        connection.send(self.greeting)

    def receive(self, connection: Connection, data: bytes) -> None:
        connection.send(self.answers.get(data, b""))

    def disconnect(self, connection: Connection) -> None: ...


def identify(device: Device, axes: str = "XY", dialect: Spoken = "grbl") -> None:
    clock = VirtualClock()
    listener = Listener(device, clock, lock=threading.RLock(), name="stage")
    link = Link(listener.url, clock, who="stage")
    try:
        OwnStage(link, clock, axes, dialect=dialect).connect()
    finally:
        link.close()
        listener.close()
