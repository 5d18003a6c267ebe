"""Registers of 16 bits and the numbers they hold, in each of the four orders of bytes; and one
quantity of a device: where it is, how it is coded, and what may be written to it. Pure.

An order is written as what becomes of the bytes ABCD of a 32-bit number, A the most significant.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

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


Table = Literal["holding", "input", "coil", "discrete"]
Evidence = Literal["CERTAIN", "FIELD", "INFERRED"]


class Strict(BaseModel):
    """What is read from a person's file: unknown keys are faults, and nothing changes later."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Row(Strict):
    """One quantity: where it is, how it is coded, and what may be written to it.

    ``scale`` times the raw number is the value in ``unit``. ``values`` names the codes that exist,
    ``range`` bounds a quantity; anything else is never written. ``seen`` names codes that it may
    show and that are never written either. ``access = "w"`` is a command: written, never read.
    ``spacing_s`` is the least time after another write; ``tolerance`` how far what the controller
    made of a value may be from it.

    ``alarm`` says that the row reports alarms: as a code, of which those in ``quiet`` mean none, or
    as a word of bits. ``no_value`` are raw codes that stand where a number would and mean that
    there is none.
    """

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    table: Table
    address: Annotated[int, Field(ge=0, le=0xFFFF)]
    type: Kind
    evidence: Evidence
    access: Literal["r", "rw", "w"] = "r"
    unit: str = ""
    scale: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = 1.0
    order: Order | None = None  # None: the profile's
    values: dict[str, int] = Field(default_factory=dict)
    seen: dict[str, int] = Field(default_factory=dict)
    range: tuple[float, float] | None = None
    spacing_s: Annotated[float, Field(ge=0.0, le=60.0)] = 0.0
    tolerance: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0
    poll: bool = False
    alarm: Literal["", "code", "bits"] = ""
    quiet: tuple[int, ...] = (0,)
    no_value: dict[str, int] = Field(default_factory=dict)
    meaning: str = ""

    @property
    def words(self) -> int:
        return WORDS[self.type]

    @property
    def end(self) -> int:
        return self.address + self.words

    def faults(self) -> Iterator[str]:
        """What is wrong with this row alone."""
        if (self.type == "bit") != (self.table in ("coil", "discrete")):
            yield f"type {self.type} does not go into table {self.table}"
        if self.access != "r" and self.table in ("input", "discrete"):
            yield f"table {self.table} can't be written, so access must be 'r'"
        if self.access != "r" and not self.values and self.range is None:
            yield "a row that may be written needs 'values' or 'range'"
        if self.access == "w" and (self.poll or self.alarm):
            yield "a row that is only written can't be polled"
        if self.end > 0x10000:
            yield f"address {self.address} leaves no room for {self.words} registers"
        if self.range is not None and not self.range[0] < self.range[1]:
            yield f"range {list(self.range)} is empty"
        yield from self._code_faults()

    def _code_faults(self) -> Iterator[str]:
        codes = {**self.seen, **self.values}
        if len(set(codes.values())) < len(self.values) + len(self.seen):
            yield "two labels in 'values' or 'seen' mean the same code, or one label two codes"
        for label, code in codes.items():
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

    def refusal(self, value: float) -> str | None:
        """Why ``value`` must not be written, or None."""
        if self.access == "r":
            return f"{self.name} is read-only"
        if self.values and value not in self.values.values():
            codes = ", ".join(f"{code:g} ({label})" for label, code in self.values.items())
            return f"{self.name} takes {codes}"
        if self.range is not None and not self.range[0] <= value <= self.range[1]:
            return f"{self.name} takes {self.range[0]:g} to {self.range[1]:g} {self.unit}".rstrip()
        return None

    def is_known(self, value: float) -> bool:
        """Whether ``value`` is one of its codes."""
        return value in self.values.values() or value in self.seen.values()

    def label(self, value: float) -> str:
        """The name of a code, or the number where it has none."""
        codes = {**self.seen, **self.values}
        return next((label for label, code in codes.items() if code == value), f"{value:g}")
