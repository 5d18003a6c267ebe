"""What a rule machine needs of a bath: a clock that tells when it stands still, and a cable that
can be pulled.
"""

from __future__ import annotations

from instruments.bath.emulator import BathEmulator, Framing
from instruments.bath.profile import load_profile
from instruments.clock import VirtualClock
from instruments.listener import Connection
from instruments.world.plant import Plant

MOST_LOOKS = 10_000  # at one moment of virtual time
SCHEMES: dict[Framing, str] = {"tcp": "tcp", "rtu": "rtu+tcp"}


class MovingClock(VirtualClock):
    """Virtual time that notices when somebody waits for it and does not let it move: a hang, told
    at once.
    """

    def __init__(self) -> None:
        super().__init__()
        self._seen_s, self._looks = -1.0, 0

    def now(self) -> float:
        now_s = super().now()
        self._looks = self._looks + 1 if now_s == self._seen_s else 0
        self._seen_s = now_s
        if self._looks > MOST_LOOKS:
            self._looks = 0
            raise AssertionError(f"virtual time stands still at {now_s!r}")
        return now_s


class Cable(BathEmulator):
    """Knows who is connected, to pull the cable."""

    def __init__(self, plant: Plant, name: str, clock: VirtualClock) -> None:
        super().__init__(plant, load_profile(name), clock)
        self.hosts: set[Connection] = set()

    def connect(self, connection: Connection) -> None:
        super().connect(connection)
        self.hosts.add(connection)

    def disconnect(self, connection: Connection) -> None:
        super().disconnect(connection)
        self.hosts.discard(connection)
