"""The arm's identity, maxima and parameters as values and as bytes.

Source: the maker's SDK manual, chapter 4. A reply is the command's code, then 8-bit data, most
significant byte first; parameters have their length between. Values stay in the arm's units. The
constraints apply to a file that describes an arm (``unit``).
"""

from __future__ import annotations

import math
import struct
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field

from instruments.microscribe.kinematics import COUNT_MODULUS, ArmGeometry
from instruments.microscribe.protocol import Code, WireError, encoder_count

NAMES = tuple(Code(code) for code in range(Code.PRODUCT_NAME, Code.VERSION + 1))
FORMAT = "Format DH0.5"
BETA_MARK = "Beta"  # in the comment of an arm that has extended parameters
NAME_MAX_BYTES = 32  # with the NUL, without the code
PARAMETER_BYTES = 36  # without the code and the length
_BLOCKS = (Code.PARAMETERS, Code.EXTENDED)  # the length stands before the data
_LAYOUTS = {Code.MAXIMA: ">BH8BB6H", Code.PARAMETERS: ">18h", Code.EXTENDED: ">h"}


def _checked_name(name: str) -> str:
    if not name.isascii() or "\0" in name or len(name) >= NAME_MAX_BYTES:
        most = f"{NAME_MAX_BYTES - 1} characters at most"
        raise WireError(f"{name!r} is no name for an arm: ASCII without NUL, {most}")
    return name


def _exactly(count: int) -> AfterValidator:
    def check(values: tuple[int, ...]) -> tuple[int, ...]:
        if len(values) != count:
            raise ValueError(f"there have to be {count} numbers, not {len(values)}")
        return values

    return AfterValidator(check)


_Name = Annotated[str, AfterValidator(_checked_name)]
_Byte = Annotated[int, Field(ge=0, le=0xFF)]
_Count = Annotated[int, Field(ge=0, lt=COUNT_MODULUS)]
_SIGNED = AfterValidator(lambda word: (word + 0x8000) % 0x10000 - 0x8000)
Word = Annotated[int, Field(ge=-0x8000, le=0xFFFF), _SIGNED]
Counts = Annotated[tuple[_Count, ...], _exactly(6)]
_Words = Annotated[tuple[Word, ...], _exactly(6)]


@dataclass(frozen=True, slots=True)
class Identity:
    """The seven names, in the order of `NAMES`."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    product: _Name
    product_id: _Name
    model: _Name
    serial_number: _Name
    comment: _Name
    format: _Name
    version: _Name

    @property
    def has_beta(self) -> bool:
        """Whether the arm has extended parameters."""
        return BETA_MARK in self.comment


@dataclass(frozen=True, slots=True)
class Maxima:
    """Full scales; an encoder's is 0 where it is absent."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    button_mask: Annotated[int, Field(ge=0, le=0x7F)]
    timer: _Count
    analogs: Annotated[tuple[_Byte, ...], _exactly(8)]
    analog_low_bits: _Byte
    encoders: Counts

    @property
    def turns(self) -> tuple[int, ...]:
        """Counts per revolution of each joint; 0 where it has no encoder."""
        return tuple(top + 1 if top else 0 for top in self.encoders)


@dataclass(frozen=True, slots=True)
class Joints:
    """Denavit-Hartenberg parameters of six joints as signed 16-bit numbers: angles in 1/32768 of
    half a turn, lengths in 0.001 inch.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    alpha: _Words
    a: _Words
    d: _Words


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """What sign-on reads from an arm; beta is 0 where it has none."""

    names: Identity
    maxima: Maxima
    parameters: Joints
    beta: int

    @lru_cache(maxsize=8)  # noqa: B019 - a few arms; what is kept of a shape is kept by its object
    def geometry(self) -> ArmGeometry:
        """Its shape, in rad and mm."""
        p, turns = self.parameters, np.array(self.maxima.turns)
        alpha_rad = np.array(p.alpha) / 32768 * math.pi
        beta_rad = self.beta / 32768 * math.pi if self.names.has_beta else 0.0
        a_mm, d_mm = np.array([p.a, p.d]) * 25.4 / 1000
        return ArmGeometry(alpha_rad, a_mm, d_mm, beta_rad, turns)

    def record(self) -> dict[str, object]:
        """Names and raw numbers: enough to compute every position again from its counts."""
        raw = asdict(self)
        names: dict[str, object] = raw.pop("names")
        return names | raw

    def warnings(self) -> list[str]:
        """A sentence for each joint whose counts, modulo 2^14, lose its angle after a few turns."""
        return [
            f"joint {joint} has {turn} counts a turn, and {COUNT_MODULUS} is no multiple of that:"
            " its angle is lost after so many counts"
            for joint, turn in enumerate(self.maxima.turns)
            if turn and COUNT_MODULUS % turn
        ]


@dataclass(frozen=True, slots=True)
class StreamRequest:
    """What starts a stream. With all masks and deltas zero, ``delay_ms`` is a fixed period."""

    delay_ms: int
    command: int
    button_mask: int = 0
    analog_deltas: tuple[int, ...] = (0,) * 8
    encoder_deltas: tuple[int, ...] = (0,) * 6

    @property
    def fixed_rate(self) -> bool:
        """Whether packets come by time alone."""
        return not (self.button_mask or any(self.analog_deltas) or any(self.encoder_deltas))


class BlockLengthError(WireError):
    """A block of parameters states an unknown length. Not for missing bytes."""


def encode_name(code: int, name: str) -> bytes:
    """The reply with a name. Raises WireError for a name that isn't ASCII or is too long."""
    return bytes([code]) + _checked_name(name).encode("ascii") + b"\0"


