"""A device of some make as data, read from a TOML file: how it is spoken to, its rows, and the
checks of both. All faults of a file are reported at once, each with its key. Pure.

A row is known to the driver and the emulator by its name (``temperature``, ``set_point``, ``run``
...); a family that lacks a row lacks the thing. What a code means is a label in the row, so the
driver writes ``started`` and never a number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, TypeVar

from pydantic import Field, ValidationError, model_validator

from instruments.bath.checksums import Checksum
from instruments.bath.connection import MODBUS_PORT, Line, LineError, parse_line
from instruments.bath.rows import (
    NEEDED,
    Evidence,
    LineRow,
    Order,
    Quantity,
    Row,
    Strict,
    Table,
    fits,
)
from instruments.device_file import DeviceFileError, FaultsError, Keys, read_device
from instruments.errors import LinkError
from instruments.port_settings import PortSettings

PUMP = "pump"  # the row of a pump that is switched by itself
WATCHDOG = "watchdog"  # the row of the seconds without a message after which it stops; 0: never
ReadFunction = Literal[1, 2, 3, 4]
WriteFunction = Literal[5, 6, 16]
Functions = Annotated[tuple[ReadFunction | WriteFunction, ...], Field(min_length=1)]
# first choice first
READERS: dict[Table, tuple[ReadFunction, ...]] = {
    "holding": (3, 4),
    "input": (4,),
    "coil": (1, 2),
    "discrete": (2,),
}
REACHED_BY = {  # a transport, as a URL
    "tcp": "tcp://host:port",
    "rtu": "rtu+tcp://host:port or a serial port",
    "serial": "a serial port, or rfc2217://host:port",
}

Made = TypeVar("Made", bound="DeviceProfile")
Faults = Iterator[tuple[Keys, str]]


class DeviceProfile(Strict):
    """A device of some make: how it is spoken to, and its rows. ``timeout_s``: the wait for an
    answer; ``quiet_s``: how much later one may still come.
    """

    family: str
    source: str
    transports: Annotated[tuple[str, ...], Field(min_length=1)]
    baud: Annotated[int, Field(ge=300, le=921600)] = 9600
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    bytesize: Literal[7, 8] = 8
    timeout_s: Annotated[float, Field(ge=0.05, le=10.0)] = 1.0
    quiet_s: Annotated[float, Field(ge=0.05, le=10.0)] = 0.5
    rows: Annotated[tuple[Quantity, ...], Field(min_length=1)]

    @property
    def serial(self) -> PortSettings:
        """Its serial port, where a URL does not say otherwise."""
        return PortSettings(self.parity, self.stopbits, self.bytesize)

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if faults := list(self.faults()):
            raise FaultsError(faults)
        return self

    def faults(self) -> Faults:
        """What is wrong with the rows, each and together."""
        names = [row.name for row in self.rows]
        for at, row in enumerate(self.rows):
            for fault in row.faults():
                yield ("rows", at), f"{row.name}: {fault}"
            if row.name in names[:at]:
                yield ("rows", at, "name"), f"a second row '{row.name}'"

    def find(self, name: str) -> Quantity | None:
        """The row called ``name``, or None where the family has none."""
        for row in self.rows:  # a generator takes twice as long, and each poll asks for thirty
            if row.name == name:
                return row
        return None

    def row(self, name: str) -> Quantity:
        """The row called ``name``. Raises KeyError where the family has none."""
        row = self.find(name)
        if row is None:
            raise KeyError(f"{self.family} has no row '{name}'")
        return row


class ModbusDevice(DeviceProfile):
    """A Modbus device with its ``functions``; with ``alike``, 3 and 4 read the same registers. From
    address ``pairs_from`` on, registers are read and written in pairs.
    """

    transports: Annotated[tuple[Literal["tcp", "rtu"], ...], Field(min_length=1)]
    functions: Functions = (3, 4, 6, 16)
    alike: bool = False
    pairs_from: Annotated[int, Field(ge=0, le=0xFFFE)] | None = None
    unit_id: Annotated[int, Field(ge=1, le=254)] = 1
    unit_id_evidence: Evidence = "INFERRED"
    order: Order = "ABCD"
    rows: Annotated[tuple[Row, ...], Field(min_length=1)]

    if TYPE_CHECKING:  # its rows are of one kind

        def find(self, name: str) -> Row | None: ...
        def row(self, name: str) -> Row: ...

    def faults(self) -> Faults:
        yield from super().faults()
        for at, row in enumerate(self.rows):
            for fault in self._unreachable(row):
                yield ("rows", at), f"{row.name}: {fault}"
        places = sorted(enumerate(self.rows), key=lambda place: (place[1].table, place[1].address))
        for (_, first), (at, row) in combinations(places, 2):
            if row.table == first.table and row.address < first.end:
                what = f"{row.name} at {row.table} {row.address}"
                yield ("rows", at, "address"), f"{what} overlaps {first.name} at {first.address}"

    def _unreachable(self, row: Row) -> Iterator[str]:
        known = ", ".join(map(str, self.functions))
        if "r" in row.access and not set(READERS[row.table]) & set(self.functions):
            yield f"none of the functions {known} reads table {row.table}"
        if "w" in row.access and not set(_writers(row)) & set(self.functions):
            yield f"none of the functions {known} writes {row.type}"
        pairs = self.pairs_from
        if pairs is not None and row.address >= pairs and (row.address % 2 or row.words != 2):
            yield f"from {pairs} on, rows take two registers at an even address"

    def read_function(self, table: Table) -> ReadFunction:
        """The function that reads ``table``, where a row to be read is."""
        return next(function for function in READERS[table] if function in self.functions)

    def write_function(self, row: Row) -> WriteFunction:
        """The function that writes ``row``, which may be written."""
        return next(function for function in _writers(row) if function in self.functions)


def _writers(row: Row) -> tuple[WriteFunction, ...]:
    return (5,) if row.type == "bit" else (6, 16) if row.words == 1 else (16,)


class RelayProfile(ModbusDevice):
    """A device that switches a pump: its row ``pump`` has the values ``on`` and ``off``."""

    def faults(self) -> Faults:
        yield from super().faults()
        pump = self.find(PUMP)
        if pump is None:
            yield ("rows",), "the row 'pump' is missing"
        elif not _is_switch(pump):
            at = self.rows.index(pump)
            yield ("rows", at), "pump: access 'rw' and the labels 'on' and 'off' are needed"


def _is_switch(row: Quantity) -> bool:
    return row.access == "rw" and {"on", "off"} <= set(row.values)


WATCHDOG_LEAST_S = 10.0  # a poll that is tried again has to feed it
AlarmCause = Literal["level", "sensor", "over-temperature", "other"]
CommsLoss = Literal["hold", "stop", "safe_setpoint", "unknown"]
SHIPPED = Path(__file__).with_name("profiles")
RELAYS = SHIPPED / "relays"


class Capabilities(Strict):
    """What the family can do. ``pump = "with run"``: only while the controller is started."""

    pump: Literal["none", "with run", "own"] = "none"
    level: Literal["none", "alarm"] = "none"
    external_sensor: bool = False
    safety_sensor: bool = False


class NumberUnit(Strict):
    """The unit of the numbers on the wire: what ``rows`` show, each of which has to be degC, or
    ``fixed`` by the protocol. Neither: nothing states it, and ``note`` says what is known.
    """

    rows: tuple[str, ...] = ()
    fixed: Literal["", "degC"] = ""
    note: str = ""

    @property
    def known(self) -> bool:
        """Whether rows or the protocol state it."""
        return bool(self.rows or self.fixed)


class OrderFrom(Strict):
    """The row that gives the order of bytes (it has one of its own), and what its codes mean."""

    row: str
    codes: dict[str, Order]


class AlarmCode(Strict):
    """The meaning of a code in an alarm row; in a word of bits it is the bit's weight."""

    code: int
    cause: AlarmCause
    text: str
    evidence: Evidence


