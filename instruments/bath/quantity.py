"""One quantity of a device, whatever the protocol: its name, unit and codes, and what may be
written to it. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Evidence = Literal["CERTAIN", "FIELD", "INFERRED"]


class Strict(BaseModel):
    """What is read from a person's file: unknown keys are faults, and nothing changes later."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Quantity(Strict):
    """One quantity: what it is called, and what may be written to it.

    ``scale`` times the number on the wire is the value in ``unit``. ``values`` names the codes that
    exist, ``range`` bounds a quantity; anything else is never written. ``seen`` names codes that it
    may show and that are never written either. ``access = "w"`` is a command: written, never read.
    ``spacing_s`` is the least time after another write; ``tolerance`` how far what the controller
    made of a value may be from it. ``alarm`` says that the row reports alarms: as a code, of which
    those in ``quiet`` mean none, or as a word of bits.
    """

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    evidence: Evidence
    access: Literal["r", "rw", "w"] = "r"
    unit: str = ""
    scale: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = 1.0
    values: dict[str, int] = Field(default_factory=dict)
    seen: dict[str, int] = Field(default_factory=dict)
    range: tuple[float, float] | None = None
    spacing_s: Annotated[float, Field(ge=0.0, le=60.0)] = 0.0
    tolerance: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0
    poll: bool = False
    alarm: Literal["", "code", "bits"] = ""
    quiet: tuple[int, ...] = (0,)
    meaning: str = ""

    @property
    def step(self) -> float:
        """How much its value changes at the least, in ``unit``."""
        return self.scale

    def faults(self) -> Iterator[str]:
        """What is wrong with this row alone."""
        if self.access != "r" and not self.values and self.range is None:
            yield "a row that may be written needs 'values' or 'range'"
        if self.access == "w" and (self.poll or self.alarm):
            yield "a row that is only written can't be polled"
        if self.range is not None and not self.range[0] < self.range[1]:
            yield f"range {list(self.range)} is empty"
        codes = {**self.seen, **self.values}
        if len(set(codes.values())) < len(self.values) + len(self.seen):
            yield "two labels in 'values' or 'seen' mean the same code, or one label two codes"

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
