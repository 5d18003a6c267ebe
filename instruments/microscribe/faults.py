"""What can be wrong with an emulated arm and its cable, each by name. It may not know the session."""

from __future__ import annotations

import sys
from enum import StrEnum

import numpy as np

from instruments.microscribe.protocol import MARK

FOREVER = sys.maxsize
_CHANCE = 2  # this stream of chance; the arm's mechanics have the others


class Fault(StrEnum):
    """The names that a test or a rig file gives."""

    SILENT = "silent"
    FLIPPED_BIT = "flipped bit"
    BIT_7 = "bit 7 in payload"
    LOST_BYTE = "lost byte"
    GARBAGE = "garbage between packets"
    OLD_SESSION = "old session alive"
    SURPLUS_ECHOES = "surplus echoes"
    INTERFACE_BOX = "IBOX"
    BLOCK_LENGTH = "parameter block of another length"


class Faults:
    """The faults that are on, and how often each will still strike."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._left: dict[Fault, int] = {}

    def inject(self, fault: Fault | str, times: int = FOREVER) -> None:
        """Let a fault strike the next ``times`` it can. Raises ValueError for a name that isn't one."""
        self._left[_named(fault)] = times

    def clear(self, fault: Fault | str) -> None:
        """End a fault, whether it was on or not. Raises ValueError for a name that isn't one."""
        self._left.pop(_named(fault), None)

    def strikes(self, fault: Fault) -> bool:
        """Whether the fault happens now; one of its times is used up."""
        left = self._left.get(fault, 0)
        if left > 0:
            self._left[fault] = left - 1
        return left > 0

    def damage(self, packet: bytes, number: int) -> bytes:
        """The packet as it comes over the wire: where it is hit follows from the seed and its number."""
        if not self._left:
            return packet
        chance = np.random.default_rng([self._seed, _CHANCE, number])
        data = bytearray(packet)
        at, bit, lost = int(chance.integers(1, len(data))), int(chance.integers(0, 7)), int(chance.integers(0, len(data)))
        if self.strikes(Fault.FLIPPED_BIT):
            data[at] ^= 1 << bit
        if self.strikes(Fault.BIT_7):
            data[at] |= MARK
        if self.strikes(Fault.LOST_BYTE):
            del data[lost]
        garbage = bytes(chance.integers(0, 256, 5, dtype=np.uint8)) if self.strikes(Fault.GARBAGE) else b""
        return garbage + bytes(data)


def _named(fault: Fault | str) -> Fault:
    try:
        return Fault(fault)
    except ValueError:
        raise ValueError(f"an arm has no fault {str(fault)!r}; it has: {', '.join(Fault)}") from None
