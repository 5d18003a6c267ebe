"""A controller's rows over the wire, whatever its protocol: read one by one or in a poll, written
on change, spaced, and read back.

What a protocol has to bring: how a row is asked for (``ask``, ``decode``) and written (``write``),
how its format is detected and how a poll is fetched.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Generic, TypeVar, cast

from instruments.bath.profile import WATCHDOG, DeviceProfile, Profile
from instruments.bath.reading import Assembler, BathReading
from instruments.bath.rows import Quantity
from instruments.bath.session import BrokenError, RefusedError, Session
from instruments.errors import (
    DeviceError,
    InstrumentError,
    LimitError,
    LinkError,
    ProtocolError,
    hex_bytes,
)
from textfiles.text import sentence

POLL_S = 4.0
NOT_READ = "only written"
NO_VALUE = "no value that a device has"

R = TypeVar("R", bound=Quantity)
Raw = Sequence[int] | str  # registers, or a line


@dataclass(frozen=True, slots=True)
class RowAnswer:
    """The result of one question for ``row``: what was ``asked``; in ``said`` what came and what it
    means; ``sensible``: whether that can be its value.
    """

    row: str
    evidence: str
    asked: str
    answered: bool
    said: str
    sensible: bool = False

    @property
    def readable(self) -> bool:
        """Whether it can be asked for: some rows are only written."""
        return self.asked != NOT_READ


class Access(ABC, Generic[R]):
    """The rows of one device over ``wire``, which is not opened yet; for one thread. ``known``:
    whether it was identified; ``unit_confirmed``: a person has seen that its numbers are degC;
    ``absent``: rows that this model does not offer, and why; ``detected``: what `detect_format`
    found; ``remote``: what the panel calls remote control; ``SHOWN``: rows of model and versions.
    """

    remote: ClassVar[str]
    SHOWN: ClassVar[tuple[str, ...]]
    SHOWS_ABSENCE: ClassVar[tuple[type[InstrumentError], ...]]  # of a row that the model lacks

    def __init__(
        self, url: str, profile: DeviceProfile, wire: Session, *, who: str, allow_inferred: bool
    ) -> None:
        self.url = url
        self.profile = profile
        self.wire = wire
        self.clock = wire.clock
        self.who = who
        self.allow_inferred = allow_inferred
        self.known = self.unit_confirmed = False
        self.doubt = ""  # why what answers may be no controller at all
        self.absent: dict[str, str] = {}
        self.detected: dict[str, str] = {}
        self._set_at = -math.inf

    @abstractmethod
    def detect_format(self) -> None:
        """Find the controller's order of bytes, or its model. Raises ProtocolError, DeviceError."""

    @abstractmethod
    def first_poll(self) -> BathReading:
        """As `poll`; which questions are answered is not known yet."""

    @abstractmethod
    def fetch(self, start_s: float) -> Mapping[str, Raw]:
        """The answers of a poll that began at ``start_s``, by row."""

    @abstractmethod
    def ask(self, row: R) -> Raw:
        """What came for ``row``."""

    @abstractmethod
    def decode(self, row: R, raw: Raw) -> float:
        """The value of ``row`` in its unit; not-a-number where there is none."""

    @abstractmethod
    def show(self, rows: Sequence[R]) -> Iterator[str]:
        """The value of each of ``rows`` as text for a person."""

    @abstractmethod
    def diagnoses(self, raw: Raw) -> Iterator[str]:
        """What else an implausible temperature may mean."""

    @abstractmethod
    def write(self, row: R, value: float, *, urgent: bool) -> None:
        """Send ``value``; ``urgent``: at once, whatever late answer is still under way."""

    @abstractmethod
    def asking(self, row: R) -> str:
        """How ``row`` is asked for, for a person."""

    @abstractmethod
    def try_row(self, row: R) -> tuple[float, str]:
        """The value of ``row``, and the reply in words for a person. Raises InstrumentError."""

    def identify(self) -> tuple[BathReading, Mapping[str, str]]:
        """Identify the controller: its first reading, and what it shows of itself. Raises
        DeviceError for another family or unit or no temperature, ProtocolError for values that
        can't be.
        """
        self.detect_format()
        for identity in self.family.identity:
            row = self.row(identity.row)
            what = f"it is no {self.profile.family}"
            hint = f"Is it {identity.otherwise}? " if identity.otherwise else ""
            hint += "Give the rig the profile of the controller that is there."
            try:
                value = self.value(row)
            except RefusedError as error:
                if not error.no_row:
                    raise
                raise DeviceError(
                    self.who, what, asked=row.name, seen=error.seen, hint=hint
                ) from error
            if not identity.fits(row, value):
                seen = f"{value:g} (hexadecimal {int(value) & 0xFFFFFFFF:04X})"
                raise DeviceError(self.who, what, asked=row.name, seen=seen, hint=hint)
        reading = self.first_poll()
        rows = [row for row in map(self.find, self.SHOWN) if row and self.may_ask(row)]
        shown = dict(zip((row.name for row in rows), self.show(rows), strict=True))
        self.known = True
        missing = ", ".join(sorted(self.absent))
        missing_text = {"not offered by this model": missing} if missing else {}
        known = {"family": self.profile.family, "url": self.url, **self.detected, **missing_text}
        return reading, {**known, **shown}

    def poll(self) -> BathReading:
        """One poll, at the time of its start. Raises LinkError; BrokenError before `identify`."""
        if not self.known:  # an event of virtual time has dropped the link meanwhile
            raise self.wire.broken("the link is down")
        return self.poll_now()

    def poll_now(self) -> BathReading:
        """One poll, whether the controller was identified or not."""
        start_s = self.clock.now()
        return self.reading(start_s, self.fetch(start_s))

    def reading(self, t_s: float, raw: Mapping[str, Raw]) -> BathReading:
        """The reading in what came for each row. Raises as `Assembler.reading`."""
        rows = [self.row(name) for name in raw]
        values = {row.name: self.decode(row, raw[row.name]) for row in rows}
        alarms = (self.alarm_of(row, values[row.name], raw[row.name]) for row in rows)
        alarm, temperature = next(filter(None, alarms), 0), raw["temperature"]
        diagnoses = self.diagnoses(temperature)
        if isinstance(temperature, str):
            temperature = tuple(temperature.encode("ascii", errors="replace"))
        return self.assembler.reading(
            t_s, rows, values, temperature, alarm=alarm, diagnoses=diagnoses
        )

    @property
    def assembler(self) -> Assembler:
        """Makes readings of the profile's rows."""
        return Assembler(self.family, self.who)

    def alarm_of(self, row: R, value: float, raw: Raw) -> int:  # noqa: ARG002 - codes are values
        """The alarm that ``row`` shows; 0 for none."""
        return self.assembler.alarm_of(row, value)

    @property
    def family(self) -> Profile:
        """The profile of a controller."""
        return cast(Profile, self.profile)

    def offers(self, name: str) -> bool:
        """Whether the row called ``name`` may be asked for. Raises as `row`."""
        return self.may_ask(self.row(name))

    def may_ask(self, row: R) -> bool:
        """Whether it is read, offered by this model, and surely there or allowed by the rig."""
        known = row.evidence != "INFERRED" or self.allow_inferred
        return row.access != "w" and known and row.name not in self.absent

    def probe(self, row: R) -> object:
        """What came for ``row``, whatever it means."""
        return self.ask(row)

    def note_absent(self, rows: Sequence[R]) -> None:
        """Note which optional ``rows`` this model does not answer."""
        for row in rows:
            if row.optional and self.may_ask(row):
                try:
                    self.probe(row)
                except BrokenError:
                    raise
                except self.SHOWS_ABSENCE as error:
                    if isinstance(error, RefusedError) and not error.no_row:
                        raise
                    self.absent[row.name] = f"it does not answer {self.asking(row)}"

    @property
    def rows_in_use(self) -> list[R]:
        """The rows that are read without an order: those of a poll, of `SHOWN`, and their needs."""
        polled = [row for row in self.profile.rows if row.poll]
        needs = [name for row in polled for name in row.needs]
        names = dict.fromkeys((*(row.name for row in polled), *self.SHOWN, *needs))
        return [row for row in map(self.find, names) if row]

    def get(self, name: str) -> float:
        """The value of the row called ``name``. Raises as `row`, `value_in`."""
        return self.value(self.row(name))

    def value(self, row: R) -> float:
        """The value of ``row`` in its unit. Raises as ``value_in``."""
        if row.access == "w":
            raise LimitError(self.who, f"{row.name} is a command, and can't be read")
        if row.needs and not row.poll:  # its unit depends on another row
            self.check_needs(row)
        return self.value_in(row, self.ask(row))

    def value_in(self, row: R, raw: Raw) -> float:
        """The value in what came for ``row``. Raises ProtocolError for one that no device has."""
        value = self.decode(row, raw)
        if not row.is_possible(value):
            what = f"what came for its {row.name} is no value of a device"
            hint = "Another family or model than the profile's?"
            seen = raw if isinstance(raw, str) else " ".join(f"{word:04X}" for word in raw)
            raise ProtocolError(self.who, what, asked=self.asking(row), seen=seen, hint=hint)
        return value

    def check_needs(self, row: R) -> None:
        """Raise DeviceError where another row does not show what ``row`` needs."""
        for name, label in row.needs.items():
            other = self.find(name)
            if other is None or not self.may_ask(other):
                continue
            try:
                seen = self.value(other)
            except RefusedError:
                if other.optional:
                    continue
                raise
            if seen != other.codes[label]:
                raise self.not_met(row, other, label, seen)

    def not_met(self, row: Quantity, other: Quantity, label: str, seen: float) -> DeviceError:
        """The error of ``row``, which needs ``label`` of a row that shows ``seen``."""
        what = f"the {row.name} needs {other.name} = {label}"
        hint = f"{sentence(other.meaning)} " if other.meaning else ""
        hint += "Change it at the controller."
        return DeviceError(self.who, what, asked=other.name, seen=other.label(seen), hint=hint)

    def as_written(self, row: R, value: float) -> float:  # noqa: ARG002 - registers round it
        """What ``row`` can hold of ``value``."""
        return value

    def stands(self, row: R, value: float, seen: float) -> bool:
        """Whether a row that shows ``seen`` was set to ``value``."""
        wanted = self.as_written(row, value)
        return seen == wanted or abs(seen - wanted) <= max(row.tolerance, 1e-9)

    def rows_to_try(self) -> Sequence[R]:
        """The rows to ask while a profile is being made; those of the model where it is known."""
        return cast("Sequence[R]", self.profile.rows)

    def tries(self) -> Iterator[Callable[[], RowAnswer]]:
        """A question for each of them. They raise BrokenError."""
        return (partial(self.tried, row) for row in self.rows_to_try())

    def tried(self, row: R) -> RowAnswer:
        """Ask for ``row``, whatever its evidence; writes nothing. Raises BrokenError."""
        if row.access == "w":
            return RowAnswer(row.name, row.evidence, NOT_READ, answered=False, said="not tried")
        value = math.nan
        try:
            answered, (value, said) = True, self.try_row(row)
        except BrokenError:
            raise
        except InstrumentError as error:
            seen = error.seen if isinstance(error.seen, str) else hex_bytes(error.seen or b"")
            answered, said = False, f"{error.what} (got {seen})" if error.seen else error.what
        sensible = answered and self._makes_sense(row, value)
        if answered and not sensible:
            said = f"can't be its value (got {said.rpartition('(got ')[2]}"
        elif answered and row.by_model and row.name in self.absent:
            sensible = False
            said += f"; models differ here, and {self.absent[row.name]}: see [[models]]"
        return RowAnswer(row.name, row.evidence, self.asking(row), answered, said, sensible)

    def _makes_sense(self, row: R, value: float) -> bool:
        """Whether ``value`` can be what ``row`` shows: a bath's temperature, a part of 100 %."""
        if row.poll and row.unit == "degC" and not math.isnan(value):
            return self.assembler.is_plausible(value)
        return row.is_possible(value)

    def shown(self, row: R, value: float) -> str:
        """``value`` with its label or unit. Raises ProtocolError for a code that it hasn't."""
        if math.isnan(value):
            return "no value now"
        if row.values and not row.alarm and not row.is_known(value):
            labels = ", ".join((*row.values, *row.seen))
            raise ProtocolError(self.who, f"{value:g} is none of {labels}", asked=row.name)
        return f"{row.label(value)} {row.unit}".strip()

    def find(self, name: str) -> R | None:
        """The row called ``name``; None where the family has none."""
        return cast("R | None", self.profile.find(name))

    def row(self, name: str) -> R:
        """The row called ``name``. Raises LimitError where the family or the model has none."""
        row = self.find(name)
        if name in self.absent:
            what = f"'{name}' is not offered by this model: {self.absent[name]}"
            hint = "'teatbench bath learn' shows what it answers, row by row."
            raise LimitError(self.who, what, hint=hint)
        if row is None:
            names = ", ".join(sorted(known.name for known in self.profile.rows))
            what = f"{self.profile.family} has no '{name}'"
            raise LimitError(self.who, what, hint=f"It has: {names}.")
        return row

    def allowed(self, name: str, value: float | str) -> float:
        """The number to write. Raises LimitError when the profile does not allow it."""
        row = self.row(name)
        if isinstance(value, str):
            if value not in row.values:
                hint = f"There are: {', '.join(row.values) or 'none'}."
                raise LimitError(self.who, f"{row.name} has no value '{value}'", hint=hint)
            value = row.values[value]
        if refusal := row.refusal(value):
            raise LimitError(self.who, f"not written: {refusal}", asked=f"{row.name} = {value:g}")
        if row.evidence == "INFERRED" and not self.allow_inferred:
            what = f"not written: the profile only infers where {row.name} is"
            hint = (
                "Check it on the controller, then set [bath] allow_inferred = true in the rig file."
            )
            raise LimitError(self.who, what, hint=hint)
        standby = row.name == "run" and value == row.values.get("standby")
        if self.unit_unknown and not (self.unit_confirmed or standby or row.name == WATCHDOG):
            raise self.unconfirmed()
        return value

    @property
    def unit_unknown(self) -> bool:
        """Whether nothing states the unit of its numbers."""
        profile = self.profile
        if not isinstance(profile, Profile) or profile.number_unit.fixed:
            return False
        return not any(
            row and self.may_ask(row) for row in map(self.find, profile.number_unit.rows)
        )

    @property
    def unit_source(self) -> str:
        """How the unit of its numbers is known."""
        number_unit = self.family.number_unit
        if number_unit.fixed:
            return f"{number_unit.fixed}, by its protocol"
        if not self.unit_unknown:
            return "degC, as it shows itself"
        return "degC, as a person saw" if self.unit_confirmed else "not stated by the controller"

    def unconfirmed(self) -> LimitError:
        """The error of a write before a person has confirmed the unit."""
        note = self.family.number_unit.note
        what = "not written: nothing tells whether its numbers are degC"
        hint = (
            "Compare its display with 'teatbench bath read'. Where both show the same, in degC,"
            " give 'bath set' what the display shows (--display 21.4), or write the day into"
            ' [bath] of the rig file: unit_confirmed = "2026-11-20".'
        )
        return LimitError(self.who, f"{what} ({note})" if note else what, hint=hint)

    def set(self, name: str, value: float) -> None:
        """Write ``value`` where the row has another, and read it back; a command in any case.
        Raises DeviceError where another row is not as this one needs it.
        """
        row = self.row(name)
        self.check_needs(row)
        if row.access == "w" or not self.stands(row, value, self.value(row)):
            self.send(row, value)

    def send(self, row: R, value: float, *, urgent: bool = False) -> None:
        """Write when the last write is long enough ago, and read back; ``urgent`` as in `write`."""
        self.clock.sleep(self._set_at + row.spacing_s - self.clock.now())
        try:
            self.write(row, value, urgent=urgent)
        finally:
            self._set_at = self.clock.now()
        if row.access == "w" or self.stands(row, value, seen := self.value(row)):
            return
        hint = "Switch it at the controller."
        if remote := self.find("remote"):
            shown = f"Its remote control is '{remote.label(self.value(remote))}'"
            hint = f"{shown}: set it to {self.remote} at the controller, or switch it by hand."
        raise DeviceError(
            self.who,
            "it confirmed a write and did not do it",
            asked=f"{row.name} = {row.label(value)}",
            seen=f"{row.name} = {row.label(seen)}",
            hint=hint,
        )

    def run_rows(self) -> Sequence[R]:
        """Rows that may be its run, while its model is not known."""
        return [self.row("run")]

    def stand_by(self) -> None:
        """Standby at once, identified or not. Raises as `send`."""
        first, *others = self.run_rows()
        try:
            self.send(first, first.values["standby"], urgent=True)
        except RefusedError:
            if not others:
                raise
            for row in others:
                self.send(row, row.values["standby"], urgent=True)

    def check_deadline(self, start_s: float, questions: int) -> None:
        """Raises LinkError where a poll that began at ``start_s`` took too long."""
        took_s = self.clock.now() - start_s
        if took_s > POLL_S:
            asked = f"{questions} questions of a poll"
            raise LinkError(self.who, "it answers too slowly", asked=asked, seconds=took_s)
