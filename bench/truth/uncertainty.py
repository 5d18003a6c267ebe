"""A teat end as the truth has it: a point, how it was had, and its uncertainty budget of named
standard uncertainties (GUM, JCGM 100:2008, section 5.1.2, uncorrelated), per axis, mm: u(e)^2 =
u_arm^2 + u_registration^2 + u_definition^2 + u_resolution^2 + .... The measurand:
`instruments.world.phantom.TEAT_END`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from enum import StrEnum
from math import isfinite, sqrt

import numpy as np

from bench.record.recording import TruthRow
from bench.scoring.errors import Floats


@dataclass(frozen=True, slots=True)
class Component:
    """One line of the budget: standard uncertainty along each axis, and the figure's source."""

    name: str
    u_mm: float
    source: str

    def __post_init__(self) -> None:
        if not (isfinite(self.u_mm) and self.u_mm >= 0.0):
            raise ValueError(
                f"uncertainty component {self.name!r}: {self.u_mm} mm must be finite and not"
                " negative"
            )


@dataclass(frozen=True, slots=True)
class TruthUncertainty:
    """The budget per axis. Raises ValueError for two components of one name."""

    components: tuple[Component, ...]

    def __post_init__(self) -> None:
        names = [c.name for c in self.components]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(
                f"uncertainty budget: {', '.join(twice)} given twice; a contribution counts once"
            )
        if not names:
            raise ValueError(
                "uncertainty budget: no component at all; a truth without uncertainty has to say so"
                " with a component of 0 mm"
            )

    @property
    def u_mm(self) -> float:
        """Combined standard uncertainty along each axis."""
        return sqrt(sum(c.u_mm**2 for c in self.components))

    def as_dict(self) -> dict[str, object]:
        """Plain numbers and text; expanded by k = 2."""
        lines = [asdict(c) for c in self.components]
        return {"u_mm": self.u_mm, "expanded_mm": 2.0 * self.u_mm, "components": lines}


CHI2_95 = 7.814727903251179  # 95 % of chi-square with 3 degrees of freedom
# names of components
ARM, REGISTRATION, TIP_RADIUS, CARRY = "arm", "registration", "tip radius", "carry"

Triple = tuple[float, float, float]


class TruthMethod(StrEnum):
    TOUCHED = "touched"
    CARRIED = "carried"


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueEnd(TruthRow):
    """A teat end of the bench's own truth, from its touches to its scores, with its budget along
    one axis. ``carry_mm2`` is the covariance that the carry added (None for touched), in the budget
    by its worst direction.
    """

    uncertainty: TruthUncertainty
    how: TruthMethod = TruthMethod.TOUCHED
    carry_mm2: tuple[Triple, ...] | None = None

    @classmethod
    def at(cls, xyz_mm: Iterable[float], uncertainty: TruthUncertainty) -> TrueEnd:
        """Touched there; which teat it is, and whether it is seen, is for the trial to say."""
        place = triple(xyz_mm)
        return cls("", "", place, True, uncertainty.u_mm, uncertainty=uncertainty)

    @property
    def covariance_mm2(self) -> Floats:
        """(3, 3): the carry as it is, all other components the same along every axis."""
        alike = sum(c.u_mm**2 for c in self.uncertainty.components if c.name != CARRY)
        return np.asarray(
            alike * np.eye(3) + (0.0 if self.carry_mm2 is None else np.array(self.carry_mm2))
        )


def triple(vector: Iterable[float]) -> Triple:
    x, y, z = (float(v) for v in vector)
    return x, y, z
