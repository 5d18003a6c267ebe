"""An emulated bath on loopback under virtual time, that notes what it is asked."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

from instruments.bath.driver import Bath
from instruments.bath.emulator import BathEmulator
from instruments.bath.profile import Profile, load_profile
from instruments.clock import Clock, VirtualClock
from instruments.listener import Connection, Listener
from instruments.world.plant import Plant, PlantConstants


class Watched(BathEmulator):
    """Notes the function and address of every request, and when it came."""

    def __init__(self, plant: Plant, profile: Profile, clock: Clock) -> None:
        super().__init__(plant, profile, clock)
        self.clock = clock
        self.asked: list[tuple[float, int, int]] = []
        self.hosts: set[Connection] = set()

    def connect(self, connection: Connection) -> None:
        super().connect(connection)
        self.hosts.add(connection)

    def disconnect(self, connection: Connection) -> None:
        super().disconnect(connection)
        self.hosts.discard(connection)

    def receive(self, connection: Connection, data: bytes) -> None:
        at = 7 if self.framing == "tcp" else 1
        self.asked.append(
            (self.clock.now(), data[at], int.from_bytes(data[at + 1 : at + 3], "big"))
        )
        super().receive(connection, data)

    def writes(self) -> list[tuple[float, int]]:
        return [(when, address) for when, function, address in self.asked if function in (5, 6, 16)]


@dataclass
class Stand:
    clock: VirtualClock = field(default_factory=VirtualClock)
    plant: Plant = field(
        default_factory=lambda: Plant(1, constants=PlantConstants(sensor_noise_k=0.0))
    )
    profile: Profile = field(default_factory=lambda: load_profile("julabo-presto"))

    def __post_init__(self) -> None:
        self.emulator = Watched(self.plant, self.profile, self.clock)
        self.listener = Listener(self.emulator, self.clock, lock=threading.RLock(), name="bath")
        self.url = f"{'tcp' if self.emulator.framing == 'tcp' else 'rtu+tcp'}://127.0.0.1:{self.listener.port}"
        self._opened: list[Bath] = []

    def bath(self, *, allow_inferred: bool = False, identify: bool = True) -> Bath:
        self._opened.append(
            Bath(
                self.url, self.profile, self.clock, allow_inferred=allow_inferred, identify=identify
            )
        )
        return self._opened[-1]

    def edited(self, row: str, **changes: object) -> None:
        """The profile with one row changed, on the driver's side only."""
        rows = tuple(
            known.model_copy(update=changes) if known.name == row else known
            for known in self.profile.rows
        )
        self.profile = self.profile.model_copy(update={"rows": rows})

    def close(self) -> None:
        for bath in self._opened:
            bath.close()
        self.listener.close()