def decode_name(code: int, reply: bytes) -> str:
    """The name in a reply: code, ASCII, NUL. Raises WireError for anything else."""
    body = _body(code, reply)
    name, end, rest = body.partition(b"\0")
    if not end or rest or len(body) > NAME_MAX_BYTES or not name.isascii():
        raise WireError(f"a name is ASCII that ends with a NUL, {NAME_MAX_BYTES} bytes at most")
    return name.decode("ascii")


def encode(code: Code, *fields: int | tuple[int, ...]) -> bytes:
    """A reply or a stream command of a value's fields. Raises WireError for no fit."""
    numbers = [n for field in fields for n in (field if isinstance(field, tuple) else (field,))]
    layout = _layout(code, numbers[1] if code == Code.STREAM else 0)
    try:
        data = layout.pack(*numbers)
    except struct.error as error:
        raise WireError(f"{tuple(numbers)} doesn't fit its fields: {error}") from None
    return bytes([code, layout.size] if code in _BLOCKS else [code]) + data


def decode(code: Code, data: bytes) -> tuple[int, ...]:
    """The numbers of a reply or a stream command. Raises WireError for another length or code,
    BlockLengthError for a block of an unknown length.
    """
    body = _body(code, data)
    layout = _layout(code, body[2] if len(body) > 2 else 0)
    if code in _BLOCKS:
        if body[:1] != bytes([layout.size]):
            length = body[0] if body else "no"
            what = f"the block behind {code:02X} says it has {length} bytes"
            raise BlockLengthError(f"{what}; {layout.size} are understood")
        body = body[1:]
    if len(body) != layout.size:
        raise WireError(f"what follows {code:02X} has {len(body)} bytes, not the {layout.size}")
    return layout.unpack(body)


def decode_maxima(reply: bytes) -> Maxima:
    """The full scales in a reply. Raises WireError as `decode`."""
    v = decode(Code.MAXIMA, reply)
    return Maxima(v[0], v[1], v[2:10], v[10], v[11:])


def decode_parameters(reply: bytes) -> Joints:
    """The parameters in a reply. Raises WireError as `decode`."""
    v = decode(Code.PARAMETERS, reply)
    return Joints(v[:6], v[6:12], v[12:])


def decode_stream(data: bytes) -> StreamRequest:
    """The request in a whole stream command. Raises WireError as `decode`."""
    v = decode(Code.STREAM, data)
    return StreamRequest(v[0], v[1], v[2], v[3:11], v[11:])


def reply_length(code: int, data: bytes) -> int | None:
    """Length of the reply to ``code`` that ``data`` begins with; None while it is incomplete."""
    if code in NAMES:
        end = data.find(b"\0") + 1 or (NAME_MAX_BYTES + 1 if len(data) > NAME_MAX_BYTES else 0)
    elif code in _BLOCKS:
        end = 2 + data[1] if len(data) > 1 else 0
    else:
        end = 1 + (struct.calcsize(_LAYOUTS[Code.MAXIMA]) if code == Code.MAXIMA else 0)
    return end if 0 < end <= len(data) else None


def _layout(code: Code, command: int) -> struct.Struct:
    """How the bytes after ``code`` lie; a stream's depend on its ``command``."""
    if code == Code.STREAM:
        return struct.Struct(f">HBB8B{7 if encoder_count(command) == 7 else 6}H")
    return struct.Struct(_LAYOUTS.get(code, ">"))


def _body(code: int, reply: bytes) -> bytes:
    if reply[:1] != bytes([code]):
        raise WireError(f"the reply doesn't begin with {code:02X}")
    return reply[1:]
