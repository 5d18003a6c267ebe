"""Why an arm was not signed on, or gives no position: an error class for each, under the tree in ``instruments.errors``.

Raise the most exact one, catch the one that you can act on. It may not know the session, nor the wire.
"""

from __future__ import annotations

from instruments.errors import DeviceError, LimitError, LinkError, ProtocolError

# Sign-on


class NoMicroScribeError(ProtocolError):
    """Something answers the sign-on, but not with the arm's words: another device, or a plug that loops back.

    Not for an arm whose later answers come damaged: that is a plain ProtocolError.
    """


class UnusableArmError(ProtocolError):
    """An arm, or its maker's, whose positions can't be computed; asking again doesn't help. Not raised itself: use one of three."""


class InterfaceBoxError(UnusableArmError):
    """An Immersion Interface Box ("IBOX"): its encoder bits mean something else."""


class UnknownFormatError(UnusableArmError):
    """The arm keeps its parameters in another format than "Format DH0.5"."""


class ParameterLengthError(UnusableArmError):
    """The arm states another length for a block of parameters. Not for a block that came short: that is damage."""


class UnstableUnitError(ProtocolError):
    """What the arm says of itself came differently each time. Replies have no checksum, so two have to agree."""


class AnotherArmError(DeviceError):
    """After a loss, an arm with another serial number answers."""


# In session


class SilentArmError(LinkError):
    """The arm doesn't answer, though the port is there. Not for a link that broke: that is a plain LinkError."""


class NoSessionError(LimitError):
    """Asked before sign-on, or after the session was lost."""


class StreamingError(LimitError):
    """Asked while a stream runs: its packets can't be told from answers."""


class NotHomedError(LimitError):
    """A position was asked for before the operator confirmed homing in this power cycle."""


class ArmMovesError(LimitError):
    """The packets of a reading are further apart than a still tip's."""
