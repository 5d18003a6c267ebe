"""Errors of the arm's driver, and which other device may have answered the sign-on."""

from __future__ import annotations

import re
from collections.abc import Callable

from instruments.errors import DeviceError, LimitError, LinkError, ProtocolError, TouchAgainError
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


class ArmMovesError(TouchAgainError):
    """The packets of a reading are further apart than a still tip's."""


_FRAME_BYTES = range(5, 17)  # of a refusal or a short answer


def _modbus(seen: bytes) -> bool:
    """Whether it ends in a Modbus RTU frame, whose last two bytes are a CRC-16."""
    from pymodbus.framer import FramerRTU  # slow to import

    frames = (seen[-length:] for length in _FRAME_BYTES if length <= len(seen))
    return any(FramerRTU.compute_CRC(f[:-2]) == int.from_bytes(f[-2:], "big") for f in frames)


_NEIGHBOURS: tuple[tuple[Callable[[bytes], bool], str], ...] = (
    (
        lambda seen: b"Grbl" in seen or b"['$'" in seen,
        "It talks like a GRBL board: is this the stage's port? Give the arm's",
    ),
    (
        lambda seen: SYNC in seen or BEGIN in seen,
        "It echoes what it receives: is a loop-back plug or a modem on this port? Give the arm's",
    ),
    (
        lambda seen: b"ok\r\n" in seen or b"error:" in seen or b"ALARM:" in seen,
        "It talks like a motion controller: is this the stage's port? Give the arm's",
    ),
    (_modbus, "It answers in Modbus frames: is this the bath's port? Give the arm's"),
    (
        # enough text to be no accident of a wrong baud rate
        lambda seen: re.fullmatch(rb"[\x20-\x7e\r\n\t]{4,}", seen) is not None,
        "It talks in plain text: which device is on this port? Give the arm's",
    ),
)
NOISE_HINT = (
    "No known device talks so: is the baud rate right, and is it the arm's port? Else switch the"
    " arm off and on, and try again"
)


def diagnosis(seen: bytes) -> str | None:
    """Which known other device answered the sign-on with ``seen``, and what to do; else None."""
    return next((hint for fits, hint in _NEIGHBOURS if fits(seen)), None)
