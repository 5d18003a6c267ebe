"""What others say of a family's registers: files beside the profiles, typed from public sources and
never from a profile. An emulator is laid out by them, so that a wrong row of a profile shows.
"""

from __future__ import annotations

import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from instruments.bath.profile import AlarmCause, AlarmCode, OrderFrom, RegisterProfile
from instruments.bath.rows import Evidence, Order, Row, Strict

WITNESSES = Path(__file__).with_name("witnesses")
IEEE_AREA = 0x8000  # Eurotherm: a pair of registers at 0x8000 + 2 n for each quantity n


class WitnessRow(Row):
    """A row as ``source`` has it (keys of the file's sources). ``parameter``: of a Eurotherm, from
    which follows its address.
    """

    evidence: Evidence = "FIELD"
    source: str

    @model_validator(mode="before")
    @classmethod
    def _addressed(cls, given: dict[str, Any]) -> dict[str, Any]:
        if "parameter" not in given:
            return given
        number = given["parameter"]
        address = IEEE_AREA + 2 * number if given["type"] == "f32" else number
        rest = {key: value for key, value in given.items() if key != "parameter"}
        return {"table": "holding", "address": address, **rest}


class WitnessAlarm(Strict):
    code: int
    cause: AlarmCause
    source: str


class Witness(Strict):
    """What is known of a family beside its profile."""

    family: str
    order: Order
    order_codes: dict[str, Order] = Field(default_factory=dict)  # of the row ``encoding``
    sources: Annotated[dict[str, str], Field(min_length=1)]
    rows: tuple[WitnessRow, ...]
    alarms: tuple[WitnessAlarm, ...] = ()

    def laid_out(self, profile: RegisterProfile) -> RegisterProfile:
        """The device that the witness describes; rows that it lacks are the profile's."""
        own = {row.name for row in self.rows}
        taken = {(row.table, at) for row in self.rows for at in range(row.address, row.end)}
        others = [
            row
            for row in profile.rows
            if row.name not in own
            and not taken & {(row.table, at) for at in range(row.address, row.end)}
        ]
        alarms = [
            AlarmCode(code=one.code, cause=one.cause, text="", evidence="FIELD")
            for one in self.alarms
        ]
        codes = OrderFrom(row="encoding", codes=self.order_codes) if self.order_codes else None
        laid_out = {"rows": (*self.rows, *others), "order": self.order, "order_from": codes}
        return profile.model_copy(update=laid_out | ({"alarms": tuple(alarms)} if alarms else {}))


@lru_cache
def witness_of(family: str) -> Witness | None:
    """The witness whose file names the family; the others are not parsed, which takes longer."""
    for text in (path.read_text(encoding="utf-8") for path in WITNESSES.glob("*.toml")):
        if f'family = "{family}"' in text.splitlines():
            return Witness.model_validate(tomllib.loads(text))
    return None


def device_of(profile: RegisterProfile) -> RegisterProfile:
    """The device to emulate: as the family's witness has it, else as the profile says."""
    witness = witness_of(profile.family)
    return witness.laid_out(profile) if witness else profile
