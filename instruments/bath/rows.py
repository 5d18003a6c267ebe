"""The rows of a profile: a quantity of a device, as registers or behind a command. Pure.

A register has 16 bits. An order is written as what becomes of the bytes ABCD of a 32-bit number, A
the most significant. A command or a reply is a template: its characters stand for themselves,
``<number>`` for a decimal number, ``<hex>`` for 16 bits with a sign as four hexadecimal digits,
``<bits>`` for a row of 0 and 1 whose first character weighs 1, ``<text>`` for anything. Capitals
and small letters are alike. ``<bytes>`` stands for decimal numbers of eight bits with a blank
between, the first the lowest; ``<word>`` for the part of a text that counts.
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
NEEDED = ("temperature", "set_point", "run")
FULL_PERCENT = 100.0
# what no device has: words in a wrong order or at a wrong address often give such numbers
COLDEST_C, HOTTEST_C, TINIEST, LARGEST = -273.15, 2000.0, 1e-6, 1e9


class Strict(BaseModel):
    """What is read from a person's file: unknown keys are faults, and nothing changes later."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)


class Quantity(Strict):
    """One quantity. ``scale`` times the number on the wire is in ``unit``. ``values``: labels of
    codes that may be written, ``seen`` of those only shown; ``range``: bounds. ``spacing_s``: least
    time between writes; ``tolerance``: of what is read back. ``alarm``: reports a code or bits, of
    which ``quiet`` mean none (``negative``: only codes below 0 are alarms). ``mask``: the bits of
    the word that count. ``optional``: some models don't answer; ``by_model``: only models that are
    named have it. ``needs``: labels of other rows, without which it is not written.
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
    alarm: Literal["", "code", "bits", "negative"] = ""
    quiet: tuple[int, ...] = (0,)
    mask: Annotated[int, Field(ge=1, le=0xFFFFFFFFFF)] | None = None
    optional: bool = False
    by_model: bool = False
    needs: dict[str, str] = Field(default_factory=dict)
    meaning: str = ""

    @property
    def step(self) -> float:
        """How much its value changes at the least, in ``unit``."""
        return self.scale

    @property
    def is_whole(self) -> bool:
        """Whether its number is one of whole steps."""
        return True

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
        if (self.optional or self.by_model) and self.name in NEEDED:
            yield "the bench can't do without it, so it is not optional"

    def masked(self, value: float) -> float:
        """Of ``value`` only the bits that count."""
        return value if self.mask is None or math.isnan(value) else float(int(value) & self.mask)

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

    def is_possible(self, value: float) -> bool:
        """Whether a device may have ``value`` there; not-a-number and infinity are none."""
        if not math.isfinite(value) or value == 0.0:
            return True
        if self.unit == "degC":
            return COLDEST_C <= value <= HOTTEST_C and abs(value) > TINIEST
        if self.unit == "%":
            return abs(value) <= FULL_PERCENT
        return self.is_whole or TINIEST < abs(value) < LARGEST

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
    data = None if whole is None else _packed(kind, whole)
    if data is None:
        raise ValueError(f"{value:g} does not fit into {kind}")
    return tuple(_turned(struct.unpack(f">{len(data) // 2}H", data), order))


def _turned(registers: Sequence[int], order: Order) -> Sequence[int]:
    """Between the wire's order and ABCD; its own inverse."""
    if order in ("CDAB", "DCBA"):
        registers = registers[::-1]
    if order in ("BADC", "DCBA"):
        registers = [(word & 0xFF) << 8 | word >> 8 for word in registers]
    return registers


def holds(kind: Kind, value: float) -> bool:
    """Whether ``value`` fits; a float does not into a whole-number type."""
    return _packed(kind, value) is not None