class IdentityCheck(Strict):
    """What ``row`` shows: ``equals`` after ``mask``, or not ``differs``, or else a known code."""

    row: str
    mask: Annotated[int, Field(ge=1, le=0xFFFFFFFF)] = 0xFFFFFFFF
    equals: int | None = None
    differs: int | None = None
    otherwise: str = ""  # what it is when it is another

    def fits(self, row: Quantity, value: float) -> bool:
        """Whether a controller that shows ``value`` there may be of the family."""
        if self.equals is not None:
            return int(value) & self.mask == self.equals
        if self.differs is not None:
            return int(value) & self.mask != self.differs
        return row.is_known(value)


class Profile(DeviceProfile):
    """A family of controllers. ``panel_rows`` may be changed at its panel; ``number_unit``: where
    the unit of its numbers stands; ``remote_label``: the value of the row ``remote`` under our
    control. ``watchdog_s``: what its row ``watchdog`` is set to while we heat.
    """

    remote_label: ClassVar[str] = "remote"
    comms_loss: CommsLoss
    comms_loss_evidence: Evidence
    watchdog_s: Annotated[float, Field(ge=WATCHDOG_LEAST_S, le=600.0)] | None = None
    plausible_c: tuple[float, float] = (-5.0, 60.0)
    number_unit: NumberUnit = NumberUnit()
    capabilities: Capabilities = Capabilities()
    identity: tuple[IdentityCheck, ...] = ()
    # row -> label to be seen before heating, written where it is another
    before_start: dict[str, str] = Field(default_factory=dict)
    alarms: tuple[AlarmCode, ...] = ()

    @property
    def panel_rows(self) -> set[str]:
        return set(self.number_unit.rows)

    def alarm_text(self, code: int) -> str:
        """What an alarm (``BathReading.alarm``) means, with a note where that is inferred."""
        known = self._alarms(code)
        if not known:
            return f"alarm {code}, see the controller's manual"
        inferred = any(alarm.evidence == "INFERRED" for alarm in known)
        doubt = " (meaning inferred)" if inferred else ""
        return f"alarm {code}, {' and '.join(alarm.text for alarm in known)}{doubt}"

    def means(self, code: int, cause: AlarmCause) -> bool:
        """Whether an alarm has this cause."""
        return any(alarm.cause == cause for alarm in self._alarms(code))

    def _alarms(self, code: int) -> list[AlarmCode]:
        known = [alarm for alarm in self.alarms if alarm.code == code]
        if not known and any(row.alarm == "bits" for row in self.rows):
            known = [alarm for alarm in self.alarms if alarm.code & code]
        return known

    def faults(self) -> Faults:
        yield from super().faults()
        at = {row.name: index for index, row in enumerate(self.rows)}
        for name in ("temperature", "set_point", "run"):
            if name not in at:
                how = (
                    " (a controller without one: 'teatbench help add-a-bath')"
                    if name == "run"
                    else ""
                )
                yield ("rows",), f"the row '{name}' is missing{how}"
        for name in {"run", "set_point"} & set(at):
            if self.row(name).access != "rw":
                what = "the bench has to read and write it, so access must be 'rw'"
                yield ("rows", at[name], "access"), f"{name}: {what}"
        for name in self.panel_rows & set(at):
            if not self.row(name).poll:
                yield (
                    ("rows", at[name]),
                    f"{name}: it may be changed at the panel, so it has to be polled",
                )
        pump, run = self.find(PUMP), self.find("run")
        if self.capabilities.pump == "own" and not (pump and _is_switch(pump)):
            what = "an own pump needs a row 'pump' with access 'rw' and the labels 'on' and 'off'"
            yield ("capabilities", "pump"), what
        if run is not None and not {"standby", "started"} <= set(run.values):
            yield (
                ("rows", at["run"], "values"),
                "run: the labels 'standby' and 'started' are needed",
            )
        watchdog = self.find(WATCHDOG)
        if self.watchdog_s is not None and not (watchdog and watchdog.access == "rw"):
            yield ("watchdog_s",), "it needs a row 'watchdog' with access 'rw'"
        yield from self._reference_faults()

    def _reference_faults(self) -> Faults:
        for name in self.number_unit.rows:
            row = self.find(name)
            if row is None or "c" not in row.values:
                what = f"there is no row '{name}' with the value 'c' (degC)"
                yield ("number_unit", "rows"), what
        if self.number_unit.rows and self.number_unit.fixed:
            what = "either rows tell the unit, or it is fixed"
            yield ("number_unit", "fixed"), what
        yield from self._need_faults()
        for index, identity in enumerate(self.identity):
            if self.find(identity.row) is None:
                yield ("identity", index, "row"), f"there is no row '{identity.row}'"
        for name, label in self.before_start.items():
            setting = self.find(name)
            if setting is None or label not in setting.values or setting.access != "rw":
                what = f"there is no row '{name}' that may be written with the value '{label}'"
                yield ("before_start", name), what

    def _need_faults(self) -> Faults:
        for place, one in enumerate(self.rows):
            for name, label in one.needs.items():
                other = self.find(name)
                if other is None or label not in other.codes:
                    what = f"{one.name}: there is no row '{name}' that can show '{label}'"
                    yield ("rows", place, "needs"), what


