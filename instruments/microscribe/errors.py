"""Why an arm was not signed on, or gives no position: an error class for each, under the tree in
``instruments.errors``.

Raise the most exact one, catch the one that you can act on. It may not know the session, nor the
wire.

What answers when it isn't a MicroScribe: a guess from its bytes, and what to try.

Pure: a table of what the neighbours on a lab's ports are known to say. It may not know the link.
"""

from __future__ import annotations

from collections.abc import Callable

from instruments.errors import DeviceError, LimitError, LinkError, ProtocolError
from instruments.microscribe.protocol import BEGIN, SYNC

# Sign-on


class NoMicroScribeError(ProtocolError):
    """Something answers the sign-on, but not with the arm's words: another device, or a plug that
    loops back.

    Not for an arm whose later answers come damaged: that is a plain ProtocolError.
    """


class UnusableArmError(ProtocolError):
    """An arm, or its maker's, whose positions can't be computed; asking again doesn't help. Not
    raised itself: use one of three.
    """


class InterfaceBoxError(UnusableArmError):
    """An Immersion Interface Box ("IBOX"): its encoder bits mean something else."""


class UnknownFormatError(UnusableArmError):
    """The arm keeps its parameters in another format than "Format DH0.5"."""


class ParameterLengthError(UnusableArmError):
    """The arm states another length for a block of parameters. Not for a block that came short:
    that is damage.
    """


class UnstableUnitError(ProtocolError):
    """What the arm says of itself came differently each time. Replies have no checksum, so two have
    to agree.
    """


class AnotherArmError(DeviceError):
    """After a loss, an arm with another serial number answers."""


# In session


class SilentArmError(LinkError):
    """The arm doesn't answer, though the port is there. Not for a link that broke: that is a plain
    LinkError.
    """


class NoSessionError(LimitError):
    """Asked before sign-on, or after the session was lost."""


class StreamingError(LimitError):
    """Asked while a stream runs: its packets can't be told from answers."""


class NotHomedError(LimitError):
    """A position was asked for before the operator confirmed homing in this power cycle."""


class ArmMovesError(LimitError):
    """The packets of a reading are further apart than a still tip's."""


# what a refusal or a short answer has; longer ones are not what IMMC gets
_FRAME_BYTES = range(5, 17)


def _modbus(seen: bytes) -> bool:
    """Whether it ends in a Modbus RTU frame, which ends in a CRC-16 of what is before it (Modbus
    over serial line, 6.2.2).
    """
    frames = (seen[-length:] for length in _FRAME_BYTES if length <= len(seen))
    return any(_crc16(frame[:-2]) == int.from_bytes(frame[-2:], "little") for frame in frames)


def _crc16(data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


def _text(seen: bytes) -> bool:
    """Whether it is text, and enough of it to be no accident of a wrong baud rate."""
    return len(seen) >= 4 and all(byte in range(0x20, 0x7F) or byte in b"\r\n\t" for byte in seen)


_NEIGHBOURS: tuple[tuple[Callable[[bytes], bool], str], ...] = (
    (
        lambda seen: b"Grbl" in seen or b"['$'" in seen,
        "It talks like a GRBL board: is this the stage's port? Give the arm's",
    ),
    (
        lambda seen: SYNC in seen or BEGIN in seen,
        "It sends back what it hears: is a loop-back plug or a modem on this port? Give the arm's",
    ),
    (
        lambda seen: b"ok\r\n" in seen or b"error:" in seen or b"ALARM:" in seen,
        "It talks like a motion controller: is this the stage's port? Give the arm's",
    ),
    (_modbus, "It answers in Modbus frames: is this the bath's port? Give the arm's"),
    (_text, "It talks in plain text: which device is on this port? Give the arm's"),
)
_NOISE = (
    "No known device talks so: is the baud rate right, and is it the arm's port? Else switch the"
    " arm off and on, and sign on again"
)


def known(seen: bytes) -> bool:
    """Whether the bytes look like one of the neighbours: then no other baud rate makes an arm of
    it.
    """
    return any(fits(seen) for fits, _ in _NEIGHBOURS)


def what_to_try(seen: bytes) -> str:
    """A sentence for a person whose sign-on was answered with ``seen``, not empty."""
    return next((hint for fits, hint in _NEIGHBOURS if fits(seen)), _NOISE)
