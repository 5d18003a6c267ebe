"""Registers of 16 bits and the numbers they hold, in each of the four orders of bytes; and the
quantity that they show: where it is, and how it is coded. Pure.

An order is written as what becomes of the bytes ABCD of a 32-bit number, A the most significant.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from pydantic import Field

from instruments.bath.quantity import Quantity

Kind = Literal["u16", "i16", "u32", "f32", "bit"]
Order = Literal["ABCD", "CDAB", "BADC", "DCBA"]
Table = Literal["holding", "input", "coil", "discrete"]

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
    """The registers that hold ``value``, rounded to the type. Raises ValueError for no fit."""
    whole = value if kind == "f32" else round(value) if math.isfinite(value) else None
    if whole is None or not fits(whole, kind):
        raise ValueError(f"{value:g} does not fit into {kind}")
    data = struct.pack(FORMATS[kind], whole)
    return tuple(_turned(struct.unpack(f">{WORDS[kind]}H", data), order))


def _turned(registers: Sequence[int], order: Order) -> Sequence[int]:
    """Between the wire's order and ABCD; its own inverse."""
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


class Row(Quantity):
    """A quantity in registers or bits: where it is, and how it is coded.

    ``no_value`` are raw codes that stand where a number would and mean that there is none.
    """

    table: Table
    address: Annotated[int, Field(ge=0, le=0xFFFF)]
    type: Kind
    order: Order | None = None  # None: the profile's
    no_value: dict[str, int] = Field(default_factory=dict)

    @property
    def words(self) -> int:
        return WORDS[self.type]

    @property
    def end(self) -> int:
        return self.address + self.words

    @property
    def step(self) -> float:
        return 0.0 if self.type == "f32" else self.scale

    def faults(self) -> Iterator[str]:
        """What is wrong with this row alone."""
        if (self.type == "bit") != (self.table in ("coil", "discrete")):
            yield f"type {self.type} does not go into table {self.table}"
        if self.access != "r" and self.table in ("input", "discrete"):
            yield f"table {self.table} can't be written, so access must be 'r'"
        if self.end > 0x10000:
            yield f"address {self.address} leaves no room for {self.words} registers"
        yield from super().faults()
        for label, code in {**self.seen, **self.values}.items():
            if not fits(code, self.type):
                yield f"values.{label} = {code} does not fit into {self.type}"
        for label, code in self.no_value.items():
            if self.words != 1 or not 0 <= code <= 0xFFFF:
                yield f"no_value.{label} = {code} is no register of 16 bits"

    def decode(self, registers: Sequence[int], order: Order) -> float:
        """The value in ``unit``; not-a-number for a code of ``no_value``. Raises ValueError when
        the number of registers is wrong.
        """
        if self.no_value and registers[0] in self.no_value.values():
            return float("nan")
        return decode(registers, self.type, self.order or order) * self.scale

    def encode(self, value: float, order: Order) -> tuple[int, ...]:
        """The registers that say ``value``. Raises ValueError when it does not fit."""
        return encode(value / self.scale, self.type, self.order or order)
