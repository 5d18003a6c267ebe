"""A driver, its emulator and their clock; and devices that only pretend to be a stage."""

from __future__ import annotations

import threading
from collections.abc import Mapping

from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.listener import Connection, Device, Listener
from instruments.stage.driver import Stage
from instruments.stage.emulator import CLASSIC, Dialect, StageEmulator
from instruments.stage.emulator.motion import Vector

GREETING = b"\r\nGrbl 1.1h ['$' for help]\r\n"


class Bench:
    """A driver, its emulator, and their clock."""

    def __init__(
        self,
        settings: Mapping[int, float] | None = None,
        *,
        dialect: Dialect = CLASSIC,
        axes: str = "XYZ",
        play_mm: Vector | None = None,
        fresh_eeprom: bool = False,
    ) -> None:
        self.clock = VirtualClock()
        self.axes = axes
        count = 4 if "A" in axes else 3
        self.emulator = StageEmulator(
            self.clock,
            settings=settings,
            dialect=dialect,
            axes=count,
            play_mm=play_mm,
            fresh_eeprom=fresh_eeprom,
        )
        self.listener = Listener(self.emulator, self.clock, lock=threading.RLock(), name="stage")
        self.stage = self.plug_in()

    def plug_in(self) -> Stage:
        return Stage(Link(self.listener.url, self.clock, who="stage"), self.clock, self.axes)

    def homed(self) -> Stage:
        self.stage.connect()
        self.stage.home()
        return self.stage

    def close(self) -> None:
        self.stage.close()
        self.listener.close()


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


def meet(device: Device, axes: str = "XY") -> None:
    clock = VirtualClock()
    listener = Listener(device, clock, lock=threading.RLock(), name="stage")
    link = Link(listener.url, clock, who="stage")
    try:
        Stage(link, clock, axes).connect()
    finally:
        link.close()
        listener.close()