class RegisterProfile(ModbusDevice, Profile):
    """A family that speaks Modbus."""

    remote_label: ClassVar[str] = "modbus"
    order_from: OrderFrom | None = None

    @property
    def panel_rows(self) -> set[str]:
        return super().panel_rows | ({self.order_from.row} if self.order_from else set())

    def order_for(self, code: int) -> Order | None:
        """The order that a code of the ``order_from`` row means; None for an unknown code."""
        return self.order_from.codes.get(str(code)) if self.order_from else self.order

    def faults(self) -> Faults:
        yield from super().faults()
        if source := self.order_from:
            row = self.find(source.row)
            if row is None or row.order is None:
                what = f"there is no row '{source.row}' with an order of its own"
                yield ("order_from", "row"), what


class Model(Strict):
    """Models whose marker's reply has a form of ``shows``, or that do not answer the row
    ``unanswered``. ``offers``: their rows of those that go ``by_model``; ``rows``: other keys of a
    row, which they have too; ``lacks``: rows that they don't have.
    """

    shows: tuple[str, ...] = ()
    unanswered: str = ""
    offers: tuple[str, ...] = ()
    lacks: tuple[str, ...] = ()
    rows: dict[str, dict[str, Any]] = Field(default_factory=dict)
    evidence: Evidence = "FIELD"
    source: str = ""

    def fits(self, mark: str) -> bool:
        """Whether a controller whose marker says ``mark`` is one of these."""
        return any(fits(form, mark) for form in self.shows)


