"""A Modbus device of some make as data: how it is spoken to, its rows, and the checks of both; read from a TOML file.

Every fault of a file is told at once, each with the key that it stands under. Pure: no clock, no socket, no Modbus library.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import Field, ValidationError, model_validator

from instruments.bath.registers import Order
from instruments.bath.rows import Evidence, Row, Strict, Table

ReadFunction = Literal[1, 2, 3, 4]
WriteFunction = Literal[5, 6, 16]
READERS: dict[Table, tuple[ReadFunction, ...]] = {"holding": (3, 4), "input": (4,), "coil": (1, 2), "discrete": (2,)}  # first choice first

Made = TypeVar("Made", bound="Wiring")


class ProfileError(ValueError):
    """A profile with faults: ``path`` of the file, ``faults`` as (key path, message), all at once."""

    def __init__(self, path: Path, faults: Sequence[tuple[str, str]]) -> None:
        self.path = path
        self.faults = tuple(faults)
        super().__init__(f"{path}: " + "; ".join(f"{key}: {message}" if key else message for key, message in faults))


class Wiring(Strict):
    """A Modbus device of some make: how it is spoken to, and its rows.

    ``functions`` are the Modbus functions that it knows; with ``alike``, 3 and 4 read the same registers. From address
    ``pairs_from`` on, registers are read and written in pairs only. ``timeout_s`` is the wait for an answer, and
    ``quiet_s`` how much later one may still come: the slowest that the family is known to be.
    """

    family: str
    source: str
    transports: Annotated[tuple[Literal["tcp", "rtu"], ...], Field(min_length=1)]
    functions: Annotated[tuple[ReadFunction | WriteFunction, ...], Field(min_length=1)] = (3, 4, 6, 16)
    alike: bool = False
    pairs_from: Annotated[int, Field(ge=0, le=0xFFFE)] | None = None
    unit_id: Annotated[int, Field(ge=1, le=254)] = 1
    unit_id_evidence: Evidence = "INFERRED"
    baud: Annotated[int, Field(ge=300, le=921600)] = 9600
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    timeout_s: Annotated[float, Field(ge=0.05, le=10.0)] = 1.0
    quiet_s: Annotated[float, Field(ge=0.05, le=10.0)] = 0.5
    order: Order = "ABCD"
    rows: Annotated[tuple[Row, ...], Field(min_length=1)]

    def find(self, name: str) -> Row | None:
        """The row called ``name``, or None where the family has none."""
        return next((row for row in self.rows if row.name == name), None)

    def row(self, name: str) -> Row:
        """The row called ``name``. Raises KeyError where the family has none."""
        row = self.find(name)
        if row is None:
            raise KeyError(f"{self.family} has no row '{name}'")
        return row

    def read_function(self, table: Table) -> ReadFunction | None:
        """The function that reads ``table``, or None where the family has none."""
        return next((function for function in READERS[table] if function in self.functions), None)

    def write_function(self, row: Row) -> WriteFunction | None:
        """The function that writes ``row``, or None where the family has none."""
        wanted: tuple[WriteFunction, ...] = (5,) if row.type == "bit" else (6, 16) if row.words == 1 else (16,)
        return next((function for function in wanted if function in self.functions), None)


class RelayProfile(Wiring):
    """A relay or IO device that switches a pump: its row ``pump`` has the values ``on`` and ``off``."""

    @model_validator(mode="after")
    def _whole(self) -> RelayProfile:
        faults = list(row_faults(self))
        names = [row.name for row in self.rows]
        if "pump" not in names:
            faults.append(("rows", "the row 'pump' is missing"))
        elif self.row("pump").access != "rw" or not {"on", "off"} <= set(self.row("pump").values):
            faults.append((f"rows.{names.index('pump')}", "pump: access 'rw' and the labels 'on' and 'off' are needed"))
        if faults:
            raise FaultsError(faults)
        return self


class FaultsError(ValueError):
    """Faults that a check of the whole has found: (key path, message) each."""

    def __init__(self, faults: list[tuple[str, str]]) -> None:
        self.faults = faults
        super().__init__("; ".join(message for _, message in faults))


def row_faults(profile: Wiring) -> Iterator[tuple[str, str]]:
    """What is wrong with the rows, each and together."""
    for at, row in enumerate(profile.rows):
        yield from ((f"rows.{at}", f"{row.name}: {fault}") for fault in (*row.faults(), *_reach_faults(profile, row)))
    names = [row.name for row in profile.rows]
    yield from ((f"rows.{at}.name", f"a second row '{name}'") for at, name in enumerate(names) if name in names[:at])
    yield from _overlaps(profile.rows)


def _reach_faults(profile: Wiring, row: Row) -> Iterator[str]:
    """Why the family's functions can't get at the row."""
    known = ", ".join(map(str, profile.functions))
    if "r" in row.access and profile.read_function(row.table) is None:
        yield f"none of the functions {known} reads table {row.table}"
    if "w" in row.access and profile.write_function(row) is None:
        yield f"none of the functions {known} writes {row.type}"
    if profile.pairs_from is not None and row.address >= profile.pairs_from and (row.address % 2 or row.words != 2):
        yield f"from {profile.pairs_from} on, rows take two registers at an even address"


def _overlaps(rows: Sequence[Row]) -> Iterator[tuple[str, str]]:
    """Every pair that shares an address, whatever lies between them in the file."""
    places = sorted(enumerate(rows), key=lambda place: (place[1].table, place[1].address))
    for i, (_, first) in enumerate(places):
        for at, second in places[i + 1 :]:
            if second.table != first.table or second.address >= first.end:
                break
            yield f"rows.{at}.address", f"{second.name} at {second.table} {second.address} overlaps {first.name} at {first.address}"


def load(path: Path, kind: type[Made], *, hint: str = "") -> Made:
    """What stands in the file at ``path``. Raises ProfileError with all its faults, and with ``hint`` where there is no file."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ProfileError(path, [("", f"can't be read: {error.strerror}{hint}")]) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ProfileError(path, [("", f"is no TOML: {error}")]) from error
    try:
        return kind.model_validate_json(json.dumps(content, default=str), strict=True)
    except ValidationError as error:
        raise ProfileError(path, list(_told(error))) from error


def _told(error: ValidationError) -> Iterator[tuple[str, str]]:
    for fault in error.errors():
        cause = fault.get("ctx", {}).get("error")
        if isinstance(cause, FaultsError):
            yield from cause.faults
        else:
            yield ".".join(str(part) for part in fault["loc"]), fault["msg"]
