"""What an arm says of itself: names, maxima and parameters, as values and as bytes.

Source: the maker's SDK manual, chapter 4. A reply is the command's code, then 8-bit data, most
significant byte first. Values are kept as the arm gives them, so that they encode to the same
bytes. The constraints are those of a file that describes an arm (``unit``).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, ConfigDict, Field

from instruments.microscribe.kinematics import COUNT_MODULUS, ArmGeometry, Floats
from instruments.microscribe.protocol import Code, WireError, encoder_count

NAMES = (
    Code.PRODUCT_NAME,
    Code.PRODUCT_ID,
    Code.MODEL,
    Code.SERIAL_NUMBER,
    Code.COMMENT,
    Code.FORMAT,
    Code.VERSION,
)
FORMAT = "Format DH0.5"
BETA_MARK = "Beta"  # in the comment of an arm that has extended parameters
NAME_MAX_BYTES = 32  # with the NUL, without the code
PARAMETER_BYTES = 36  # without the code and the length

_MAXIMA = struct.Struct(">BH8BB6H")
_PARAMETERS = struct.Struct(">18h")
_EXTENDED = struct.Struct(">h")


def encode_name(code: int, name: str) -> bytes:
    """The reply with a name. Raises WireError for a name that isn't ASCII or is too long."""
    return bytes([code]) + _checked_name(name).encode("ascii") + b"\0"


def _checked_name(name: str) -> str:
    if not name.isascii() or "\0" in name or len(name) >= NAME_MAX_BYTES:
        raise WireError(
            f"{name!r} is no name for an arm: ASCII without NUL, {NAME_MAX_BYTES - 1} characters at"
            " most"
        )
    return name


def _signed(word: int) -> int:
    return word - 0x10000 if word > 0x7FFF else word


def _exactly(count: int) -> AfterValidator:
    def check(values: tuple[int, ...]) -> tuple[int, ...]:
        if len(values) != count:
            raise ValueError(f"there have to be {count} numbers, not {len(values)}")
        return values

    return AfterValidator(check)


_Name = Annotated[str, AfterValidator(_checked_name)]
_Byte = Annotated[int, Field(ge=0, le=0xFF)]
_Count = Annotated[int, Field(ge=0, lt=COUNT_MODULUS)]
Word = Annotated[int, Field(ge=-0x8000, le=0xFFFF), AfterValidator(_signed)]
Counts = Annotated[tuple[_Count, ...], _exactly(6)]
_Words = Annotated[tuple[Word, ...], _exactly(6)]


@dataclass(frozen=True, slots=True)
class Identity:
    """The seven names, in the maker's order of asking."""

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
        """Whether the arm answers a question for its extended parameters."""
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
class Parameters:
    """Denavit-Hartenberg parameters of six joints, as the signed 16-bit numbers of the arm: angles
    in 1/32768 of half a turn, lengths in 0.001 inch.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    alpha: _Words
    a: _Words
    d: _Words


def _rad(value: npt.ArrayLike) -> Floats:
    return np.asarray(value) / 32768 * math.pi


def _mm(value: npt.ArrayLike) -> Floats:
    return np.asarray(value) * 25.4 / 1000


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """All that an arm says of itself at sign-on; beta is 0 where it has none."""

    names: Identity
    maxima: Maxima
    parameters: Parameters
    beta: int

    def geometry(self) -> ArmGeometry:
        """Its shape, in rad and mm."""
        p, beta = self.parameters, self.beta if self.names.has_beta else 0
        turns = np.array(self.maxima.turns)
        return ArmGeometry(_rad(p.alpha), _mm(p.a), _mm(p.d), float(_rad(beta)), turns)

    def record(self) -> dict[str, object]:
        """Names and raw numbers: enough to compute every position again from its counts."""
        return {
            **asdict(self.names),
            "maxima": asdict(self.maxima),
            "parameters": asdict(self.parameters),
            "beta": self.beta,
        }

    def warnings(self) -> list[str]:
        """A sentence for each joint whose counts, modulo 2^14, lose its angle after a few turns."""
        return [
            f"joint {joint} has {turn} counts a turn, and {COUNT_MODULUS} is no multiple of that:"
            " its angle is lost after so many counts"
            for joint, turn in enumerate(self.maxima.turns)
            if turn and COUNT_MODULUS % turn
        ]


class BlockLengthError(WireError):
    """A block of parameters states an unknown length. Not for missing bytes."""


def decode_name(code: int, reply: bytes) -> str:
    """The name in a reply: code, ASCII, NUL. Raises WireError for anything else."""
    body = _body(code, reply)
    if (
        not body.endswith(b"\0")
        or body.count(0) != 1
        or len(body) > NAME_MAX_BYTES
        or not body.isascii()
    ):
        raise WireError(f"a name is ASCII that ends with a NUL, {NAME_MAX_BYTES} bytes at most")
    return body[:-1].decode("ascii")


def encode_maxima(maxima: Maxima) -> bytes:
    """The reply with the full scales. Raises WireError when one doesn't fit its field."""
    mask, timer, analogs, low_bits, encoders = astuple(maxima)
    return bytes([Code.MAXIMA]) + _packed(_MAXIMA, (mask, timer, *analogs, low_bits, *encoders))


