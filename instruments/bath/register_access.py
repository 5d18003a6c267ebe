"""Access to one Modbus unit: a controller, or the relay of a pump. And the identification of a
controller before anything is written to it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import get_args

from instruments.bath.access import Access
from instruments.bath.connection import Line, LineError, parse_line
from instruments.bath.profile import RegisterProfile, Wiring
from instruments.bath.quantity import Quantity
from instruments.bath.reading import Assembler, BathReading, ChangedError
from instruments.bath.registers import Order, Row, decode
from instruments.bath.requests import Block, blocks, markers, reader
from instruments.bath.session import BrokenError, RefusedError
from instruments.bath.transactions import ILLEGAL_ADDRESS, Transactions
from instruments.clock import Clock
from instruments.errors import LimitError, LinkError, ProtocolError
from instruments.tap import Tap

SHOWN = ("model", "version", "firmware", "cut_out")
HEXADECIMAL = ("model", "version")


class Poll:
    """The questions of a poll of ``profile``, and how to read the answers (`requests.blocks`)."""

    def __init__(
        self,
        profile: RegisterProfile,
        order: Order,
        *,
        gaps: bool,
        inferred: bool = False,
        who: str,
    ) -> None:
        self.blocks = blocks(profile, gaps=gaps, inferred=inferred)
        self._profile = profile
        self._order = order
        self._who = who
        self._places = [
            (row, at, row.address - block.address)
            for at, block in enumerate(self.blocks)
            for row in block.rows
        ]
        self._assembler = Assembler(profile, [row for row, *_ in self._places], who=who)

    def reading(self, t_s: float, answers: Sequence[Sequence[int]]) -> BathReading:
        """The reading in ``answers``, the registers of each block. Raises as the `Assembler`, and
        ChangedError for another order of bytes.
        """
        raw = {row.name: answers[at][start : start + row.words] for row, at, start in self._places}
        values = {row.name: row.decode(raw[row.name], self._order) for row, *_ in self._places}
        source = self._profile.order_from
        code = values.get(source.row) if source else None
        if source and code is not None and self._profile.order_for(int(code)) != self._order:
            what, seen = "its order of bytes has changed", f"{code:g}"
            raise ChangedError(self._who, what, asked=source.row, seen=seen, hint="Ask again.")
        alarms = (self._alarm(row, values[row.name], raw[row.name]) for row, *_ in self._places)
        guess, registers = " ".join(self._guesses(raw["temperature"])), raw["temperature"]
        alarm = next(filter(None, alarms), 0)
        return self._assembler.reading(t_s, values, registers, alarm=alarm, guess=guess)

    def _alarm(self, row: Row, value: float, registers: Sequence[int]) -> int:
        if row.no_value:  # an error code stands where the number would
            return registers[0] if registers[0] in row.no_value.values() else 0
        return self._assembler.alarm_of(row, value)

    def _guesses(self, raw: Sequence[int]) -> Iterator[str]:
        """What else the temperature's registers may mean, each where it would be a bath's."""
        row = self._profile.row("temperature")
        yield from self._assembler.in_fahrenheit(row.decode(raw, self._order))
        for order in get_args(Order):
            turned = decode(raw, row.type, order) * row.scale
            if row.words > 1 and order != self._order and self._assembler.is_plausible(turned):
                where = "set order in the profile, or at the controller"
                yield f"In the order {order} it would be {turned:.1f} degC: {where}."


class RegisterAccess(Access[Wiring]):
    """The rows of ``profile`` at ``url``: on the link ``shared`` where that leads to the same line,
    else on a link of its own. ``order`` is the order of bytes just now. Raises LinkError for a URL
    that the family can't have.
    """

    wire: Transactions

    def __init__(
        self,
        url: str,
        profile: Wiring,
        clock: Clock,
        *,
        who: str,
        allow_inferred: bool = False,
        tap: Tap | None = None,
        shared: Transactions | None = None,
    ) -> None:
        line = _line_to(url, profile, who)
        shapes = markers(profile, inferred=allow_inferred) if line.is_rtu else ()
        self.order: Order = profile.order
        self.shares = shared is not None and line.url == shared.place
        wire = (shared if self.shares else None) or Transactions(
            line,
            clock,
            who=who,
            tap=tap,
            timeout_s=profile.timeout_s,
            quiet_s=profile.quiet_s,
            markers=shapes,
        )
        super().__init__(profile, wire, clock, who=who, allow_inferred=allow_inferred)
        self.url = url
        self._unit_id = line.unit_id
        self._poll: Poll | None = None

    @property
    def known(self) -> bool:
        return self._poll is not None

    @property
    def remote(self) -> str:
        return "Modbus"

    def lacks(self, refused: RefusedError) -> bool:
        return refused.code == ILLEGAL_ADDRESS

    def forget(self) -> None:
        self._poll = None

    def asking(self, row: Quantity) -> str:
        found = self._row(row)
        return f"{found.table} {found.address}, {found.type}"

    def try_row(self, row: Quantity) -> str:
        found = self._row(row)
        words = self._words(found)
        raw = " ".join(f"{word:04X}" for word in words)
        return f"{self.shown(row, found.decode(words, self.order))} (got {raw})"

    def value(self, row: Quantity) -> float:
        """The value of ``row`` in its unit."""
        found = self._row(row)
        return found.decode(self._words(found), self.order)

    def write(self, row: Quantity, value: float, *, urgent: bool) -> None:
        found = self._row(row)
        function = self.profile.write_function(found)
        if function is None:
            what = f"{self.profile.family} has no function that writes {row.name}"
            raise LimitError(self.who, what)
        words = found.encode(value, self.order)
        self.wire.write(function, found.address, words, unit_id=self._unit_id, urgent=urgent)

    def stands(self, row: Quantity, value: float, seen: float) -> bool:
        found = self._row(row)
        wanted = found.decode(found.encode(value, self.order), self.order)
        return seen == wanted or abs(seen - wanted) <= row.tolerance

    def poll(self) -> BathReading:
        if self._poll is None:  # an event of virtual time has dropped the link meanwhile
            raise BrokenError(self.who, "the link is down", hint="Check cable and power.")
        return self._read(self._poll)

    def look(self) -> tuple[BathReading, Mapping[str, str]]:
        profile = self.profile
        if not isinstance(profile, RegisterProfile):
            raise TypeError(f"{profile.family} is no controller")
        if source := profile.order_from:
            code = int(self.value(self.row(source.row)))
            order = profile.order_for(code)
            if order is None:
                what = "its order of bytes is none that the profile knows"
                hint = "Is this really the profile's family?"
                raise ProtocolError(self.who, what, asked=source.row, seen=str(code), hint=hint)
            self.order = order
        for identity in profile.identity:
            self.check(identity)
        try:
            poll, reading = self._first_poll(profile, gaps=True)
        except RefusedError as refused:
            if not self.lacks(refused):
                raise
            poll, reading = self._first_poll(profile, gaps=False)
        shown = self._identity()
        self._poll = poll
        return reading, shown

    def _row(self, row: Quantity) -> Row:
        return self.profile.row(row.name)

    def _words(self, row: Row) -> tuple[int, ...]:
        """The registers (or the bit) of ``row`` as they are."""
        if row.access == "w":
            raise LimitError(self.who, f"{row.name} is a command, and can't be read")
        function = reader(self.profile, row.table)
        return tuple(self.wire.read(function, row.address, row.words, unit_id=self._unit_id))

    def _read(self, poll: Poll) -> BathReading:
        start_s, answers = self.clock.now(), []
        for block in poll.blocks:
            answers.append(self._ask(block))
            self.in_time(start_s, len(poll.blocks))
        return poll.reading(start_s, answers)

    def _ask(self, block: Block) -> Sequence[int]:
        return self.wire.read(block.function, block.address, block.count, unit_id=self._unit_id)

    def _first_poll(self, profile: RegisterProfile, *, gaps: bool) -> tuple[Poll, BathReading]:
        poll = Poll(profile, self.order, gaps=gaps, inferred=self.allow_inferred, who=self.who)
        return poll, self._read(poll)

    def _identity(self) -> Mapping[str, str]:
        """What the controller shows of itself."""
        shown = {"family": self.profile.family, "url": self.url, "order": self.order}
        for name in SHOWN:
            row = self.profile.find(name)
            if row is not None and (row.evidence != "INFERRED" or self.allow_inferred):
                value = self.value(row)
                number = f"{int(value):04X}" if name in HEXADECIMAL else f"{value:.10g} {row.unit}"
                shown[name] = number.rstrip()
        return shown


def _line_to(url: str, profile: Wiring, who: str) -> Line:
    """The line that ``url`` names, with the profile's settings where it names none."""
    try:
        line = parse_line(url)
    except LineError as error:
        raise LinkError(who, str(error)) from error
    if line.transport not in profile.transports:
        what = f"{profile.family} does not speak Modbus {line.transport.upper()}"
        has = {"tcp": "tcp://host:port", "rtu": "rtu+tcp://host:port or a serial port"}
        hint = f"It has: {'; '.join(has[transport] for transport in profile.transports)}."
        raise LinkError(who, what, hint=hint)
    if line.bytesize == 7:
        hint = "Leave bytesize out of the URL, or set it to 8."
        raise LinkError(who, "Modbus RTU has 8 data bits, and the URL says 7", hint=hint)
    return replace(line.filled(profile), unit_id=line.unit_id or profile.unit_id)
