"""Emulated arms under virtual time: with a driver on loopback, with a host that sends hexadecimal,
and far ends that are no emulator.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from instruments.clock import Clock, VirtualClock
from instruments.link import Link
from instruments.listener import Connection, Device, Listener
from instruments.microscribe.driver import ANSWER_S, MicroScribe
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.kinematics import Floats
from instruments.microscribe.protocol import Packet, PacketDecoder
from instruments.microscribe.unit import ArmIdentity, shipped_unit

UNIT = shipped_unit("40937")
# replies of the sheet by code
REPLIES = {
    0xC8: b"\xc8MicroScribe3D\0",
    0xC9: b"\xc9MSCR\0",
    0xCA: b"\xcaDX\0",
    0xCB: b"\xcb40937\0",
    0xCC: b"\xccStandard+Beta\0",
    0xCD: b"\xcdFormat DH0.5\0",
    0xCE: b"\xceHCI 2.0\0",
    0xC6: bytes.fromhex("C6 03 3FFF 00 00 00 00 00 00 00 00 00 3FFF 3FFF 1FFF 0FFF 0FFF 0000"),
    0xC0: bytes.fromhex(
        "C0 24 0000 3FF5 FFF9 3FE5 C002 C00C 0000 03C0 2810 0215 FE6F 018F 206C FC92 FFFD 241C 0140"
        " EB66"
    ),
    0xD3: bytes.fromhex("D3 02 0003"),
}
AT_REST = "83 00 6C 4F 30 5E 35 54 20 02 18 79 41 60"
POINT = np.array([-180.0, 240.0, 130.0])
UP = np.array([0.0, 0.0, 1.0])


def renamed(**names: str) -> ArmIdentity:
    return dataclasses.replace(UNIT, names=dataclasses.replace(UNIT.names, **names))


class Hand:
    """Holds the tip at ``point``, stylus upright, or leaves it; ``drift`` mm along x a second."""

    def __init__(self, clock: Clock, point: Floats | None = None) -> None:
        self.clock = clock
        self.point = point
        self.drift = 0.0

    def arm_target(self) -> tuple[Floats, Floats] | None:
        if self.point is None:
            return None
        return self.point + np.array([self.drift * self.clock.now(), 0.0, 0.0]), UP


class Ear:
    """A cable to a device: notes what is sent to it. ``late_s`` holds the next bytes up for so
    long, once; the bytes numbered ``lose`` never arrive; ``spoil`` makes of what the device sends
    the pieces that the host gets.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.heard = b""
        self.late_s = 0.0
        self.lose: set[int] = set()
        self.hosts: list[Connection] = []
        self.spoil: Callable[[bytes], list[bytes]] = lambda data: [data]

    def connect(self, connection: Connection) -> None:
        self.hosts.append(connection)
        send = connection.send

        def send_spoilt(data: bytes) -> None:
            for piece in self.spoil(data):
                send(piece)

        connection.send = send_spoilt  # type: ignore[method-assign]
        self.device.connect(connection)

    def receive(self, connection: Connection, data: bytes) -> None:
        self.heard += data
        arriving = bytes(byte for at, byte in enumerate(data) if at not in self.lose)
        self.lose = {at - len(data) for at in self.lose if at >= len(data)}
        late_s, self.late_s = self.late_s, 0.0
        if late_s:
            connection.after(late_s, lambda: self.device.receive(connection, arriving))
        else:
            self.device.receive(connection, arriving)

    def disconnect(self, connection: Connection) -> None:
        self.device.disconnect(connection)


class Rig:
    """One emulated arm, plugged in, and its drivers."""

    def __init__(self, unit: ArmIdentity = UNIT, **options: float) -> None:
        self.clock = VirtualClock()
        self.hand = Hand(self.clock)
        self.arm = ArmEmulator(self.hand, self.clock, unit=unit, seed=5, **options)
        self.ear = Ear(self.arm)
        self.lock = threading.RLock()
        self.listener = Listener(self.ear, self.clock, lock=self.lock, name="arm")
        self.drivers: list[MicroScribe] = []

    def driver(self) -> MicroScribe:
        self.drivers.append(MicroScribe(Link(self.listener.url, self.clock, who="arm"), self.clock))
        return self.drivers[-1]

    def signed_on(self) -> MicroScribe:
        driver = self.driver()
        driver.sign_on()
        driver.confirm_homed()
        return driver

    def unplug(self) -> int:
        """Pull the cable; gives back the TCP port for when it is plugged in again."""
        self.listener.close()
        return self.listener.port

    def plug_in(self, port: int, arm: ArmEmulator | None = None) -> None:
        """The same port is there again, with the same arm or another at its end."""
        self.ear.device = arm or self.arm
        self.listener = Listener(self.ear, self.clock, lock=self.lock, name="arm", port=port)

    def close(self) -> None:
        for driver in self.drivers:
            driver.close()
        self.listener.close()


class Host(Rig):
    """Sends hexadecimal to an emulated arm, and gives back what comes within 50 ms."""

    def __init__(self, unit: ArmIdentity = UNIT, **options: float) -> None:
        super().__init__(unit, **options)
        self.link = Link(self.listener.url, self.clock, who="host")

    def ask(self, sent: str, wait_s: float = 0.05) -> str:
        self.link.write(bytes.fromhex(sent))
        return self.link.read(100_000, wait_s).hex(" ").upper()

    def session(self) -> None:
        assert self.ask("C5 49 4D 4D 43") == "49 4D 4D 43"
        assert self.ask("42 45 47 49 4E") == "4D 53 43 52 00"

    def packets(self, sent: str, wait_s: float = 0.05) -> list[Packet]:
        return PacketDecoder().feed(bytes.fromhex(self.ask(sent, wait_s)))

    def counts(self) -> tuple[int, ...]:
        return self.packets("03")[0].counts

    def plug_in_again(self) -> None:
        self.link.close()
        self.link = Link(self.listener.url, self.clock, who="host")

    def close(self) -> None:
        self.link.close()
        super().close()


class Parrot:
    """Sends back what it hears, as a loop-back plug does, after ``change``."""

    def __init__(self, change: Callable[[bytes], bytes]) -> None:
        self.change = change

    def connect(self, connection: Connection) -> None: ...

    def receive(self, connection: Connection, data: bytes) -> None:
        connection.send(self.change(data))

    def disconnect(self, connection: Connection) -> None: ...


def ghost(answer: Callable[[int], bytes]) -> Parrot:
    """An arm as far as its words go, whose answers are what ``answer`` makes of a command byte."""

    def change(data: bytes) -> bytes:
        if data.endswith(b"IMMC"):
            return b"IMMC"
        return b"MSCR\0" if data == b"BEGIN" else b"".join(map(answer, data))

    return Parrot(change)


@contextmanager
def driver_of(
    device: Device, *, rates: tuple[int, ...] | None = None, answer_s: float = ANSWER_S
) -> Iterator[MicroScribe]:
    """A driver on a device of any kind."""
    clock = VirtualClock()
    listener = Listener(device, clock, lock=threading.RLock(), name="ghost")
    link = Link(listener.url, clock, who="arm")
    driver = MicroScribe(link, clock, rates=rates, answer_s=answer_s)
    try:
        yield driver
    finally:
        driver.close()
        listener.close()