def decode_maxima(reply: bytes) -> Maxima:
    """The full scales in a reply of 25 bytes. Raises WireError for another length or code."""
    body = _body(Code.MAXIMA, reply)
    if len(body) != _MAXIMA.size:
        raise WireError(f"the maxima are {_MAXIMA.size} bytes, not {len(body)}")
    v = _MAXIMA.unpack(body)
    return Maxima(v[0], v[1], v[2:10], v[10], v[11:])


def encode_parameters(parameters: Parameters) -> bytes:
    """The reply with the parameters. Raises WireError when one doesn't fit its field."""
    values = _packed(_PARAMETERS, (*parameters.alpha, *parameters.a, *parameters.d))
    return bytes([Code.PARAMETERS, PARAMETER_BYTES]) + values


def decode_parameters(reply: bytes) -> Parameters:
    """The parameters in a reply. Raises WireError for another length or code."""
    v = _PARAMETERS.unpack(_block(Code.PARAMETERS, reply, PARAMETER_BYTES))
    return Parameters(v[:6], v[6:12], v[12:])


def encode_extended(beta: int) -> bytes:
    """The reply with beta, signed 16-bit. Raises WireError when it doesn't fit."""
    return bytes([Code.EXTENDED, 2]) + _packed(_EXTENDED, (beta,))


def decode_extended(reply: bytes) -> int:
    """Beta, signed 16-bit, of a reply. Raises WireError for another length or code."""
    return int.from_bytes(_block(Code.EXTENDED, reply, 2), "big", signed=True)


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


def encode_stream(request: StreamRequest) -> bytes:
    """25 bytes, or 27 for seven encoders. Raises WireError when a field doesn't fit."""
    delay, command, mask, analogs, encoders = astuple(request)
    fields = (delay, command, mask, *analogs, *encoders)
    return bytes([Code.STREAM]) + _packed(_stream_layout(command), fields)


def decode_stream(data: bytes) -> StreamRequest:
    """What a whole stream command asks for. Raises WireError for another length or code."""
    body = _body(Code.STREAM, data)
    layout = _stream_layout(body[2] if len(body) > 2 else 0)
    if len(body) != layout.size:
        raise WireError(f"a stream command has {layout.size} bytes after its code, not {len(body)}")
    v = layout.unpack(body)
    return StreamRequest(v[0], v[1], v[2], v[3:11], v[11:])


def reply_length(code: int, data: bytes) -> int | None:
    """Length of the reply to ``code`` that ``data`` begins with; None while it is incomplete."""
    if code in NAMES:
        end = data.find(b"\0") + 1 or (NAME_MAX_BYTES + 1 if len(data) > NAME_MAX_BYTES else 0)
    elif code in (Code.PARAMETERS, Code.EXTENDED):
        end = 2 + data[1] if len(data) > 1 else 0
    elif code == Code.MAXIMA:
        end = 1 + _MAXIMA.size
    else:
        end = 1
    return end if 0 < end <= len(data) else None


def expect_echo(code: int, reply: bytes) -> None:
    """Raise WireError unless the reply is the bare code."""
    if _body(code, reply):
        raise WireError(f"nothing should follow the echo {code:02X}")


def _stream_layout(command: int) -> struct.Struct:
    return struct.Struct(f">HBB8B{7 if encoder_count(command) == 7 else 6}H")


def _packed(layout: struct.Struct, values: Sequence[int]) -> bytes:
    try:
        return layout.pack(*values)
    except struct.error as error:
        raise WireError(f"{tuple(values)} doesn't fit its fields: {error}") from None


def _body(code: int, reply: bytes) -> bytes:
    if reply[:1] != bytes([code]):
        raise WireError(f"the reply doesn't begin with {code:02X}")
    return reply[1:]


def _block(code: int, reply: bytes, length: int) -> bytes:
    body = _body(code, reply)
    if body[:1] != bytes([length]):
        raise BlockLengthError(
            f"the block behind {code:02X} says it has {body[0] if body else 'no'} bytes; {length}"
            " are understood"
        )
    if len(body) != length + 1:
        raise WireError(
            f"the block behind {code:02X} has {len(body) - 1} bytes, not the {length} it says"
        )
    return body[1:]
