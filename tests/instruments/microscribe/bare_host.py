"""A host that sends hexadecimal to an emulated arm over loopback under virtual time, and shows what
comes.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np

from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.listener import Listener
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.firmware import UnspecifiedBehaviour
from instruments.microscribe.kinematics import Floats
from instruments.microscribe.protocol import Packet, PacketDecoder
from instruments.microscribe.unit import ArmIdentity

AT_REST = "83 00 6C 4F 30 5E 35 54 20 02 18 79 41 60"
POINT = np.array([-180.0, 240.0, 130.0])
UP = np.array([0.0, 0.0, 1.0])


@dataclass
class Hand:
    """Holds the tip at ``point`` with the stylus upright, or leaves it on its peg."""

    point: Floats | None = None

    def arm_target(self) -> tuple[Floats, Floats] | None:
        return None if self.point is None else (self.point, UP)


class Host:
    """Sends hexadecimal, and gives back what comes within 50 ms."""

    def __init__(
        self,
        *,
        unit: ArmIdentity | None = None,
        habits: UnspecifiedBehaviour | None = None,
        tremor_mm: float = 0.05,
    ) -> None:
        self.clock = VirtualClock()
        self.hand = Hand()
        self.arm = ArmEmulator(self.hand, self.clock, unit=unit, habits=habits, tremor_mm=tremor_mm)
        self.listener = Listener(self.arm, self.clock, lock=threading.RLock(), name="arm")
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
        self.listener.close()