def _packed(kind: Kind, value: float) -> bytes | None:
    if kind == "bit" and value not in (0, 1):
        return None
    try:
        return struct.pack(FORMATS[kind], value)
    except (struct.error, OverflowError):
        return None


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

    @property
    def is_whole(self) -> bool:
        return self.type != "f32"

    def faults(self) -> Iterator[str]:
        """What is wrong with this row alone."""
        if (self.type == "bit") != (self.table in ("coil", "discrete")):
            yield f"type {self.type} does not go into table {self.table}"
        if self.access != "r" and self.table in ("input", "discrete"):
            yield f"table {self.table} can't be written, so access must be 'r'"
        if self.end > 0x10000:
            yield f"address {self.address} leaves no room for {self.words} registers"
        yield from super().faults()
        if self.mask is not None and self.type == "f32":
            yield "'mask' takes bits of a whole number, and f32 is none"
        for label, code in self.codes.items():
            if not holds(self.type, code):
                yield f"values.{label} = {code} does not fit into {self.type}"
        for label, code in self.no_value.items():
            if self.words != 1 or not 0 <= code <= 0xFFFF:
                yield f"no_value.{label} = {code} is no register of 16 bits"

    def decode(self, registers: Sequence[int], order: Order) -> float:
        """The value in ``unit``, not-a-number for a code of ``no_value``. Raises ValueError."""
        if len(registers) == self.words and registers[0] in self.no_value.values():
            return math.nan
        return self.masked(decode(registers, self.type, self.order or order) * self.scale)

    def encode(self, value: float, order: Order) -> tuple[int, ...]:
        """The registers that say ``value``. Raises ValueError when it does not fit."""
        return encode(value / self.scale, self.type, self.order or order)


# ---- lines of ASCII

