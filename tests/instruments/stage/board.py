"""The emulated stage on a link: with raw bytes out and back, or with its driver; and devices that
only pretend to be a stage.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any, cast

from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.listener import Connection, Device, Listener
from instruments.stage.driver import Spoken, Stage
from instruments.stage.emulator.board import StageEmulator
from instruments.stage.zaber import Motor

GREETING = WELCOME = b"\r\nGrbl 1.1h ['$' for help]\r\n"
LOCK = b"[MSG:'$H'|'$X' to unlock]\r\n"
UNLOCKED = b"[MSG:Caution: Unlocked]\r\nok\r\n"


def spoken_by(emulator: StageEmulator) -> Spoken:
    """What its driver has to speak."""
    name = emulator.dialect.name
    return cast(Spoken, name.lower() if name in ("Marlin", "Zaber") else "grbl")


def motors_of(axes: str) -> list[Motor]:
    """The emulated Zaber devices of a stage."""
    return [Motor(1 + "XYZA".index(axis), 1, 100.0 if axis == "A" else 250.0) for axis in axes]


class OnLink:
    """An emulator with the arguments of `StageEmulator`, on loopback under virtual time."""

    def __init__(self, settings: Mapping[int, float] | None = None, **more: Any) -> None:
        self.clock = VirtualClock()
        self.emulator = StageEmulator(self.clock, settings=settings, **more)
        self.listener = Listener(self.emulator, self.clock, lock=threading.RLock(), name="stage")
        self.links: list[Link] = []

    def link(self) -> Link:
        self.links.append(Link(self.listener.url, self.clock, who="stage"))
        return self.links[-1]

    def close(self) -> None:
        for link in self.links:
            link.close()
        self.listener.close()


class Board(OnLink):
    """Raw bytes out, raw bytes back."""

    def __init__(self, settings: Mapping[int, float] | None = None, **more: Any) -> None:
        super().__init__(settings, **more)
        self.greeting = self.plug_in()

    def plug_in(self) -> bytes:
        self.link()
        return self.hear(0.0)

    def hear(self, seconds: float) -> bytes:
        """All that comes within ``seconds`` of virtual time, all of which passes."""
        until, got = self.clock.now() + seconds, b""
        while data := self.links[-1].receive(max(0.0, until - self.clock.now())):
            got += data
        return got

    def say(self, data: bytes, seconds: float = 0.0) -> bytes:
        self.links[-1].write(data)
        return self.hear(seconds)

    def unlock(self) -> None:
        assert self.say(b"$X\n") == UNLOCKED

    def answered_at(self, data: bytes) -> float:
        """Seconds until the one answer to ``data`` comes."""
        start = self.clock.now()
        self.links[-1].write(data)
        assert self.links[-1].read_until(b"ok\r\n", 3600) == b"ok\r\n"
        return self.clock.now() - start

    def state(self) -> bytes:
        return self.say(b"?")[1:].split(b"|")[0]


# a homing that takes its seconds, not its minutes: only `Board` looks at how it runs
QUICK_HOMING = {24: 1200, 25: 12000, 26: 10}


class Bench(OnLink):
    """A driver for ``axes``, its emulator that homes quickly, and their clock."""

    def __init__(
        self, settings: Mapping[int, float] | None = None, *, axes: str = "XYZ", **more: Any
    ) -> None:
        settings = QUICK_HOMING | dict(settings or {})
        super().__init__(settings, axes=4 if "A" in axes else 3, **more)
        self.axes = axes
        self.stage = self.plug_in()

    def plug_in(self) -> Stage:
        return Stage(
            self.link(),
            self.clock,
            self.axes,
            dialect=spoken_by(self.emulator),
            motors=motors_of(self.axes),
        )

    def again(self, *, axes: str | None = None, device: Device | None = None) -> Bench:
        """With a new driver: for other ``axes``, or with ``device`` before the board."""
        self.stage.close()
        self.axes = axes or self.axes
        self.listener._device = device or self.emulator
        self.stage = self.plug_in()
        return self

    def homed(self) -> Stage:
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
        Stage(link, clock, axes, dialect=dialect, motors=motors_of(axes)).connect()
    finally:
        link.close()
        listener.close()
