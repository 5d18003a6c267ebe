"""Errors of the arm's driver, and a guess at which other device answered the sign-on."""

from __future__ import annotations

from collections.abc import Callable

from instruments.errors import DeviceError, LimitError, LinkError, ProtocolError
from instruments.microscribe.protocol import BEGIN, SYNC


class NoMicroScribeError(ProtocolError):
    """Another device, or a loop-back plug, answers the sign-on."""


class UnusableArmError(ProtocolError):
    """An arm whose positions can't be computed, or an interface box; asking again doesn't help."""


class AnotherArmError(DeviceError):
    """After a loss, an arm with another serial number answers."""


class SilentArmError(LinkError):
    """The arm doesn't answer, though the port is there. A broken link is a plain LinkError."""


class NoSessionError(LimitError):
    """Asked before sign-on, or after the session was lost."""


class NotHomedError(LimitError):
    """A position was asked for before the operator confirmed homing in this power cycle."""


class ArmMovesError(LimitError):
    """The packets of a reading are further apart than a still tip's."""


_FRAME_BYTES = range(5, 17)  # of a refusal or a short answer


def _modbus(seen: bytes) -> bool:
    """Whether it ends in a Modbus RTU frame, whose last two bytes are a CRC-16."""
    from pymodbus.framer import FramerRTU  # slow to import

    frames = (seen[-length:] for length in _FRAME_BYTES if length <= len(seen))
    return any(FramerRTU.compute_CRC(f[:-2]) == int.from_bytes(f[-2:], "big") for f in frames)


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
    """Whether the bytes look like a known other device: then no other baud rate is tried."""
    return any(fits(seen) for fits, _ in _NEIGHBOURS)


def what_to_try(seen: bytes) -> str:
    """A sentence for a person whose sign-on was answered with ``seen``, not empty."""
    return next((hint for fits, hint in _NEIGHBOURS if fits(seen)), _NOISE)
