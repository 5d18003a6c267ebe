"""The rows of one Modbus unit over the wire: read one by one or in a poll, written on change,
spaced, and read back. And the identification of a controller before anything is written to it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from instruments.bath.connection import Line, LineError, parse_line
from instruments.bath.profile import Identity, Profile, Wiring
from instruments.bath.reading import BathReading, Poll
from instruments.bath.registers import Order, Row
from instruments.bath.requests import markers, reader
from instruments.bath.transactions import ILLEGAL_ADDRESS, RefusedError, Transactions
from instruments.clock import Clock
from instruments.errors import DeviceError, LimitError, LinkError, ProtocolError
from instruments.tap import Tap

POLL_S = 4.0


class WiredRows:
    """The rows of ``profile`` at ``url``, for one thread: on the link ``shared`` where that leads
    to the same line, else on a link of its own, which is not opened yet. ``order`` is the order of
    bytes just now. Raises LinkError for a URL that the family can't have.
    """

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
        self.profile = profile
        self.who = who
        self.allow_inferred = allow_inferred
        self.order: Order = profile.order
        self.shares = shared is not None and line.url == shared.place
        self.wire = (shared if self.shares else None) or Transactions(
            line,
            clock,
            who=who,
            tap=tap,
            timeout_s=profile.timeout_s,
            quiet_s=profile.quiet_s,
            markers=shapes,
        )
        self._unit_id = line.unit_id
        self._clock = clock
        self._set_at = -math.inf

    def row(self, name: str) -> Row:
        """The row called ``name``. Raises LimitError where the family has none."""
        row = self.profile.find(name)
        if row is None:
            names = ", ".join(sorted(known.name for known in self.profile.rows))
            what = f"{self.profile.family} has no '{name}'"
            raise LimitError(self.who, what, hint=f"It has: {names}.")
        return row

    def words(self, row: Row) -> tuple[int, ...]:
        """The registers (or the bit) of ``row`` as they are."""
        if row.access == "w":
            raise LimitError(self.who, f"{row.name} is a command, and can't be read")
        function = reader(self.profile, row.table)
        return tuple(self.wire.read(function, row.address, row.words, unit_id=self._unit_id))

    def value(self, row: Row) -> float:
        """The value of ``row`` in its unit."""
        return row.decode(self.words(row), self.order)

    def poll(self, poll: Poll) -> BathReading:
        """One poll, at the time of its start. Raises LinkError when it takes longer than POLL_S."""
        start = self._clock.now()
        answers = []
        for block in poll.blocks:
            answers.append(
                self.wire.read(block.function, block.address, block.count, unit_id=self._unit_id)
            )
            took_s = self._clock.now() - start
            if took_s > POLL_S:
                asked = f"{len(poll.blocks)} questions of a poll"
                raise LinkError(self.who, "it answers too slowly", asked=asked, seconds=took_s)
        return poll.reading(start, answers)

    def allowed(self, row: Row, value: float | str) -> float:
        """The number to write. Raises LimitError when the profile does not allow it."""
        if isinstance(value, str):
            if value not in row.values:
                hint = f"There are: {', '.join(row.values) or 'none'}."
                raise LimitError(self.who, f"{row.name} has no value '{value}'", hint=hint)
            value = row.values[value]
        refusal = row.refusal(value)
        if refusal:
            raise LimitError(self.who, f"not written: {refusal}", asked=f"{row.name} = {value:g}")
        if row.evidence == "INFERRED" and not self.allow_inferred:
            what = f"not written: the profile only infers where {row.name} is"
            hint = (
                "Check it on the controller, then set [bath] allow_inferred = true in the rig file."
            )
            raise LimitError(self.who, what, hint=hint)
        return value

    def set(self, row: Row, value: float) -> None:
        """Write ``value`` where ``row`` has another, and read it back; a command in any case."""
        if row.access == "w" or not self._stands(row, value, self.words(row)):
            self.send(row, value)

    def send(self, row: Row, value: float, *, urgent: bool = False) -> None:
        """Write when the last write is long enough ago, and read back; see `Transactions.write`."""
        function = self.profile.write_function(row)
        if function is None:
            what = f"{self.profile.family} has no function that writes {row.name}"
            raise LimitError(self.who, what)
        words = row.encode(value, self.order)
        self._clock.sleep(self._set_at + row.spacing_s - self._clock.now())
        try:
            self.wire.write(function, row.address, words, unit_id=self._unit_id, urgent=urgent)
        finally:
            self._set_at = self._clock.now()
        if row.access == "w":
            return
        words = self.words(row)
        if not self._stands(row, value, words):
            asked = f"{row.name} = {row.label(value)}"
            seen = f"{row.name} = {row.label(row.decode(words, self.order))}"
            what, hint = "it confirmed a write and did not do it", "Switch it at the controller."
            if (remote := self.profile.find("remote")) is not None:
                shown = f"Its remote control is '{remote.label(self.value(remote))}'"
                hint = f"{shown}: set it to Modbus at the controller, or switch it by hand."
            raise DeviceError(self.who, what, asked=asked, seen=seen, hint=hint)

    def _stands(self, row: Row, value: float, words: Sequence[int]) -> bool:
        wanted = row.encode(value, self.order)
        off = abs(row.decode(words, self.order) - row.decode(wanted, self.order))
        return tuple(words) == wanted or off <= row.tolerance


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
    return replace(
        line,
        unit_id=line.unit_id or profile.unit_id,
        baud=line.baud or profile.baud,
        parity=line.parity or profile.parity,
        stopbits=line.stopbits or profile.stopbits,
    )


SHOWN = ("model", "version", "firmware", "cut_out")
HEXADECIMAL = ("model", "version")


def look(wired: WiredRows, profile: Profile) -> tuple[Poll, BathReading]:
    """How to poll ``wired`` from now on, and its first reading.

    Raises DeviceError when it is another family, is in another unit, or has no temperature, and
    ProtocolError when what it shows makes no sense.
    """
    if source := profile.order_from:
        code = int(wired.value(wired.row(source.row)))
        order = profile.order_for(code)
        if order is None:
            what = "its order of bytes is none that the profile knows"
            hint = "Is this really the profile's family?"
            raise ProtocolError(wired.who, what, asked=source.row, seen=str(code), hint=hint)
        wired.order = order
    for identity in profile.identity:
        _check(wired, identity)
    try:
        return _first_poll(wired, profile, gaps=True)
    except RefusedError as refused:
        if refused.code != ILLEGAL_ADDRESS:
            raise
        return _first_poll(wired, profile, gaps=False)


def identity_of(wired: WiredRows, url: str) -> Mapping[str, str]:
    """What the controller shows of itself."""
    shown = {"family": wired.profile.family, "url": url, "order": wired.order}
    for name in SHOWN:
        row = wired.profile.find(name)
        if row is not None and (row.evidence != "INFERRED" or wired.allow_inferred):
            value = wired.value(row)
            number = f"{int(value):04X}" if name in HEXADECIMAL else f"{value:.10g} {row.unit}"
            shown[name] = number.rstrip()
    return shown


def _check(wired: WiredRows, identity: Identity) -> None:
    row = wired.row(identity.row)
    what = f"it is no {wired.profile.family}"
    hint = f"Is it {identity.otherwise}? " if identity.otherwise else ""
    hint += "Give the rig the profile of the controller that is there."
    try:
        value = wired.value(row)
    except RefusedError as error:
        if error.code != ILLEGAL_ADDRESS:
            raise
        raise DeviceError(wired.who, what, asked=row.name, seen=error.seen, hint=hint) from error
    if not identity.fits(row, value):
        seen = f"{value:g} (hexadecimal {int(value) & 0xFFFFFFFF:04X})"
        raise DeviceError(wired.who, what, asked=row.name, seen=seen, hint=hint)


def _first_poll(wired: WiredRows, profile: Profile, *, gaps: bool) -> tuple[Poll, BathReading]:
    poll = Poll(profile, wired.order, gaps=gaps, inferred=wired.allow_inferred, who=wired.who)
    return poll, wired.poll(poll)
