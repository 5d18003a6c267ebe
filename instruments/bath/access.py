"""A controller's rows over the wire, whatever it speaks: read one by one or in a poll, written on
change, spaced, and read back.

What a protocol has to bring: how a row is read and written (``value``, ``write``), how the
controller is identified (``look``) and polled (``readings``).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from instruments.bath.profile import Device, Identity
from instruments.bath.quantity import Quantity
from instruments.bath.reading import BathReading
from instruments.bath.session import BrokenError, RefusedError, Session
from instruments.clock import Clock
from instruments.errors import (
    DeviceError,
    InstrumentError,
    LimitError,
    LinkError,
    ProtocolError,
    hex_bytes,
)

POLL_S = 4.0
NOT_READ = "only written"

D = TypeVar("D", bound=Device, covariant=True)


@dataclass(frozen=True, slots=True)
class Tried:
    """What became of one question for ``row``: what was ``asked``, what came, what it means."""

    row: str
    evidence: str
    asked: str
    answered: bool
    said: str


class Access(ABC, Generic[D]):
    """The rows of one device, for one thread, over ``wire``, which is not opened yet."""

    def __init__(
        self, profile: D, wire: Session, clock: Clock, *, who: str, allow_inferred: bool
    ) -> None:
        self.profile = profile
        self.wire = wire
        self.who = who
        self.allow_inferred = allow_inferred
        self.clock = clock
        self._set_at = -math.inf

    @property
    @abstractmethod
    def known(self) -> bool:
        """Whether it was looked at, so that it can be polled."""

    @abstractmethod
    def forget(self) -> None:
        """It has to be looked at anew."""

    @abstractmethod
    def look(self) -> tuple[BathReading, Mapping[str, str]]:
        """Identify the controller: its first reading, and what it shows of itself.

        Raises DeviceError when it is another family, is in another unit, or has no temperature, and
        ProtocolError when what it shows makes no sense.
        """

    @abstractmethod
    def poll(self) -> BathReading:
        """One poll, at the time of its start. Raises LinkError when it takes longer than POLL_S,
        and BrokenError before ``look``.
        """

    @abstractmethod
    def value(self, row: Quantity) -> float:
        """The value of ``row`` in its unit."""

    @abstractmethod
    def write(self, row: Quantity, value: float, *, urgent: bool) -> None:
        """Send ``value``; ``urgent``: at once, whatever late answer is still under way."""

    @abstractmethod
    def stands(self, row: Quantity, value: float, seen: float) -> bool:
        """Whether a row that shows ``seen`` was set to ``value``."""

    @abstractmethod
    def asking(self, row: Quantity) -> str:
        """How ``row`` is asked for, for a person."""

    @abstractmethod
    def try_row(self, row: Quantity) -> str:
        """What came for ``row`` and what it means, for a person; asked before any identification.
        Raises InstrumentError.
        """

    def tried(self, row: Quantity) -> Tried:
        """Ask for ``row``, whatever its evidence; writes nothing. Raises BrokenError."""
        if row.access == "w":
            return Tried(row.name, row.evidence, NOT_READ, answered=False, said="not tried")
        try:
            answered, said = True, self.try_row(row)
        except BrokenError:
            raise
        except InstrumentError as error:
            seen = error.seen if isinstance(error.seen, str) else hex_bytes(error.seen or b"")
            answered, said = False, f"{error.what} (got {seen})" if error.seen else error.what
        return Tried(row.name, row.evidence, self.asking(row), answered, said)

    def shown(self, row: Quantity, value: float) -> str:
        """``value`` with its label or unit. Raises ProtocolError for a code that it hasn't."""
        if math.isnan(value):
            return "no value now"
        if row.values and not row.alarm and not row.is_known(value):
            labels = ", ".join((*row.values, *row.seen))
            raise ProtocolError(self.who, f"{value:g} is none of {labels}", asked=row.name)
        return f"{row.label(value)} {row.unit}".strip()

    def row(self, name: str) -> Quantity:
        """The row called ``name``. Raises LimitError where the family has none."""
        row = self.profile.find(name)
        if row is None:
            names = ", ".join(sorted(known.name for known in self.profile.rows))
            what = f"{self.profile.family} has no '{name}'"
            raise LimitError(self.who, what, hint=f"It has: {names}.")
        return row

    def allowed(self, row: Quantity, value: float | str) -> float:
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

    def set(self, row: Quantity, value: float) -> None:
        """Write ``value`` where ``row`` has another, and read it back; a command in any case."""
        if row.access == "w" or not self.stands(row, value, self.value(row)):
            self.send(row, value)

    def send(self, row: Quantity, value: float, *, urgent: bool = False) -> None:
        """Write when the last write is long enough ago, and read back; ``urgent`` as in `write`."""
        self.clock.sleep(self._set_at + row.spacing_s - self.clock.now())
        try:
            self.write(row, value, urgent=urgent)
        finally:
            self._set_at = self.clock.now()
        if row.access == "w":
            return
        seen = self.value(row)
        if not self.stands(row, value, seen):
            raise DeviceError(
                self.who,
                "it confirmed a write and did not do it",
                asked=f"{row.name} = {row.label(value)}",
                seen=f"{row.name} = {row.label(seen)}",
                hint=self._why_not(),
            )

    def check(self, identity: Identity) -> None:
        """Raise DeviceError where a row shows another family."""
        row = self.row(identity.row)
        what = f"it is no {self.profile.family}"
        hint = f"Is it {identity.otherwise}? " if identity.otherwise else ""
        hint += "Give the rig the profile of the controller that is there."
        try:
            value = self.value(row)
        except RefusedError as error:
            if not self.lacks(error):
                raise
            raise DeviceError(self.who, what, asked=row.name, seen=error.seen, hint=hint) from error
        if not identity.fits(row, value):
            seen = f"{value:g} (hexadecimal {int(value) & 0xFFFFFFFF:04X})"
            raise DeviceError(self.who, what, asked=row.name, seen=seen, hint=hint)

    @abstractmethod
    def lacks(self, refused: RefusedError) -> bool:
        """Whether a refusal says that there is no such row."""

    def in_time(self, start_s: float, questions: int) -> None:
        """Raises LinkError where a poll of ``questions`` that began at ``start_s`` lasts too
        long.
        """
        took_s = self.clock.now() - start_s
        if took_s > POLL_S:
            asked = f"{questions} questions of a poll"
            raise LinkError(self.who, "it answers too slowly", asked=asked, seconds=took_s)

    def _why_not(self) -> str:
        remote = self.profile.find("remote")
        if remote is None:
            return "Switch it at the controller."
        shown = f"Its remote control is '{remote.label(self.value(remote))}'"
        return f"{shown}: set it to {self.remote} at the controller, or switch it by hand."

    @property
    @abstractmethod
    def remote(self) -> str:
        """What a controller's panel calls control by us."""