class LineProfile(Profile):
    """A family that speaks lines of ASCII. ``marker``: the row whose reply can be no other row's.
    ``confirm``: the reply to a write; ``refusals``: forms of replies that refuse, with their
    meaning. ``gap_s``: the pause after a reply; ``settle_s``: until a write can be read back.
    ``checksum``: of a line, behind its first ``checksum_skip`` characters. ``models``: the first
    one that fits counts.
    """

    kind: Literal["line"]
    transports: Annotated[tuple[Literal["tcp", "serial"], ...], Field(min_length=1)]
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    handshake: Literal["none", "rtscts", "xonxoff"] = "none"
    end: Annotated[str, Field(min_length=1, max_length=2)] = "\r"
    reply_end: Annotated[str, Field(min_length=1, max_length=2)] = "\n"
    marker: str
    confirm: str = ""
    refusals: dict[str, str] = Field(default_factory=dict)
    gap_s: Annotated[float, Field(ge=0.0, le=2.0)] = 0.0
    settle_s: Annotated[float, Field(ge=0.0, le=5.0)] = 0.0
    checksum: Checksum = "none"
    checksum_skip: Annotated[int, Field(ge=0, le=8)] = 0
    models: tuple[Model, ...] = ()
    rows: Annotated[tuple[LineRow, ...], Field(min_length=1)]

    if TYPE_CHECKING:

        def find(self, name: str) -> LineRow | None: ...
        def row(self, name: str) -> LineRow: ...

    @property
    def serial(self) -> PortSettings:
        return replace(super().serial, handshake=self.handshake)

    def refusal(self, reply: str) -> str | None:
        """What a reply means that refuses; None for any other."""
        forms = (form for form in self.refusals if fits(form, reply))
        exact = self.refusals.get(reply)
        return exact or next((self.refusals[form] for form in forms), None)

    def of_model(self, model: Model | None) -> LineProfile:
        """What is left of the family for one of its models; for none that is listed, None."""
        known = model or Model()
        offered = {*known.offers, *known.rows}
        rows = []
        for row in self.rows:
            gone = row.name in known.lacks or (row.by_model and row.name not in offered)
            if not gone:
                merged = row.model_dump(exclude_unset=True) | known.rows.get(row.name, {})
                rows.append(LineRow.model_validate(merged))
        return self.model_copy(update={"rows": tuple(rows)})

    def faults(self) -> Faults:
        yield from super().faults()
        marker = self.find(self.marker)
        if marker is None or not marker.ask:
            yield ("marker",), f"there is no row '{self.marker}' that can be asked"
        elif marker.is_number:
            yield ("marker",), f"the reply of '{self.marker}' is a number, as other rows' are"
        for key in ("end", "reply_end"):
            if getattr(self, key).strip("\r\n"):
                yield (key,), "a carriage return, a line feed or both are needed"
        for at, model in enumerate(self.models):
            for what in self._model_faults(model):
                yield ("models", at), what

    def _model_faults(self, model: Model) -> Iterator[str]:
        if bool(model.shows) == bool(model.unanswered):
            yield "either 'shows' or 'unanswered' is needed"
        named = {*model.offers, *model.lacks, *model.rows, *filter(None, [model.unanswered])}
        if unknown := sorted(name for name in named if self.find(name) is None):
            yield f"there is no row '{unknown[0]}'"
            return
        if needed := sorted({*model.lacks} & {*NEEDED, self.marker}):
            yield f"the bench can't do without the row '{needed[0]}'"
        try:
            rows = self.of_model(model).rows
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            yield f"rows.{'.'.join(map(str, first['loc']))}: {first['msg'].lower()}"
            return
        for row in rows:
            yield from (f"{row.name}: {fault}" for fault in row.faults())


