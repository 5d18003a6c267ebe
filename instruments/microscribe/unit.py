"""Which arm an emulator is: a TOML file in the arm's own numbers; ``units`` has those that ship."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from functools import cache
from pathlib import Path

import numpy as np
from pydantic import BaseModel, model_validator

from instruments.device_file import read_device
from instruments.microscribe import configuration as conf
from instruments.microscribe.configuration import Counts, DeviceInfo, Identity, Joints, Maxima
from instruments.microscribe.protocol import Code

SHIPPED = Path(__file__).with_name("units")


@dataclass(frozen=True, slots=True)
class ArmIdentity(DeviceInfo):
    """One arm's own data, and its counts on the peg."""

    home: tuple[int, ...]

    def replies(self) -> dict[int, bytes]:
        """Reply by code. Extended parameters need "Beta" in the comment. Raises WireError."""
        names = zip(conf.NAMES, astuple(self.names), strict=True)
        replies = {int(code): conf.encode_name(code, name) for code, name in names}
        replies[Code.MAXIMA] = conf.encode(Code.MAXIMA, *astuple(self.maxima))
        replies[Code.PARAMETERS] = conf.encode(Code.PARAMETERS, *astuple(self.parameters))
        if self.names.has_beta:
            replies[Code.EXTENDED] = conf.encode(Code.EXTENDED, self.beta)
        return replies


def load_unit(path: Path) -> ArmIdentity:
    """The arm in the file at ``path``. Raises DeviceFileError with all its faults, or OSError."""
    return read_device(path, _file_of).arm()


def _file_of(_: object) -> type[_File]:
    return _File


@cache
def shipped_unit(serial_number: str) -> ArmIdentity:
    """The arm that ships with that number. Raises FileNotFoundError that lists those that do."""
    path = SHIPPED / f"{serial_number}.toml"
    if not path.is_file():
        shipped = ", ".join(sorted(file.stem for file in SHIPPED.glob("*.toml")))
        what = f"no arm ships under the serial number {serial_number}"
        raise FileNotFoundError(f"{what}; there is {shipped}")
    return load_unit(path)


@dataclass(frozen=True, slots=True)
class _Parameters(Joints):
    beta: conf.Word = 0


class _Peg(BaseModel, extra="forbid", defer_build=True):
    counts: Counts


class _File(BaseModel, extra="forbid", defer_build=True):
    names: Identity
    maxima: Maxima
    parameters: _Parameters
    peg: _Peg

    def arm(self) -> ArmIdentity:
        p = self.parameters
        parameters = Joints(p.alpha, p.a, p.d)
        return ArmIdentity(self.names, self.maxima, parameters, p.beta, self.peg.counts)

    @model_validator(mode="after")
    def _can_measure(self) -> _File:
        if self.parameters.beta and not self.names.has_beta:
            what = f'parameters.beta has no meaning without "{conf.BETA_MARK}" in names.comment'
            raise ValueError(what)
        geometry = self.arm().geometry()
        slopes = geometry.jacobian(geometry.angles(self.peg.counts))[0, :3]
        if np.linalg.matrix_rank(slopes, tol=1e-3) < 3:
            what = "the tip can't be moved in three dimensions from the peg"
            raise ValueError(f"with these parameters and encoders {what}")
        return self
