"""Registers of 16 bits and the numbers they hold, in each of the four orders of bytes.

An order is written as what becomes of the bytes ABCD of a 32-bit number, A the most significant. Pure.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Literal

Kind = Literal["u16", "i16", "u32", "f32", "bit"]
Order = Literal["ABCD", "CDAB", "BADC", "DCBA"]

WORDS: dict[Kind, int] = {"u16": 1, "i16": 1, "u32": 2, "f32": 2, "bit": 1}
FORMATS: dict[Kind, str] = {"u16": ">H", "i16": ">h", "u32": ">I", "f32": ">f", "bit": ">H"}


def decode(registers: Sequence[int], kind: Kind, order: Order) -> float:
    """The number in ``registers``. Raises ValueError when there are too many or too few."""
    if len(registers) != WORDS[kind]:
        raise ValueError(f"{kind} takes {WORDS[kind]} registers, not {len(registers)}")
    data = struct.pack(f">{len(registers)}H", *_turned(registers, order))
    value: float = struct.unpack(FORMATS[kind], data)[0]
    return value


def encode(value: float, kind: Kind, order: Order) -> tuple[int, ...]:
    """The registers that hold ``value``, rounded to the type. Raises ValueError when it does not fit."""
    whole = value if kind == "f32" else round(value) if math.isfinite(value) else None
    if whole is None or not fits(whole, kind):
        raise ValueError(f"{value:g} does not fit into {kind}")
    data = struct.pack(FORMATS[kind], whole)
    return tuple(_turned(struct.unpack(f">{WORDS[kind]}H", data), order))


def _turned(registers: Sequence[int], order: Order) -> Sequence[int]:
    """Between the wire's order and ABCD; its own inverse. BADC and DCBA swap the bytes of single registers too."""
    if order in ("CDAB", "DCBA"):
        registers = registers[::-1]
    if order in ("BADC", "DCBA"):
        registers = [(word & 0xFF) << 8 | word >> 8 for word in registers]
    return registers


def fits(value: float, kind: Kind) -> bool:
    """Whether ``value`` can be held; a float in a whole-number type can't."""
    if kind == "bit":
        return value in (0, 1)
    try:
        struct.pack(FORMATS[kind], value)
    except (struct.error, OverflowError):
        return False
    return True
