"""What an arm says of itself: names, maxima and parameters, as values and as bytes.

Source: the maker's SDK manual, chapter 4. A reply is the command's code, then 8-bit data, most
significant byte first. Values are kept as the arm gives them, so that they encode to the same
bytes.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass

from instruments.microscribe.kinematics import COUNT_MODULUS, ArmGeometry
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
MAXIMA_BYTES = 25  # with the code
PARAMETER_BYTES = 36  # without the code and the length
EXTENDED_BYTES = 4  # with the code and the length


_MAXIMA = struct.Struct(">BH8BB6H")
_PARAMETERS = struct.Struct(">18h")
_INCH_MM = 25.4


class BlockLengthError(WireError):
    """A block of parameters states an unknown length. Not for missing bytes."""


@dataclass(frozen=True, slots=True)
class Identity:
    """The seven names, in the maker's order of asking."""

    product: str
    product_id: str
    model: str
    serial_number: str
    comment: str
    format: str
    version: str

    @property
    def has_beta(self) -> bool:
        """Whether the arm answers a question for its extended parameters."""
        return BETA_MARK in self.comment


@dataclass(frozen=True, slots=True)
class Maxima:
    """Full scales; an encoder's is 0 where it is absent."""

    button_mask: int
    timer: int
    analogs: tuple[int, ...]
    analog_low_bits: int
    encoders: tuple[int, ...]

    @property
    def turns(self) -> tuple[int, ...]:
        """Counts per revolution of each joint; 0 where it has no encoder."""
        return tuple(top + 1 if top else 0 for top in self.encoders)


@dataclass(frozen=True, slots=True)
class Parameters:
    """Denavit-Hartenberg parameters of six joints, as the signed 16-bit numbers of the arm."""

    alpha: tuple[int, ...]
    a: tuple[int, ...]
    d: tuple[int, ...]

    @property
    def alpha_rad(self) -> tuple[float, ...]:
        """Twists in rad."""
        return tuple(angle_rad(v) for v in self.alpha)

    @property
    def a_mm(self) -> tuple[float, ...]:
        """Link lengths in mm."""
        return tuple(length_mm(v) for v in self.a)

    @property
    def d_mm(self) -> tuple[float, ...]:
        """Link offsets in mm."""
        return tuple(length_mm(v) for v in self.d)


def angle_rad(value: int) -> float:
    """An angle of the arm (signed, 1/32768 of half a turn) in rad."""
    return value / 32768 * math.pi


def length_mm(value: int) -> float:
    """A length of the arm (signed, 0.001 inch) in mm."""
    return value * _INCH_MM / 1000


def encode_name(code: int, name: str) -> bytes:
    """The reply with a name. Raises WireError for a name that isn't ASCII or is too long."""
    if not name.isascii() or "\0" in name or len(name) >= NAME_MAX_BYTES:
        raise WireError(
            f"{name!r} is no name for an arm: ASCII without NUL, {NAME_MAX_BYTES - 1} characters at"
            " most"
        )
    return bytes([code]) + name.encode("ascii") + b"\0"


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
    fields = (
        maxima.button_mask,
        maxima.timer,
        *maxima.analogs,
        maxima.analog_low_bits,
        *maxima.encoders,
    )
    return bytes([Code.MAXIMA]) + _packed(_MAXIMA, fields)


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
    return bytes([Code.EXTENDED, 2]) + _packed(struct.Struct(">h"), (beta,))


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
    else:
        end = _FIXED.get(code, 1)
    return end if 0 < end <= len(data) else None


_FIXED: dict[int, int] = {Code.MAXIMA: MAXIMA_BYTES, Code.MARKER: 2}


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


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """All that an arm says of itself at sign-on; beta is 0 where it has none."""

    identity: Identity
    maxima: Maxima
    parameters: Parameters
    beta: int

    def geometry(self, tip_longer_mm: float) -> ArmGeometry:
        """Its shape, with a tip that is so much longer than the standard one."""
        return ArmGeometry.from_block(
            self.parameters, angle_rad(self.beta), self.maxima.turns
        ).with_tip(tip_longer_mm)

    def record(self) -> dict[str, object]:
        """Names and raw numbers: enough to compute every position again from its counts."""
        return {
            **asdict(self.identity),
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