def line_to(url: str, profile: DeviceProfile, who: str) -> Line:
    """The line that ``url`` names, else the profile's. Raises LinkError for another kind."""
    lines = profile if isinstance(profile, LineProfile) else None
    port = lines.port if lines else MODBUS_PORT
    try:
        line = parse_line(url, port=port, baud=profile.baud, serial=profile.serial)
    except LineError as error:
        raise LinkError(who, str(error)) from error
    what, hint = "", ""
    if ("serial" if lines and line.is_port else line.transport) not in profile.transports:
        spoken = "lines of ASCII there" if lines else f"Modbus {line.transport.upper()}"
        what = f"{profile.family} does not speak {spoken}"
        hint = f"It has: {'; '.join(REACHED_BY[transport] for transport in profile.transports)}."
    elif lines and line.unit_id is not None:
        what, hint = "a line of ASCII has no unit", "Leave '?unit=' out of the URL."
    elif not lines and line.serial.bytesize == 7:
        what = "Modbus RTU has 8 data bits, and the URL says 7"
        hint = "Leave bytesize out of the URL, or set it to 8."
    if what:
        raise LinkError(who, what, hint=hint)
    return line


def load_profile(name_or_path: str | Path) -> Profile:
    """A shipped profile by its name, or any by its path (``*.toml``). Raises DeviceFileError."""
    return _load(name_or_path, SHIPPED, "shipped profiles", _profile_of)


def _profile_of(content: Mapping[str, Any]) -> type[Profile]:
    return LineProfile if "kind" in content else RegisterProfile


def _relay_of(_: object) -> type[RelayProfile]:
    return RelayProfile


def load_relay(name_or_path: str | Path) -> RelayProfile:
    """As `load_profile`, for the relay of a pump."""
    return _load(name_or_path, RELAYS, "shipped profiles of relays", _relay_of)


def _load(
    name_or_path: str | Path,
    shipped: Path,
    what: str,
    kind: Callable[[Mapping[str, Any]], type[Made]],
) -> Made:
    path = Path(name_or_path)
    path = path if path.suffix == ".toml" else shipped / f"{name_or_path}.toml"
    try:
        return read_device(path, kind)
    except OSError as error:
        there = f"can't be read: {error.strerror}; {what}: {', '.join(_names(shipped))}"
        raise DeviceFileError(path, [((), there)]) from error


def _names(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.glob("*.toml"))


def profile_names() -> list[str]:
    return _names(SHIPPED)


def relay_names() -> list[str]:
    return _names(RELAYS)
