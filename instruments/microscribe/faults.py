"""Faults of an emulated arm, its cable and its adapter, by name; repeatable with the same seed."""

from __future__ import annotations

import sys
from collections.abc import Callable
from enum import StrEnum

import numpy as np

from instruments.faults import Amounts, check_fault
from instruments.microscribe.protocol import MARK

FOREVER = sys.maxsize
_CHANCE = 2  # this stream of chance; the arm's mechanics have the others


class ArmFault(StrEnum):
    """The names that a test or a rig file gives."""

    SILENT = "silent"
    FLIPPED_BIT = "flipped bit"
    BIT_7 = "bit 7 in payload"
    LOST_BYTE = "lost byte"
    LOST_QUESTION = "lost byte to the arm"
    GARBAGE = "garbage between packets"
    OLD_SESSION = "old session alive"
    WRONG_BAUD = "wrong baud"
    LATE_ECHO = "echo after repeats"
    SURPLUS_ECHOES = "surplus echoes"
    INTERFACE_BOX = "IBOX"
    BLOCK_LENGTH = "parameter block of another length"
    POWER_LOSS = "power loss"  # until it is cleared: then the power is back
    NEVER_HOMED = "never homed"
    PEDAL_BOUNCE = "pedal bounce"
    SLOW_ADAPTER = "slow adapter"
    DISCONNECT = "disconnect"


AMOUNTS: Amounts = {
    # of a session that was left open, where the host's rate is known
    ArmFault.WRONG_BAUD: (9600, "Bd"),
    ArmFault.LATE_ECHO: (3, "the IMMC that is echoed first"),
    ArmFault.NEVER_HOMED: (1000, "counts off a joint's peg at power-up, at most"),
    ArmFault.PEDAL_BOUNCE: (0.02, "s that a contact takes to settle"),
    ArmFault.SLOW_ADAPTER: (0.016, "s that each answer is held back"),
    ArmFault.DISCONNECT: (0, "bytes for the host that still pass"),
}


class Faults:
    """The active faults: ``left``, how often each still strikes. ``changed``: at each change."""

    def __init__(
        self, seed: int, changed: Callable[[ArmFault, bool], None] = lambda _fault, _on: None
    ) -> None:
        self._seed = seed
        self._changed = changed
        self.left: dict[ArmFault, int] = {}
        self._spared: dict[ArmFault, int] = {}
        self._amounts = {fault: usual for fault, (usual, _) in AMOUNTS.items()}
        self._hits = 0

    def inject(
        self,
        fault: ArmFault | str,
        times: int = FOREVER,
        *,
        amount: float | None = None,
        after: int = 0,
    ) -> None:
        """Start a fault for ``times`` times, after sparing ``after`` chances; ``amount`` in the
        unit of `AMOUNTS`. Raises ValueError.
        """
        check_fault("an arm has", fault, tuple(ArmFault), AMOUNTS, amount)
        known = ArmFault(fault)
        if known in AMOUNTS:
            self._amounts[known] = AMOUNTS[known][0] if amount is None else amount
        self.left[known], self._spared[known] = times, after
        self._changed(known, True)

    def clear(self, fault: ArmFault | str) -> None:
        """End a fault, whether it was on or not. Raises ValueError for a name that isn't one."""
        check_fault("an arm has", fault, tuple(ArmFault), AMOUNTS)
        known = ArmFault(fault)
        if self.left.pop(known, None) is not None:
            self._changed(known, False)

    def on(self, fault: ArmFault) -> bool:
        """Whether the fault would strike; none of its times is used up."""
        return self.left.get(fault, 0) > 0

    def strikes(self, fault: ArmFault) -> bool:
        """Whether the fault happens now; one of its times is used up."""
        if self.left.get(fault, 0) <= 0:
            return False
        if self._spared[fault] > 0:
            self._spared[fault] -= 1
            return False
        self.left[fault] -= 1
        return True

    def amount(self, fault: ArmFault) -> float:
        """How much of it, in the unit of `AMOUNTS`."""
        return self._amounts[fault]

    def amount_now(self, fault: ArmFault) -> float:
        """As ``amount`` where the fault happens now, as by ``strikes``; else 0."""
        return self._amounts[fault] if self.left and self.strikes(fault) else 0.0

    def damage(self, answer: bytes) -> bytes:
        """One answer as the host gets it; the place is chance, the first byte is only ever lost."""
        if not self.left or not answer:
            return answer
        chance = self._chance()
        data = bytearray(answer)
        at = int(chance.integers(min(1, len(data) - 1), len(data)))
        bit, lost = int(chance.integers(0, 7)), int(chance.integers(0, len(data)))
        if self.strikes(ArmFault.FLIPPED_BIT):
            data[at] ^= 1 << bit
        if self.strikes(ArmFault.BIT_7):
            data[at] |= MARK
        if self.strikes(ArmFault.LOST_BYTE):
            del data[lost]
        garbage = self.noise(5) if self.strikes(ArmFault.GARBAGE) else b""
        return garbage + bytes(data)

    def lose_byte(self, question: bytes) -> bytes:
        """``question``, not empty; without one of its bytes where that fault strikes."""
        if not self.left or not self.strikes(ArmFault.LOST_QUESTION):
            return question
        lost = int(self._chance().integers(0, len(question)))
        return question[:lost] + question[lost + 1 :]

    def noise(self, count: int) -> bytes:
        """Bytes that mean nothing."""
        return bytes(self._chance().integers(0, 256, count, dtype=np.uint8))

    def cut(self, data: bytes) -> tuple[bytes, bool]:
        """As much of ``data`` as passes, and whether the cable breaks behind it."""
        if not self.left or not self.on(ArmFault.DISCONNECT) or not data:
            return data, False
        passes = self._amounts[ArmFault.DISCONNECT]
        if len(data) <= passes:
            self._amounts[ArmFault.DISCONNECT] = passes - len(data)
            return data, False
        self.clear(ArmFault.DISCONNECT)
        return data[: int(passes)], True

    def displacement(self, joints: int) -> list[int]:
        """Counts that each joint is off its peg at a power-up without homing: none near 0."""
        most = int(self._amounts[ArmFault.NEVER_HOMED])
        sizes = self._chance().integers(most // 2, most + 1, joints)
        return [int(size) if joint % 2 else -int(size) for joint, size in enumerate(sizes)]

    def _chance(self) -> np.random.Generator:
        self._hits += 1
        return np.random.default_rng([self._seed, _CHANCE, self._hits])
