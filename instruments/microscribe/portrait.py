"""What is known of one arm once it has signed on, as values, as a shape and for the record. Pure."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from instruments.microscribe.configuration import Identity, Maxima, Parameters, angle_rad
from instruments.microscribe.kinematics import COUNT_MODULUS, ArmGeometry


@dataclass(frozen=True, slots=True)
class Portrait:
    """All that an arm says of itself at sign-on; beta is 0 where it has none."""

    identity: Identity
    maxima: Maxima
    parameters: Parameters
    beta: int

    def geometry(self, tip_longer_mm: float) -> ArmGeometry:
        """Its shape, with a tip that is so much longer than the standard one."""
        return ArmGeometry.from_block(self.parameters, angle_rad(self.beta), self.maxima.turns).with_tip(tip_longer_mm)

    def record(self) -> dict[str, object]:
        """The names, and all numbers as the arm gave them: enough to compute every position anew from its counts."""
        return {**asdict(self.identity), "maxima": asdict(self.maxima), "parameters": asdict(self.parameters), "beta": self.beta}

    def warnings(self) -> list[str]:
        """A sentence for each joint whose counts, modulo 2^14, lose its angle after a few turns."""
        return [
            f"joint {joint} has {turn} counts a turn, and {COUNT_MODULUS} is no multiple of that: its angle is lost after so many counts"
            for joint, turn in enumerate(self.maxima.turns)
            if turn and COUNT_MODULUS % turn
        ]
