"""Which arm an emulator is: all that the arm says of itself, and its counts on the peg. It may not know the wire's state."""

from __future__ import annotations

from dataclasses import astuple, dataclass

from instruments.microscribe import configuration as conf
from instruments.microscribe.configuration import Identity, Maxima, Parameters
from instruments.microscribe.kinematics import ArmGeometry
from instruments.microscribe.protocol import Code


@dataclass(frozen=True, slots=True)
class ArmIdentity:
    """One arm: names, full scales, Denavit-Hartenberg parameters, beta, and home counts."""

    names: Identity
    maxima: Maxima
    parameters: Parameters
    beta: int
    home: tuple[int, ...]

    def geometry(self) -> ArmGeometry:
        """The shape that a host computes from what the arm says. Raises ValueError unless there are six joints."""
        beta_rad = conf.angle_rad(self.beta) if self.names.has_beta else 0.0
        return ArmGeometry.from_block(self.parameters, beta_rad, self.maxima.turns)

    def replies(self) -> dict[int, bytes]:
        """Reply by code. The extended parameters only with "Beta" in the comment. Raises WireError for what doesn't fit."""
        replies = {int(code): conf.encode_name(code, name) for code, name in zip(conf.NAMES, astuple(self.names), strict=True)}
        replies[Code.MAXIMA] = conf.encode_maxima(self.maxima)
        replies[Code.PARAMETERS] = conf.encode_parameters(self.parameters)
        if self.names.has_beta:
            replies[Code.EXTENDED] = conf.encode_extended(self.beta)
        return replies


# A real 3DX; its home counts are those recorded at rest.
UNIT_40937 = ArmIdentity(
    names=Identity("MicroScribe3D", "MSCR", "DX", "40937", "Standard+Beta", "Format DH0.5", "HCI 2.0"),
    maxima=Maxima(0x03, 0x3FFF, (0,) * 8, 0, (0x3FFF, 0x3FFF, 0x1FFF, 0x0FFF, 0x0FFF, 0)),
    parameters=Parameters(
        alpha=(0, 16373, -7, 16357, -16382, -16372),
        a=(0, 960, 10256, 533, -401, 399),
        d=(8300, -878, -3, 9244, 320, -5274),
    ),
    beta=3,
    home=(13903, 6238, 6868, 4098, 3193, 8416),
)
