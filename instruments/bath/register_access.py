"""Access to one Modbus unit: a controller, or the relay of a pump. And the identification of a
controller before anything is written to it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar, cast, get_args

from instruments.bath.access import NO_VALUE, Access, Raw
from instruments.bath.profile import ModbusDevice, RegisterProfile, line_to
from instruments.bath.reading import BathReading, ChangedError
from instruments.bath.requests import Block, blocks, markers
from instruments.bath.rows import Order, Row, decode
from instruments.bath.session import RefusedError
from instruments.bath.transactions import Transactions
from instruments.clock import Clock
from instruments.errors import InstrumentError, ProtocolError
from instruments.link import Tap

HEXADECIMAL = ("model", "version")
LEAST_WORDS = 4  # the same in fewer of them may be chance


def constant(words: Sequence[int]) -> str:
    """What is wrong with ``words`` that are all the same: a bus without a device, a gateway's own
    answer or a device that just starts. No bath has its set point, output and temperature alike.
    """
    if len(words) < LEAST_WORDS or len(set(words)) > 1:
        return ""
    return f"all of {len(words)} registers read {words[0]:04X}"


class RegisterAccess(Access[Row]):
    """The rows of ``profile`` at ``url``, on the link ``shared`` where that is the same line.
    ``order``: the present order of bytes. Raises LinkError for a URL that the family can't have.
    """

    SHOWN: ClassVar[tuple[str, ...]] = ("model", "version", "firmware", "cut_out")
    SHOWS_ABSENCE: ClassVar[tuple[type[InstrumentError], ...]] = (RefusedError,)
    remote: ClassVar[str] = "Modbus"
    profile: ModbusDevice
    wire: Transactions

    def __init__(
        self,
        url: str,
        profile: ModbusDevice,
        clock: Clock,
        who: str,
        allow_inferred: bool = False,
        tap: Tap | None = None,
        shared: Transactions | None = None,
    ) -> None:
        line = line_to(url, profile, who)
        shapes = markers(profile, inferred=allow_inferred) if line.is_rtu else ()
        self.shares = shared is not None and line.url == shared.line.url
        wire = (shared if self.shares else None) or Transactions(
            line,
            clock,
            who=who,
            tap=tap,
            timeout_s=profile.timeout_s,
            quiet_s=profile.quiet_s,
            markers=shapes,
        )
        super().__init__(url, profile, wire, who=who, allow_inferred=allow_inferred)
        self.order: Order = profile.order
        self._unit_id = line.unit_id or profile.unit_id
        self._blocks: tuple[Block, ...] = ()
        self._tried: list[int] = []

    def detect_format(self) -> None:
        self.absent = {}
        profile = cast(RegisterProfile, self.profile)
        if source := profile.order_from:
            code = int(self.get(source.row))
            order = profile.order_for(code)
            if order is None:
                what = "its order of bytes is none that the profile knows"
                hint = "Is this really the profile's family?"
                raise ProtocolError(self.who, what, asked=source.row, seen=str(code), hint=hint)
            self.order = order
        self.detected = {"order": self.order}

    def first_poll(self) -> BathReading:
        """With the gaps between rows read over, which a controller may refuse."""
        self.note_absent(self.rows_in_use)
        self.choose_blocks(gaps=True)
        try:
            return self.poll_now()
        except RefusedError as refused:
            if not refused.no_row:
                raise
        self.choose_blocks(gaps=False)
        return self.poll_now()

    def choose_blocks(self, *, gaps: bool) -> None:
        """Choose the questions of a poll, as `requests.blocks` does."""
        inferred = self.allow_inferred
        self._blocks = blocks(self.profile, gaps=gaps, inferred=inferred, without=self.absent)

    def fetch(self, start_s: float) -> Mapping[str, Raw]:
        found: dict[str, Raw] = {}
        for block in (asked := self._blocks):
            found |= block.split_rows(self._read(block.function, block.address, block.count))
            self.check_deadline(start_s, len(asked))
        return found

    def reading(self, t_s: float, raw: Mapping[str, Raw]) -> BathReading:
        """As `Access.reading`; raises ChangedError for another order of bytes, ProtocolError for
        one and the same word in every register.
        """
        profile = cast(RegisterProfile, self.profile)
        self.doubt = constant([int(word) for some in raw.values() for word in some])
        if self.doubt:
            hint = "Is this the controller's address and unit, and has it started?"
            asked = f"{len(raw)} rows of a poll"
            raise ProtocolError(self.who, f"no controller: {self.doubt}", asked=asked, hint=hint)
        if (source := profile.order_from) and source.row in raw:
            code = self.decode(self.row(source.row), raw[source.row])
            if profile.order_for(int(code)) != self.order:
                what, seen = "its order of bytes has changed", f"{code:g}"
                raise ChangedError(self.who, what, asked=source.row, seen=seen, hint="Ask again.")
        return super().reading(t_s, raw)

    def alarm_of(self, row: Row, value: float, raw: Raw) -> int:
        if row.no_value:  # an error code stands where the number would
            return int(raw[0]) if raw[0] in row.no_value.values() else 0
        return super().alarm_of(row, value, raw)

    def diagnoses(self, raw: Raw) -> Iterator[str]:
        """In degF, and in each other order of words."""
        row, words = self.row("temperature"), [int(word) for word in raw]
        yield from self.assembler.in_fahrenheit(row.decode(words, self.order))
        for order in get_args(Order):
            turned = decode(words, row.type, order) * row.scale
            if row.words > 1 and order != self.order and self.assembler.is_plausible(turned):
                where = "set order in the profile, or at the controller"
                yield f"In the order {order} it would be {turned:.1f} degC: {where}."

    def ask(self, row: Row) -> Sequence[int]:
        return self._read(self.profile.read_function(row.table), row.address, row.words)

    def decode(self, row: Row, raw: Raw) -> float:
        return row.decode(cast(Sequence[int], raw), self.order)

    def as_written(self, row: Row, value: float) -> float:
        return row.decode(row.encode(value, self.order), self.order)

    def write(self, row: Row, value: float, *, urgent: bool) -> None:
        words, function = row.encode(value, self.order), self.profile.write_function(row)
        self.wire.write(function, row.address, words, unit_id=self._unit_id, urgent=urgent)

    def show(self, rows: Sequence[Row]) -> Iterator[str]:
        for row in rows:
            value = self.decode(row, self.ask(row))
            number = f"{int(value):04X}" if row.name in HEXADECIMAL else f"{value:.10g} {row.unit}"
            yield number.rstrip() if row.is_possible(value) else NO_VALUE

    def asking(self, row: Row) -> str:
        return f"{row.table} {row.address}, {row.type}"

    def try_row(self, row: Row) -> tuple[float, str]:
        words = self.ask(row)
        self._tried += words
        self.doubt = constant(self._tried)
        raw, value = " ".join(f"{word:04X}" for word in words), self.decode(row, words)
        return value, f"{self.shown(row, value)} (got {raw})"

    def _read(self, function: int, address: int, count: int) -> Sequence[int]:
        return self.wire.read(function, address, count, unit_id=self._unit_id)
