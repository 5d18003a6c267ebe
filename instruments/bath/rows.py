"""The rows of a profile: a quantity of a device, as registers or behind a command. Pure.

A register has 16 bits. An order is written as what becomes of the bytes ABCD of a 32-bit number, A
the most significant. A command or a reply is a template: its characters stand for themselves,
``<number>`` for a decimal number, ``<hex>`` for 16 bits with a sign as four hexadecimal digits,
``<bits>`` for a row of 0 and 1 whose first character weighs 1, ``<text>`` for anything. Capitals
and small letters are alike.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Evidence = Literal["CERTAIN", "FIELD", "INFERRED"]


class Strict(BaseModel):
    """What is read from a person's file: unknown keys are faults, and nothing changes later."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Quantity(Strict):
    """One quantity. ``scale`` times the number on the wire is in ``unit``. ``values``: labels of
    codes that may be written, ``seen`` of those only shown; ``range``: bounds. ``spacing_s``: least
    time between writes; ``tolerance``: of what is read back. ``alarm``: reports a code or bits, of
    which ``quiet`` mean none.
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

    @property
    def codes(self) -> dict[str, int]:
        """All codes that it may show, by their labels."""
        return {**self.seen, **self.values}

    def faults(self) -> Iterator[str]:
        """What is wrong with this row alone."""
        if self.access != "r" and not self.values and self.range is None:
            yield "a row that may be written needs 'values' or 'range'"
        if self.access == "w" and (self.poll or self.alarm):
            yield "a row that is only written can't be polled"
        if self.range is not None and not self.range[0] < self.range[1]:
            yield f"range {list(self.range)} is empty"
        if len(set(self.codes.values())) < len(self.values) + len(self.seen):
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
        return value in self.codes.values()

    def label(self, value: float) -> str:
        """The name of a code, or the number where it has none."""
        return next((label for label, code in self.codes.items() if code == value), f"{value:g}")


# ---- registers

Kind = Literal["u16", "i16", "u32", "f32", "bit"]
Order = Literal["ABCD", "CDAB", "BADC", "DCBA"]
Table = Literal["holding", "input", "coil", "discrete"]

FORMATS: dict[Kind, str] = {"u16": ">H", "i16": ">h", "u32": ">I", "f32": ">f", "bit": ">H"}
WORDS: dict[Kind, int] = {kind: struct.calcsize(form) // 2 for kind, form in FORMATS.items()}


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
    if whole is None or not holds(kind, whole):
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


def holds(kind: Kind, value: float) -> bool:
    """Whether ``value`` fits; a float does not into a whole-number type."""
    if kind == "bit":
        return value in (0, 1)
    try:
        struct.pack(FORMATS[kind], value)
    except (struct.error, OverflowError):
        return False
    return True


class Row(Quantity):
    """A quantity in registers or bits. ``no_value``: raw codes of no number."""

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
        for label, code in self.codes.items():
            if not holds(self.type, code):
                yield f"values.{label} = {code} does not fit into {self.type}"
        for label, code in self.no_value.items():
            if self.words != 1 or not 0 <= code <= 0xFFFF:
                yield f"no_value.{label} = {code} is no register of 16 bits"

    def decode(self, registers: Sequence[int], order: Order) -> float:
        """The value in ``unit``, nan for a code of ``no_value``. Raises ValueError."""
        if len(registers) == self.words and registers[0] in self.no_value.values():
            return math.nan
        return decode(registers, self.type, self.order or order) * self.scale

    def encode(self, value: float, order: Order) -> tuple[int, ...]:
        """The registers that say ``value``. Raises ValueError when it does not fit."""
        return encode(value / self.scale, self.type, self.order or order)


# ---- lines of ASCII

FIELDS = {
    "<number>": r"(?P<number>[+-]? {0,3}\d{1,6}(?:\.\d{0,6})?)",
    "<hex>": r"(?P<hex>[0-9A-Fa-f]{4})",
    "<bits>": r"(?P<bits>[01]{1,24})",
    "<text>": r".*",
}
FIELD = re.compile(r"(<[a-z]*>)")
SENT = ("<number>", "<hex>")  # what a command may carry
AGREE = {"degC": 0.1, "%": 10.0}  # how far two replies may be apart that say the same


@lru_cache(maxsize=256)
def pattern_of(template: str) -> re.Pattern[str]:
    """What a reply has to match as a whole."""
    parts = [FIELDS.get(part) or re.escape(part) for part in FIELD.split(template)]
    return re.compile("".join(parts), re.IGNORECASE | re.ASCII)


def fits(template: str, line: str) -> bool:
    """Whether ``line`` is such a reply."""
    return pattern_of(template).fullmatch(line) is not None


class LineRow(Quantity):
    """A quantity behind the command ``ask``, whose reply has the form ``reply``, or one of a
    label's forms in ``shows``, or, without a value now, of ``absent``. ``optional``: some models
    don't answer. ``tell`` writes; ``agree``: how far two replies may differ.
    """

    ask: str = ""
    reply: str = "<number>"
    shows: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    absent: tuple[str, ...] = ()
    optional: bool = False
    tell: str | dict[str, str] = ""
    confirm: str | None = None
    decimals: Annotated[int, Field(ge=0, le=4)] = 2
    agree: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] | None = None

    @property
    def step(self) -> float:
        return self.scale * (1.0 if "<hex>" in self.reply else 10.0**-self.decimals)

    @property
    def forms(self) -> list[str]:
        """The forms of replies that show a value."""
        return [form for forms in self.shows.values() for form in forms] or [self.reply]

    @property
    def is_text(self) -> bool:
        """Whether its reply is words for people, and no value."""
        return not self.shows and not any(field in self.reply for field in (*SENT, "<bits>"))

    @property
    def is_number(self) -> bool:
        """Whether its reply is a number and nothing else, as other rows' may be."""
        return not self.shows and self.reply in ("<number>", "<hex>", "<bits>")

    def understands(self, line: str) -> bool:
        """Whether ``line`` is a reply that shows it, or that there is none."""
        return any(fits(form, line) for form in (*self.forms, *self.absent))

    def decode(self, line: str) -> float:
        """The value in ``unit``, nan for a text or no value. Raises ValueError."""
        if not self.understands(line):
            raise ValueError(f"{line!r} is no reply to {self.ask!r}")
        if any(fits(form, line) for form in self.absent):
            return math.nan
        for label, forms in self.shows.items():
            if any(fits(form, line) for form in forms):
                return float(self.codes[label])
        match = pattern_of(self.reply).fullmatch(line)
        found = match.groupdict() if match else {}
        if digits := found.get("number"):
            return float(digits.replace(" ", "")) * self.scale
        if digits := found.get("hex"):
            return ((int(digits, 16) ^ 0x8000) - 0x8000) * self.scale
        if digits := found.get("bits"):
            return float(int(digits[::-1], 2))
        return math.nan

    def command(self, value: float) -> str:
        """What to send to write ``value``. Raises ValueError where it can't be said."""
        if not isinstance(self.tell, str):
            return self.tell[self.label(value)]
        raw = value / self.scale
        if "<hex>" in self.tell:
            if not -0x8000 <= round(raw) <= 0x7FFF:
                raise ValueError(f"{value:g} does not fit into four hexadecimal digits")
            return self.tell.replace("<hex>", f"{round(raw) & 0xFFFF:04X}")
        decimals = 0 if self.values else self.decimals
        return self.tell.replace("<number>", f"{raw:.{decimals}f}")

    def agrees(self, first: str, second: str) -> bool:
        """Whether two replies that it understands show the same."""
        one, other = self.decode(first), self.decode(second)
        if math.isnan(one) or math.isnan(other):  # texts, too
            return first == second
        agree = AGREE.get(self.unit, 0.0) if self.agree is None else self.agree
        return abs(one - other) <= agree + 1e-9

    def faults(self) -> Iterator[str]:
        """What is wrong with this row alone."""
        yield from super().faults()
        if (self.access != "w") != bool(self.ask):
            yield "a row that may be read needs 'ask', and one that is only written has none"
        if (self.access != "r") != bool(self.tell):
            yield "a row that may be written needs 'tell', and one that is only read has none"
        if unknown := sorted(set(self.shows) - set(self.codes)):
            yield f"shows.{unknown[0]} is no label of 'values' or 'seen'"
        if isinstance(self.tell, dict) and set(self.tell) != set(self.values):
            yield "'tell' needs a command for each label of 'values', and no other"
        commands = [self.tell] if isinstance(self.tell, str) else self.tell.values()
        shown = [form for forms in self.shows.values() for form in forms]
        replies = [self.reply, self.confirm or "", *self.absent, *shown]
        for template in filter(None, (*replies, self.ask, *commands)):
            yield from _template_faults(template)
        if "<" in self.ask:
            yield f"ask = {self.ask!r} is sent as it is, so it has no field"
        if isinstance(self.tell, str) and self.tell and sum(map(self.tell.count, SENT)) != 1:
            yield f"tell = {self.tell!r} needs one {' or '.join(SENT)}"
        if self.alarm and not self.shows and self.is_text:
            yield "a row that reports alarms needs a number or bits in its reply"
        if self.optional and self.name in ("temperature", "set_point", "run"):
            yield "the bench can't do without it, so it is not optional"


def _template_faults(template: str) -> Iterator[str]:
    if not all(" " <= sign <= "~" for sign in template):
        yield f"{template!r} has characters that are no printable ASCII; 'end' ends a command"
    fields = FIELD.findall(template)
    for field in fields:
        if field not in FIELDS:
            yield f"{template!r} has the field {field}; there are {', '.join(FIELDS)}"
    if sum(field != "<text>" for field in fields) > 1:
        yield f"{template!r} has more than one value"
