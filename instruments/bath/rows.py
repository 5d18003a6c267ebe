"""One quantity of a controller: where it is, how it is coded, and what may be written to it. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from instruments.bath.registers import WORDS, Kind, Order, decode, encode, fits

Table = Literal["holding", "input", "coil", "discrete"]
Evidence = Literal["CERTAIN", "FIELD", "INFERRED"]


class Strict(BaseModel):
    """What is read from a person's file: unknown keys are faults, and nothing changes later."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Row(Strict):
    """One quantity: where it is, how it is coded, and what may be written to it.

    ``scale`` times the raw number is the value in ``unit``. ``values`` names the codes that exist, ``range``
    bounds a quantity; anything else is never written. ``spacing_s`` is the least time after another write.
    """

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    table: Table
    address: Annotated[int, Field(ge=0, le=0xFFFF)]
    type: Kind
    evidence: Evidence
    access: Literal["r", "rw"] = "r"
    unit: str = ""
    scale: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = 1.0
    order: Order | None = None  # None: the profile's
    values: dict[str, int] = Field(default_factory=dict)
    range: tuple[float, float] | None = None
    spacing_s: Annotated[float, Field(ge=0.0, le=60.0)] = 0.0
    poll: bool = False
    meaning: str = ""

    @property
    def words(self) -> int:
        """How many registers (or coils) it takes."""
        return WORDS[self.type]

    @property
    def end(self) -> int:
        """The first address after it."""
        return self.address + self.words

    def faults(self) -> Iterator[str]:
        """What is wrong with this row alone."""
        if (self.type == "bit") != (self.table in ("coil", "discrete")):
            yield f"type {self.type} does not go into table {self.table}"
        if self.access == "rw" and self.table in ("input", "discrete"):
            yield f"table {self.table} can't be written, so access must be 'r'"
        if self.access == "rw" and not self.values and self.range is None:
            yield "a row that may be written needs 'values' or 'range'"
        if self.end > 0x10000:
            yield f"address {self.address} leaves no room for {self.words} registers"
        if self.range is not None and not self.range[0] < self.range[1]:
            yield f"range {list(self.range)} is empty"
        if len(set(self.values.values())) < len(self.values):
            yield "two labels in 'values' mean the same code"
        for label, code in self.values.items():
            if not fits(code, self.type):
                yield f"values.{label} = {code} does not fit into {self.type}"

    def decode(self, registers: Sequence[int], order: Order) -> float:
        """The value in ``unit``. Raises ValueError when the number of registers is wrong."""
        return decode(registers, self.type, self.order or order) * self.scale

    def encode(self, value: float, order: Order) -> tuple[int, ...]:
        """The registers that say ``value``. Raises ValueError when it does not fit."""
        return encode(value / self.scale, self.type, self.order or order)

    def refusal(self, value: float) -> str | None:
        """Why ``value`` must not be written, or None."""
        if self.access != "rw":
            return f"{self.name} is read-only"
        if self.values and value not in self.values.values():
            return f"{self.name} takes {', '.join(f'{code:g} ({label})' for label, code in self.values.items())}"
        if self.range is not None and not self.range[0] <= value <= self.range[1]:
            return f"{self.name} takes {self.range[0]:g} to {self.range[1]:g} {self.unit}".rstrip()
        return None

    def label(self, value: float) -> str:
        """The name of a code, or the number where it has none."""
        return next((label for label, code in self.values.items() if code == value), f"{value:g}")
