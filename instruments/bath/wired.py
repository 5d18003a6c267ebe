"""A controller's rows over the wire: read one by one or in a poll, written on change, spaced, and seen to stand.

It may not know what the bench wants of a row, nor share itself between threads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from instruments.bath.line import Line, LineError, parse_line
from instruments.bath.polling import markers, reader
from instruments.bath.reading import BathReading, Poll
from instruments.bath.registers import Order
from instruments.bath.rows import Row
from instruments.bath.transactions import Transactions
from instruments.bath.wiring import Wiring
from instruments.clock import Clock
from instruments.errors import DeviceError, LimitError, LinkError
from instruments.tap import Tap

POLL_S = 4.0


class WiredRows:
    """The rows of ``profile`` at the unit ``unit_id`` on ``wire``. ``order`` is the order of bytes just now."""

    def __init__(self, profile: Wiring, wire: Transactions, unit_id: int, clock: Clock, *, who: str, allow_inferred: bool) -> None:
        self.profile = profile
        self.wire = wire
        self.who = who
        self.allow_inferred = allow_inferred
        self.order: Order = profile.order
        self._unit_id = unit_id
        self._clock = clock
        self._set_at = -math.inf

    def row(self, name: str) -> Row:
        """The row called ``name``. Raises LimitError where the family has none: what it lacks is never made up."""
        row = self.profile.find(name)
        if row is None:
            names = ", ".join(sorted(known.name for known in self.profile.rows))
            raise LimitError(self.who, f"{self.profile.family} has no '{name}'", hint=f"It has: {names}.")
        return row

    def words(self, row: Row) -> tuple[int, ...]:
        """The registers (or the bit) of ``row`` as they are."""
        if row.access == "w":
            raise LimitError(self.who, f"{row.name} is a command, and can't be read")
        return tuple(self.wire.read(reader(self.profile, row.table), row.address, row.words, unit_id=self._unit_id))

    def value(self, row: Row) -> float:
        """The value of ``row`` in its unit."""
        return row.decode(self.words(row), self.order)

    def poll(self, poll: Poll) -> BathReading:
        """One poll, at the time when it was begun. Raises LinkError when it takes too long to be of one moment."""
        start = self._clock.now()
        answers = []
        for block in poll.blocks:
            answers.append(self.wire.read(block.function, block.address, block.count, unit_id=self._unit_id))
            took_s = self._clock.now() - start
            if took_s > POLL_S:
                raise LinkError(self.who, "it answers too slowly", asked=f"{len(poll.blocks)} questions of a poll", seconds=took_s)
        return poll.reading(start, answers)

    def allowed(self, row: Row, value: float | str) -> float:
        """The number to write. Raises LimitError when the profile does not allow it."""
        if isinstance(value, str):
            if value not in row.values:
                raise LimitError(self.who, f"{row.name} has no value '{value}'", hint=f"There are: {', '.join(row.values) or 'none'}.")
            value = row.values[value]
        refusal = row.refusal(value)
        if refusal:
            raise LimitError(self.who, f"not written: {refusal}", asked=f"{row.name} = {value:g}")
        if row.evidence == "INFERRED" and not self.allow_inferred:
            hint = "Check it on the controller, then say 'allow_inferred = true' under [bath] in the rig file."
            raise LimitError(self.who, f"not written: the profile only infers where {row.name} is", hint=hint)
        return value

    def set(self, row: Row, value: float) -> None:
        """Write an allowed ``value`` where ``row`` has another, and see that it stands; a command is written in any case."""
        if row.access == "w" or not self._stands(row, value, self.words(row)):
            self.send(row, value)

    def send(self, row: Row, value: float, *, urgent: bool = False) -> None:
        """Write ``value`` when the last write is long enough ago, and see that it stands. ``urgent``: see `Transactions.write`."""
        function = self.profile.write_function(row)
        if function is None:
            raise LimitError(self.who, f"{self.profile.family} has no function that writes {row.name}")
        self._clock.sleep(self._set_at + row.spacing_s - self._clock.now())
        try:
            self.wire.write(function, row.address, row.encode(value, self.order), unit_id=self._unit_id, urgent=urgent)
        finally:
            self._set_at = self._clock.now()
        if row.access == "w":
            return
        words = self.words(row)
        if not self._stands(row, value, words):
            asked, seen = (f"{row.name} = {row.label(shown)}" for shown in (value, row.decode(words, self.order)))
            raise DeviceError(self.who, "it confirmed a write and did not do it", asked=asked, seen=seen, hint=self._remote_hint())

    def _stands(self, row: Row, value: float, words: Sequence[int]) -> bool:
        wanted = row.encode(value, self.order)
        return tuple(words) == wanted or abs(row.decode(words, self.order) - row.decode(wanted, self.order)) <= row.tolerance

    def _remote_hint(self) -> str:
        remote = self.profile.find("remote")
        if remote is None:
            return "Switch it at the controller."
        return f"Its remote control is '{remote.label(self.value(remote))}': set it to Modbus at the controller, or switch it by hand."


def wire_to(line: Line, profile: Wiring, clock: Clock, *, who: str, tap: Tap | None = None, inferred: bool = False) -> Transactions:
    """A link to ``line``, with the profile's manners; not opened yet."""
    known = markers(profile, inferred=inferred) if line.is_rtu else ()
    return Transactions(line, clock, who=who, tap=tap, timeout_s=profile.timeout_s, quiet_s=profile.quiet_s, markers=known)


def line_to(url: str, profile: Wiring, who: str) -> Line:
    """The line that ``url`` names, with the profile's settings where it names none. Raises LinkError."""
    try:
        line = parse_line(url)
    except LineError as error:
        raise LinkError(who, str(error)) from error
    if line.transport not in profile.transports:
        has = {"tcp": "tcp://host:port", "rtu": "rtu+tcp://host:port or a serial port"}
        hint = f"It has: {'; '.join(has[transport] for transport in profile.transports)}."
        raise LinkError(who, f"{profile.family} does not speak Modbus {line.transport.upper()}", hint=hint)
    return replace(
        line,
        unit_id=line.unit_id or profile.unit_id,
        baud=line.baud or profile.baud,
        parity=line.parity or profile.parity,
        stopbits=line.stopbits or profile.stopbits,
    )
