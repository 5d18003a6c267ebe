"""Which arm an emulator is: all that the arm says of itself, and its counts on the peg.

One arm is one TOML file in the arm's own numbers; ``units`` has those that ship.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from instruments.microscribe import configuration as conf
from instruments.microscribe.configuration import Identity, Maxima, Parameters
from instruments.microscribe.kinematics import COUNT_MODULUS, ArmGeometry
from instruments.microscribe.protocol import Code, WireError

SHIPPED = Path(__file__).with_name("units")


class UnitError(ValueError):
    """A file that describes no arm: its ``path``, and all faults ``located`` as (keys, message)."""

    def __init__(self, path: Path, located: Sequence[tuple[tuple[str | int, ...], str]]) -> None:
        self.path = path
        self.located = tuple(located)
        told = [(".".join(map(str, keys)), message) for keys, message in located]
        super().__init__(
            f"{path}: "
            + "; ".join(f"{key}: {message}" if key else message for key, message in told)
        )


@dataclass(frozen=True, slots=True)
class ArmIdentity:
    """One arm: names, full scales, Denavit-Hartenberg parameters, beta, and home counts."""

    names: Identity
    maxima: Maxima
    parameters: Parameters
    beta: int
    home: tuple[int, ...]

    def geometry(self) -> ArmGeometry:
        """The shape by the arm's own data. Raises ValueError unless there are six joints."""
        beta_rad = conf.angle_rad(self.beta) if self.names.has_beta else 0.0
        return ArmGeometry.from_block(self.parameters, beta_rad, self.maxima.turns)

    def replies(self) -> dict[int, bytes]:
        """Reply by code. Extended parameters need "Beta" in the comment. Raises WireError."""
        replies = {
            int(code): conf.encode_name(code, name)
            for code, name in zip(conf.NAMES, astuple(self.names), strict=True)
        }
        replies[Code.MAXIMA] = conf.encode_maxima(self.maxima)
        replies[Code.PARAMETERS] = conf.encode_parameters(self.parameters)
        if self.names.has_beta:
            replies[Code.EXTENDED] = conf.encode_extended(self.beta)
        return replies


def load_unit(path: Path) -> ArmIdentity:
    """The arm in the file at ``path``. Raises UnitError with all its faults, or OSError."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        return _File.model_validate_json(json.dumps(table, default=str), strict=True).arm()
    except UnicodeDecodeError as error:
        raise UnitError(path, [((), f"not UTF-8 text: {error}")]) from error
    except tomllib.TOMLDecodeError as error:
        raise UnitError(path, [((), f"not TOML: {error}")]) from error
    except ValidationError as error:
        raise UnitError(path, list(_faults(error))) from error


@cache
def shipped_unit(serial_number: str) -> ArmIdentity:
    """The arm that ships with that number. Raises FileNotFoundError that lists those that do."""
    path = SHIPPED / f"{serial_number}.toml"
    if not path.is_file():
        shipped = ", ".join(sorted(file.stem for file in SHIPPED.glob("*.toml")))
        raise FileNotFoundError(
            f"no arm ships under the serial number {serial_number}; there is {shipped}"
        )
    return load_unit(path)


def __getattr__(name: str) -> ArmIdentity:
    """``UNIT_40937``, the default arm, read when it is first used."""
    if name == "UNIT_40937":
        return shipped_unit("40937")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _name(text: str) -> str:
    try:
        conf.encode_name(Code.COMMENT, text)
    except WireError as error:
        raise ValueError(f"{error}") from error
    return text


def _signed(word: int) -> int:
    return word - 0x10000 if word > 0x7FFF else word


_Name = Annotated[str, AfterValidator(_name)]
_Byte = Annotated[int, Field(ge=0, le=0xFF)]
_Count = Annotated[int, Field(ge=0, lt=COUNT_MODULUS)]
_Word = Annotated[int, Field(ge=-0x8000, le=0xFFFF), AfterValidator(_signed)]
_Words = tuple[_Word, _Word, _Word, _Word, _Word, _Word]
_Counts = tuple[_Count, _Count, _Count, _Count, _Count, _Count]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Names(_Table):
    product: _Name
    product_id: _Name
    model: _Name
    serial_number: _Name
    comment: _Name
    format: _Name
    version: _Name


class _Maxima(_Table):
    button_mask: Annotated[int, Field(ge=0, le=0x7F)]
    timer: _Count
    analogs: tuple[_Byte, _Byte, _Byte, _Byte, _Byte, _Byte, _Byte, _Byte]
    analog_low_bits: _Byte
    encoders: _Counts


class _Parameters(_Table):
    alpha: _Words
    a: _Words
    d: _Words
    beta: _Word = 0


class _Peg(_Table):
    counts: _Counts


class _File(_Table):
    names: _Names
    maxima: _Maxima
    parameters: _Parameters
    peg: _Peg

    def arm(self) -> ArmIdentity:
        p = self.parameters
        names, maxima = Identity(**self.names.model_dump()), Maxima(**self.maxima.model_dump())
        return ArmIdentity(names, maxima, Parameters(p.alpha, p.a, p.d), p.beta, self.peg.counts)

    @model_validator(mode="after")
    def _can_measure(self) -> _File:
        arm = self.arm()
        if self.parameters.beta and not arm.names.has_beta:
            raise ValueError(
                f'parameters.beta has no meaning without "{conf.BETA_MARK}" in names.comment: such'
                " an arm never tells it"
            )
        geometry = arm.geometry()
        slopes = geometry.jacobian_angles(geometry.angles(arm.home))[0, :3]
        if np.linalg.matrix_rank(slopes, tol=1e-3) < 3:
            raise ValueError(
                "with these parameters and encoders the tip can't be moved in three dimensions from"
                " the peg"
            )
        return self


def _faults(error: ValidationError) -> Iterator[tuple[tuple[str | int, ...], str]]:
    for detail in error.errors():
        message = detail["msg"].removeprefix("Value error, ")
        shown = (
            ""
            if detail["type"] == "missing" or not detail["loc"]
            else f" (found {detail['input']!r:.60})"
        )
        yield detail["loc"], f"{message[0].lower()}{message[1:]}{shown}"
