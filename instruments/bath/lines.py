"""One quantity of a controller that speaks lines of ASCII: the command that asks for it, the one
that sets it, and what the replies look like. Pure.

A command or a reply is a template: its characters stand for themselves, ``<number>`` for a decimal
number, ``<hex>`` for 16 bits with a sign as four hexadecimal digits, ``<bits>`` for a row of 0 and
1 whose first character weighs 1, ``<text>`` for anything. Capitals and small letters are alike.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache
from typing import Annotated

from pydantic import Field

from instruments.bath.quantity import Quantity

FIELDS = {
    "<number>": r"(?P<number>[+-]? {0,3}\d{1,6}(?:\.\d{0,6})?)",
    "<hex>": r"(?P<hex>[0-9A-Fa-f]{4})",
    "<bits>": r"(?P<bits>[01]{1,24})",
    "<text>": r".*",
}
FIELD = re.compile(r"<[a-z]*>")
SENT = ("<number>", "<hex>")  # what a command may carry
AGREE = {"degC": 0.1, "%": 10.0}  # how far two replies may be apart that say the same


@lru_cache(maxsize=256)
def pattern_of(template: str) -> re.Pattern[str]:
    """What a reply has to match as a whole."""
    literals, fields = FIELD.split(template), FIELD.findall(template)
    parts = [re.escape(literals[0])]
    for field, literal in zip(fields, literals[1:], strict=True):
        parts += [FIELDS[field], re.escape(literal)]
    return re.compile("".join(parts), re.IGNORECASE | re.ASCII)


def fits(template: str, line: str) -> bool:
    """Whether ``line`` is such a reply."""
    return pattern_of(template).fullmatch(line) is not None


class LineRow(Quantity):
    """A quantity behind a command.

    ``ask`` is the command whose reply shows it, in the form ``reply``. With ``shows`` the reply is
    one of a label's forms instead, and the first that matches gives the label's code. A reply of a
    form in ``absent`` shows that there is no value now; an ``optional`` row is one that some models
    don't answer. ``tell`` writes: one template, or a command for each label; ``confirm`` is the
    reply to it where it is not the profile's. ``agree`` is how far two replies to the same command
    may differ.
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
    def is_text(self) -> bool:
        """Whether its reply is words for people, and no value."""
        return not self.shows and not any(field in self.reply for field in (*SENT, "<bits>"))

    @property
    def is_number(self) -> bool:
        """Whether its reply is a number and nothing else, as other rows' may be."""
        return not self.shows and self.reply in ("<number>", "<hex>", "<bits>")

    @property
    def commands(self) -> tuple[str, ...]:
        """All templates that it sends."""
        tell = self.tell
        told = (tell,) if isinstance(tell, str) else tuple(tell.values())
        return tuple(filter(None, (self.ask, *told)))

    def understands(self, line: str) -> bool:
        """Whether ``line`` is a reply that shows it, or that there is none."""
        forms = [form for forms in self.shows.values() for form in forms] or [self.reply]
        return any(fits(form, line) for form in (*forms, *self.absent))

    def decode(self, line: str) -> float:
        """The value in ``unit`` that a reply shows; not-a-number where it shows that there is none,
        and for a text. Raises ValueError for a line that is no such reply.
        """
        if not self.understands(line):
            raise ValueError(f"{line!r} is no reply to {self.ask!r}")
        if any(fits(form, line) for form in self.absent):
            return float("nan")
        codes = {**self.seen, **self.values}
        for label, forms in self.shows.items():
            if any(fits(form, line) for form in forms):
                return float(codes[label])
        match = pattern_of(self.reply).fullmatch(line)
        found = match.groupdict() if match else {}
        if digits := found.get("number"):
            return float(digits.replace(" ", "")) * self.scale
        if digits := found.get("hex"):
            return ((int(digits, 16) ^ 0x8000) - 0x8000) * self.scale
        if digits := found.get("bits"):
            return float(int(digits[::-1], 2))
        return float("nan")

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
        if self.is_text:
            return first == second
        one, other = self.decode(first), self.decode(second)
        if one != one or other != other:
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
        labels = set(self.values) | set(self.seen)
        if unknown := sorted(set(self.shows) - labels):
            yield f"shows.{unknown[0]} is no label of 'values' or 'seen'"
        if isinstance(self.tell, dict) and set(self.tell) != set(self.values):
            yield "'tell' needs a command for each label of 'values', and no other"
        replies = [self.reply, self.confirm or "", *self.absent]
        replies += [form for forms in self.shows.values() for form in forms]
        for template in (*replies, *self.commands):
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
    for field in FIELD.findall(template):
        if field not in FIELDS:
            yield f"{template!r} has the field {field}; there are {', '.join(FIELDS)}"
    values = [field for field in FIELD.findall(template) if field != "<text>"]
    if len(values) > 1:
        yield f"{template!r} has more than one value"
