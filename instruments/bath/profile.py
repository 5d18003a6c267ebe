"""What a controller family calls its registers: one TOML file a family, read and checked here.

A row is known to the driver and the emulator by its name (``temperature``, ``set_point``, ``run`` ...); a family
that lacks a row lacks the thing. What a code means is a label in the row, so the driver writes ``started`` and
never a number. Pure: it may not know a clock, a socket or a Modbus library.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError, model_validator

from instruments.bath.registers import Order
from instruments.bath.rows import Evidence, Row, Strict, Table

AlarmCause = Literal["level", "sensor", "over-temperature", "other"]
CommsLoss = Literal["hold", "stop", "safe_setpoint", "unknown"]

SHIPPED = Path(__file__).with_name("profiles")
NEEDED = ("temperature", "set_point", "run")
MOST_WORDS = 125  # a read answers no more (Modbus application protocol 1.1b3, section 6.3)


class ProfileError(ValueError):
    """A profile with faults: ``path`` of the file, ``faults`` as (key path, message), all at once."""

    def __init__(self, path: Path, faults: Sequence[tuple[str, str]]) -> None:
        self.path = path
        self.faults = tuple(faults)
        super().__init__(f"{path}: " + "; ".join(f"{key}: {message}" if key else message for key, message in faults))


class Capabilities(Strict):
    """What the family can do. ``pump = "with run"``: it turns while the controller is started, and not alone."""

    pump: Literal["none", "with run", "own"] = "none"
    level: Literal["none", "alarm"] = "none"
    external_sensor: bool = False
    safety_sensor: bool = False


class OrderFrom(Strict):
    """The row that tells the order of bytes, and which code means which; it has an order of its own."""

    row: str
    codes: dict[str, Order]


class AlarmCode(Strict):
    """What a code in the row ``alarm`` means."""

    code: int
    cause: AlarmCause
    text: str
    evidence: Evidence


class Profile(Strict):
    """One controller family."""

    family: str
    source: str
    transports: Annotated[tuple[Literal["tcp", "rtu"], ...], Field(min_length=1)]
    unit_id: Annotated[int, Field(ge=1, le=247)] = 1
    unit_id_evidence: Evidence = "INFERRED"
    order: Order = "ABCD"
    order_from: OrderFrom | None = None
    write_single: Literal["write single", "write multiple"] = "write single"
    comms_loss: CommsLoss
    comms_loss_evidence: Evidence
    plausible_c: tuple[float, float] = (-5.0, 60.0)
    capabilities: Capabilities = Capabilities()
    before_start: dict[str, str] = Field(default_factory=dict)  # row -> label to be seen before heating, written where it is another
    rows: Annotated[tuple[Row, ...], Field(min_length=1)]
    alarms: tuple[AlarmCode, ...] = ()

    @model_validator(mode="after")
    def _whole(self) -> Profile:
        faults = list(_faults(self))
        if faults:
            raise _FaultsError(faults)
        return self

    def find(self, name: str) -> Row | None:
        """The row called ``name``, or None where the family has none."""
        return next((row for row in self.rows if row.name == name), None)

    def row(self, name: str) -> Row:
        """The row called ``name``. Raises KeyError where the family has none."""
        row = self.find(name)
        if row is None:
            raise KeyError(f"{self.family} has no row '{name}'")
        return row

    def order_for(self, code: int) -> Order | None:
        """The order that a code of the ``order_from`` row means, or None for a code that means nothing."""
        return self.order_from.codes.get(str(code)) if self.order_from else self.order

    def alarm_text(self, code: int) -> str:
        """What an alarm code means, with a word of doubt where that is inferred."""
        known = next((alarm for alarm in self.alarms if alarm.code == code), None)
        if known is None:
            return f"alarm {code}, see the controller's manual"
        return f"alarm {code}, {known.text}" + (" (meaning inferred)" if known.evidence == "INFERRED" else "")

    def blocks(self, *, gaps: bool) -> list[Block]:
        """What to ask for in one poll: the polled rows in as few reads as go.

        ``gaps`` reads over addresses that no row claims, which a controller may refuse.
        """
        blocks: list[Block] = []
        for row in sorted((row for row in self.rows if row.poll), key=lambda row: (row.table, row.address)):
            last = blocks[-1] if blocks else None
            if last and last.table == row.table and row.end - last.address <= MOST_WORDS and (gaps or row.address == last.end):
                blocks[-1] = Block(last.table, (*last.rows, row))
            else:
                blocks.append(Block(row.table, (row,)))
        return blocks


@dataclass(frozen=True, slots=True)
class Block:
    """Rows that one read fetches: ``count`` registers of ``table`` from ``address``."""

    table: Table
    rows: tuple[Row, ...]

    @property
    def address(self) -> int:
        """The first register."""
        return self.rows[0].address

    @property
    def end(self) -> int:
        """The register behind the last."""
        return self.rows[-1].end

    @property
    def count(self) -> int:
        """How many registers."""
        return self.end - self.address


class _FaultsError(ValueError):
    def __init__(self, faults: list[tuple[str, str]]) -> None:
        self.faults = faults
        super().__init__("; ".join(message for _, message in faults))


def _faults(profile: Profile) -> Iterator[tuple[str, str]]:
    for at, row in enumerate(profile.rows):
        yield from ((f"rows.{at}", f"{row.name}: {fault}") for fault in row.faults())
    names = [row.name for row in profile.rows]
    yield from ((f"rows.{at}.name", f"a second row '{name}'") for at, name in enumerate(names) if name in names[:at])
    yield from (("rows", f"the row '{name}' is missing") for name in NEEDED if name not in names)
    yield from _overlaps(profile.rows)
    if profile.order_from and getattr(profile.find(profile.order_from.row), "order", None) is None:
        yield "order_from.row", f"there is no row '{profile.order_from.row}' with an order of its own"
    for name, label in profile.before_start.items():
        setting = profile.find(name)
        if setting is None or label not in setting.values:
            yield f"before_start.{name}", f"there is no row '{name}' with the value '{label}'"
    run = profile.find("run")
    if run is not None and not {"standby", "started"} <= set(run.values):
        yield f"rows.{names.index('run')}.values", "run: the labels 'standby' and 'started' are needed"


def _overlaps(rows: Sequence[Row]) -> Iterator[tuple[str, str]]:
    """Every pair that shares an address, whatever lies between them in the file."""
    places = sorted(enumerate(rows), key=lambda place: (place[1].table, place[1].address))
    for i, (_, first) in enumerate(places):
        for at, second in places[i + 1 :]:
            if second.table != first.table or second.address >= first.end:
                break
            yield f"rows.{at}.address", f"{second.name} at {second.table} {second.address} overlaps {first.name} at {first.address}"


def load_profile(name_or_path: str | Path) -> Profile:
    """A shipped profile by its name (``julabo-presto``), or any profile by its path. Raises ProfileError."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = SHIPPED / f"{name_or_path}.toml"
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        shipped = ", ".join(profile_names())
        raise ProfileError(path, [("", f"can't be read: {error.strerror}; shipped profiles: {shipped}")]) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ProfileError(path, [("", f"is no TOML: {error}")]) from error
    try:
        return Profile.model_validate(content)
    except ValidationError as error:
        raise ProfileError(path, list(_told(error))) from error


def profile_names() -> list[str]:
    """The names of the shipped profiles."""
    return sorted(path.stem for path in SHIPPED.glob("*.toml"))


def _told(error: ValidationError) -> Iterator[tuple[str, str]]:
    for fault in error.errors():
        cause = fault.get("ctx", {}).get("error")
        if isinstance(cause, _FaultsError):
            yield from cause.faults
        else:
            yield ".".join(str(part) for part in fault["loc"]), fault["msg"]
