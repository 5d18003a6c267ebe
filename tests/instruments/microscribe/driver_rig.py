"""One emulated arm on loopback under virtual time, in a hand, with an ear on its wire and a cable
that can be pulled.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable

import numpy as np

from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.listener import Connection, Listener
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.kinematics import Floats
from instruments.microscribe.unit import UNIT_40937, ArmIdentity

POINT = np.array([-180.0, 240.0, 130.0])
UP = np.array([0.0, 0.0, 1.0])
MAKERS_ORDER = bytes.fromhex("C8 C9 CA CB CC CD CE C6 C0 D3")


class Hand:
    """Holds the tip at ``point`` with the stylus upright, or leaves it on its peg; ``drift`` mm
    along x a second.
    """

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.point: Floats | None = None
        self.drift = 0.0

    def arm_target(self) -> tuple[Floats, Floats] | None:
        if self.point is None:
            return None
        return self.point + np.array([self.drift * self.clock.now(), 0.0, 0.0]), UP


class HeartbeatReader:
    """Notes what the emulator hears; ``late_s`` holds the next bytes up for so long, once.

    ``spoil`` makes of what the arm sends the pieces that the host gets.
    """

    def __init__(self, arm: ArmEmulator) -> None:
        self.arm = arm
        self.heard = b""
        self.late_s = 0.0
        self.lose: set[int] = set()  # which of the next bytes never arrive, counted from 0
        self.hosts: list[Connection] = []
        self.spoil: Callable[[bytes], list[bytes]] = lambda data: [data]

    def connect(self, connection: Connection) -> None:
        self.hosts.append(connection)
        send = connection.send

        def send_spoilt(data: bytes) -> None:
            for piece in self.spoil(data):
                send(piece)

        connection.send = send_spoilt  # type: ignore[method-assign]
        self.arm.connect(connection)

    def receive(self, connection: Connection, data: bytes) -> None:
        self.heard += data
        arriving = bytes(byte for at, byte in enumerate(data) if at not in self.lose)
        self.lose = {at - len(data) for at in self.lose if at >= len(data)}
        late_s, self.late_s = self.late_s, 0.0
        if late_s:
            connection.after(late_s, lambda: self.arm.receive(connection, arriving))
        else:
            self.arm.receive(connection, arriving)

    def disconnect(self, connection: Connection) -> None:
        self.arm.disconnect(connection)


class Rig:
    """One emulated arm, plugged in."""

    def __init__(
        self, unit: ArmIdentity = UNIT_40937, *, echo_after: int = 1, accuracy_mm: float = 0.23
    ) -> None:
        self.clock = VirtualClock()
        self.hand = Hand(self.clock)
        self.arm = ArmEmulator(
            self.hand, self.clock, unit=unit, seed=5, echo_after=echo_after, accuracy_mm=accuracy_mm
        )
        self.ear = HeartbeatReader(self.arm)
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
        self.ear.arm = arm or self.arm
        self.listener = Listener(self.ear, self.clock, lock=self.lock, name="arm", port=port)

    def close(self) -> None:
        for driver in self.drivers:
            driver.close()
        self.listener.close()


def renamed(**names: str) -> ArmIdentity:
    return dataclasses.replace(UNIT_40937, names=dataclasses.replace(UNIT_40937.names, **names))
