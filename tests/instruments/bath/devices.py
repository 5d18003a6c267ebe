"""What the bath's tests share: an emulated device asked by the byte, with nothing between; an
emulated bath on loopback that notes its requests; a clock that notices a hang.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from instruments.bath.driver import OwnBath
from instruments.bath.emulator import BathEmulator, Framing, Server
from instruments.bath.profile import (
    LineProfile,
    Profile,
    RegisterProfile,
    load_profile,
    profile_names,
)
from instruments.bath.protocol import framed
from instruments.clock import Clock, VirtualClock
from instruments.listener import Connection, Device, Listener
from instruments.world.plant import Plant, PlantConstants

EUROTHERMS = ["eurotherm-2400", "eurotherm-3200"]
WATLOWS = ["watlow-pm-map1", "watlow-pm-map2"]
OMEGA = "omega-cn7"
REGISTER_FAMILIES = [
    name for name in profile_names() if isinstance(load_profile(name), RegisterProfile)
]
NO_PUMP = [*EUROTHERMS, *WATLOWS, OMEGA]
MOST_LOOKS = 10_000  # at one moment of virtual time


def load_register_profile(name_or_path: str | Path) -> RegisterProfile:
    """As `load_profile`, of a family that speaks Modbus."""
    profile = load_profile(name_or_path)
    assert isinstance(profile, RegisterProfile)
    return profile


def calm_plant() -> Plant:
    """At 20 degC and without noise."""
    return Plant(1, constants=PlantConstants(sensor_noise_k=0.0))


def url_of(device: Server, listener: Listener) -> str:
    return f"{'tcp' if device.framing == 'tcp' else 'rtu+tcp'}://127.0.0.1:{listener.port}"


class LineDevice:
    """What is asked by lines that end with ``end``; `take` gets each without that."""

    end = b"\r"
    _rest = b""

    def connect(self, connection: Connection) -> None:
        self._rest = b""

    def disconnect(self, connection: Connection) -> None: ...

    def receive(self, connection: Connection, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(self.end)
        for line in lines:
            self.take(connection, line)

    def take(self, connection: Connection, line: bytes) -> None:
        raise NotImplementedError


@contextmanager
def driven(
    device: Device, profile: Profile, clock: Clock, *, query: str = "", **options: Any
) -> Iterator[OwnBath]:
    """A driver on ``device`` (lines, or Modbus RTU) at a port of loopback; options of `OwnBath`."""
    scheme = "tcp" if isinstance(profile, LineProfile) else "rtu+tcp"
    with closing(Listener(device, clock, lock=threading.RLock(), name="bath")) as listener:
        url = f"{scheme}://127.0.0.1:{listener.port}{query}"
        with closing(OwnBath(url, profile, clock, **options)) as bath:
            yield bath


class Sink:
    """Keeps what a device sends; ``open`` until it hangs up."""

    def __init__(self) -> None:
        self.got = b""
        self.open = True

    def write(self, data: bytes) -> None:
        self.got += data

    def hang_up(self) -> None:
        self.open = False

    def baud(self) -> int | None:
        return None


class Wire:
    """One host of ``device``, by the byte."""

    def __init__(self, device: Server, clock: VirtualClock) -> None:
        self.device = device
        self.clock = clock
        self.sink = Sink()
        self.connection = Connection(self.sink, clock, threading.RLock())
        device.connect(self.connection)

    def send(self, data: bytes) -> bytes:
        """What comes back at once, after a moment of silence."""
        self.clock.sleep(0.1)
        self.sink.got = b""
        self.device.receive(self.connection, data)
        return self.sink.got


class Asked:
    """A controller on an RTU line. ``ask`` gives the PDU answered, in hex; "" for silence."""

    def __init__(self, profile: str, *, framing: Framing = "rtu") -> None:
        self.clock, self.plant = VirtualClock(), calm_plant()
        family = load_register_profile(profile)
        self.emulator = BathEmulator(self.plant, family, self.clock, unit_id=1, framing=framing)
        self.wire = Wire(self.emulator, self.clock)

    def ask(self, pdu: str, *, unit: int = 1) -> str:
        answer = self.wire.send(framed(unit, bytes.fromhex(pdu)))
        assert not answer or answer == framed(1, answer[1:-2])
        return answer[1:-2].hex(" ").upper()

    def talk(self, turns: str) -> None:
        """Each ``request > answer`` of a line has its answer; without one, any."""
        for turn in turns.strip().split("\n"):
            request, asks, answer = turn.partition("#")[0].partition(">")
            said = self.ask(request)
            assert not asks or said == answer.strip(), turn

    def break_for(self, seconds: float, fault: str) -> None:
        """Break something, and let time pass."""
        self.emulator.fault(fault)
        self.clock.sleep(seconds)

    def ask_tcp(self, frames: str) -> str:
        """Whole frames over a fresh connection; hex of what comes back."""
        return Wire(self.emulator, self.clock).send(bytes.fromhex(frames)).hex(" ").upper()

    def word(self, address: int) -> int:
        """One holding register."""
        return int(self.ask(f"03 {address:04X} 0001")[6:].replace(" ", ""), 16)

    def float(self, address: int, *, low_first: bool = False) -> float:
        words = bytes.fromhex(self.ask(f"03 {address:04X} 0002")[6:])
        value: float = struct.unpack(">f", words[2:] + words[:2] if low_first else words)[0]
        return value


class Watched(BathEmulator):
    """Notes who is connected, and function, address and time of every request."""

    def __init__(
        self, plant: Plant, profile: RegisterProfile, clock: Clock, framing: Framing | None = None
    ) -> None:
        super().__init__(plant, profile, clock, framing=framing)
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
        address = int.from_bytes(data[at + 1 : at + 3], "big")
        self.asked.append((self.clock.now(), data[at], address))
        super().receive(connection, data)

    def writes(self) -> list[tuple[float, int]]:
        return [(when, address) for when, function, address in self.asked if function in (5, 6, 16)]

    def pull_the_cable(self) -> None:
        for connection in list(self.hosts):
            connection.hang_up()

    def runs(self) -> bool:
        return self.plant.running


@dataclass
class Stand:
    """A watched bath on loopback, and the drivers that were opened on it."""

    clock: VirtualClock = field(default_factory=VirtualClock)
    plant: Plant = field(default_factory=calm_plant)
    profile: RegisterProfile = field(default_factory=lambda: load_register_profile("julabo-presto"))

    def __post_init__(self) -> None:
        self.emulator = Watched(self.plant, self.profile, self.clock)
        self.listener = Listener(self.emulator, self.clock, lock=threading.RLock(), name="bath")
        self.url = url_of(self.emulator, self.listener)
        self._opened: list[OwnBath] = []

    def bath(self, **options: Any) -> OwnBath:
        """A driver on it, with the options of `OwnBath`; a person has confirmed its unit."""
        options.setdefault("unit_confirmed", True)
        self._opened.append(OwnBath(self.url, self.profile, self.clock, **options))
        return self._opened[-1]

    def __enter__(self) -> Stand:
        return self

    def __exit__(self, *_: object) -> None:
        for bath in self._opened:
            bath.close()
        self.listener.close()


class MovingClock(VirtualClock):
    """Virtual time that raises when somebody waits for it and does not let it move."""

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
