"""The emulated board on a link: raw bytes out, raw bytes back."""

from __future__ import annotations

import threading
from collections.abc import Mapping

from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.listener import Listener
from instruments.stage.emulator import CLASSIC, Dialect, StageEmulator
from instruments.stage.emulator.motion import Vector

WELCOME = b"\r\nGrbl 1.1h ['$' for help]\r\n"
LOCK = b"[MSG:'$H'|'$X' to unlock]\r\n"
UNLOCKED = b"[MSG:Caution: Unlocked]\r\nok\r\n"


class Board:
    """The emulator on a link: raw bytes out, raw bytes back."""

    def __init__(
        self,
        settings: Mapping[int, float] | None = None,
        *,
        dialect: Dialect = CLASSIC,
        axes: int = 3,
        play_mm: Vector | None = None,
        fresh_eeprom: bool = False,
    ) -> None:
        self.clock = VirtualClock()
        self.emulator = StageEmulator(
            self.clock,
            settings=settings,
            dialect=dialect,
            axes=axes,
            play_mm=play_mm,
            fresh_eeprom=fresh_eeprom,
        )
        self.listener = Listener(self.emulator, self.clock, lock=threading.RLock(), name="stage")
        self.links: list[Link] = []
        self.greeting = self.plug_in()

    def plug_in(self) -> bytes:
        self.links.append(Link(self.listener.url, self.clock, who="stage"))
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

    def hear_until_broken(self) -> None:
        """Ask every second for a minute."""
        for _ in range(60):
            self.say(b"?", 1.0)

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

    def close(self) -> None:
        for link in self.links:
            link.close()
        self.listener.close()