FIELDS = {
    "<number>": r"(?P<number> {0,3}[+-]? {0,3}\d{1,8}(?:[.,]\d{0,6})?)",
    "<hex>": r"(?P<hex>[0-9A-Fa-f]{4})",
    "<bits>": r"(?P<bits>[01]{1,24})",
    "<bytes>": r"(?P<bytes>\d{1,3}(?: \d{1,3}){0,4})",
    "<word>": r"(?P<word>\S+)",
    "<text>": r".*",
}
FIELD = re.compile(r"(<[a-z]*>)")
SENT = ("<number>", "<hex>")  # what a command may carry
VALUES = (*SENT, "<bits>", "<bytes>")
FORM = re.compile(r"\+?0+(?:[.,]0+)?")  # of a number of fixed width
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
    label's forms in ``shows``, or, without a value now, of ``absent``. ``tell`` writes ("" for a
    label that needs no command), ``form``: a number's width, zeros and sign; ``above``: 1 where the
    number is above it, else 0; ``agree``: how far two replies may differ.
    """

    ask: str = ""
    reply: str = "<number>"
    shows: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    absent: tuple[str, ...] = ()
    tell: str | dict[str, str] = ""
    confirm: str | None = None
    decimals: Annotated[int, Field(ge=0, le=4)] = 2
    form: Annotated[str, Field(max_length=12)] = ""
    above: Annotated[float, Field(allow_inf_nan=False)] | None = None
    agree: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] | None = None

    @property
    def step(self) -> float:
        return self.scale * (1.0 if "<hex>" in self.reply else 10.0**-self.places)

    @property
    def places(self) -> int:
        """How many decimal places a number is sent with."""
        form = self.form.replace(",", ".")
        return len(form.partition(".")[2]) if form else self.decimals

    @property
    def forms(self) -> list[str]:
        """The forms of replies that show a value."""
        return [form for forms in self.shows.values() for form in forms] or [self.reply]

    @property
    def is_text(self) -> bool:
        """Whether its reply is words for people, and no value."""
        value = any(field in self.reply for field in VALUES)
        return not self.shows and ("<word>" in self.reply or not value)

    @property
    def is_number(self) -> bool:
        """Whether its reply is a number and nothing else, as other rows' may be."""
        return not self.shows and self.reply in VALUES

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
        if self.is_text or match is None:
            return math.nan
        value = self.masked(self._number(match.groupdict()))
        return value if self.above is None else float(value > self.above)

    def _number(self, found: dict[str, str]) -> float:
        if digits := found.get("number"):
            return float(digits.replace(" ", "").replace(",", ".")) * self.scale
        if digits := found.get("hex"):
            return ((int(digits, 16) ^ 0x8000) - 0x8000) * self.scale
        if digits := found.get("bits"):
            return float(int(digits[::-1], 2))
        if digits := found.get("bytes"):
            return float(sum(int(one) << 8 * at for at, one in enumerate(digits.split())))
        return math.nan

    def text(self, line: str) -> str:
        """What of a text counts: its ``<word>``, or what its only ``<text>`` stands for."""
        match = pattern_of(self.reply).fullmatch(line)
        if word := match.groupdict().get("word") if match else None:
            return word
        before, _, after = self.reply.partition("<text>")
        if match is None or "<" in before + after:
            return line
        return line[len(before) : len(line) - len(after)].strip() or line

    def sent(self, value: float) -> float:
        """``value`` as rounded by its command."""
        if self.values or not isinstance(self.tell, str) or self.access == "r":
            return value
        places = 0 if "<hex>" in self.tell else self.places
        return round(value / self.scale, places) * self.scale

    def command(self, value: float) -> str:
        """What to send to write ``value``. Raises ValueError where it can't be said."""
        if not isinstance(self.tell, str):
            return self.tell[self.label(value)]
        raw = value / self.scale
        if "<hex>" in self.tell:
            if not -0x8000 <= round(raw) <= 0x7FFF:
                raise ValueError(f"{value:g} does not fit into four hexadecimal digits")
            return self.tell.replace("<hex>", f"{round(raw) & 0xFFFF:04X}")
        return self.tell.replace("<number>", self.digits(raw))

    def digits(self, raw: float) -> str:
        """A number as it is sent. Raises ValueError where it does not fit into ``form``."""
        if not self.form:
            return f"{raw:.{0 if self.values else self.decimals}f}"
        width = len(self.form.removeprefix("+"))
        digits = f"{abs(raw):0{width}.{self.places}f}"
        if len(digits) > width:
            raise ValueError(f"{raw:g} does not fit into {self.form}")
        sign = "+" if self.form.startswith("+") else ""
        sign = "-" if raw < 0.0 and float(digits) else sign
        return sign + (digits.replace(".", ",") if "," in self.form else digits)

    def agrees(self, first: str, second: str) -> bool:
        """Whether two replies that it understands show the same."""
        one, other = self.decode(first), self.decode(second)
        if math.isnan(one) or math.isnan(other):  # texts, too
            return self.text(first) == self.text(second)
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
        yield from self._number_faults()

    def _number_faults(self) -> Iterator[str]:
        if self.alarm and not self.shows and self.is_text:
            yield "a row that reports alarms needs a number or bits in its reply"
        if self.mask is not None and (self.shows or self.is_text):
            yield "'mask' takes bits of a reply's number, not of its words"
        if self.form and not FORM.fullmatch(self.form):
            yield f"form = {self.form!r} is no width of a number: write it as '+000.00' or '00000'"
        if self.above is not None and set(self.codes.values()) - {0, 1}:
            yield "with 'above' it shows 0 or 1, so 'values' has no other codes"


def _template_faults(template: str) -> Iterator[str]:
    if not all(" " <= sign <= "~" for sign in template):
        yield f"{template!r} has characters that are no printable ASCII; 'end' ends a command"
    fields = FIELD.findall(template)
    for field in fields:
        if field not in FIELDS:
            yield f"{template!r} has the field {field}; there are {', '.join(FIELDS)}"
    if sum(field not in ("<text>", "<word>") for field in fields) > 1 or fields.count("<word>") > 1:
        yield f"{template!r} has more than one value"
