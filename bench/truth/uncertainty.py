"""The budget of the truth: named standard uncertainties that combine to u (GUM, JCGM 100:2008,
section 5.1.2, uncorrelated components).

u(e)^2 = u_arm^2 + u_registration^2 + u_definition^2 + u_resolution^2, per axis, mm. Knows numbers
and their sources, no instrument.

One teat end as the truth has it: a point, how it was had, and the budget of its uncertainty.

Pure: figures in, values out. What is measured is defined in `instruments.teat_end`; who touched,
and where the stage stood, is others' business.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from math import hypot, isfinite, sqrt

import numpy as np
from numpy.typing import NDArray

from bench.rig.model import Arm


@dataclass(frozen=True, slots=True)
class Component:
    """One line of the budget: standard uncertainty along each axis, and where the figure comes
    from.
    """

    name: str
    u_mm: float
    source: str

    def __post_init__(self) -> None:
        if not (isfinite(self.u_mm) and self.u_mm >= 0.0):
            raise ValueError(
                f"uncertainty component {self.name!r}: {self.u_mm} mm must be finite and not"
                " negative"
            )

    @classmethod
    def from_half_width(cls, name: str, half_width_mm: float, source: str) -> Component:
        """A value anywhere within +-half width with equal chance: u = half width / sqrt(3) (GUM
        4.3.7).
        """
        return cls(name, half_width_mm / sqrt(3.0), source)

    @classmethod
    def from_resolution(cls, name: str, step_mm: float, source: str) -> Component:
        """A reading rounded to a step: u = step / sqrt(12) (GUM F.2.2.1)."""
        return cls(name, step_mm / sqrt(12.0), source)

    @classmethod
    def from_expanded(
        cls, name: str, expanded_mm: float, coverage: float, source: str
    ) -> Component:
        """A certificate's U with its coverage factor k: u = U / k."""
        if coverage <= 0.0:
            raise ValueError(
                f"uncertainty component {name!r}: coverage factor {coverage} must be above 0"
            )
        return cls(name, expanded_mm / coverage, source)


@dataclass(frozen=True, slots=True)
class TruthUncertainty:
    """The budget of the ground truth, per axis. Two components of one name are a mistake and raise
    ValueError.
    """

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

    @classmethod
    def of(cls, components: Iterable[Component]) -> TruthUncertainty:
        """The budget of any iterable of components."""
        return cls(tuple(components))

    @property
    def u_mm(self) -> float:
        """Combined standard uncertainty along each axis."""
        return sqrt(sum(c.u_mm**2 for c in self.components))

    def expanded_mm(self, coverage: float = 2.0) -> float:
        """U = k u along each axis."""
        return coverage * self.u_mm

    def shares(self) -> dict[str, float]:
        """Each component's share of the variance, from 0 to 1; all 0 where the budget is 0."""
        total = self.u_mm**2
        return {c.name: c.u_mm**2 / total if total else 0.0 for c in self.components}

    def as_dict(self) -> dict[str, object]:
        """Plain numbers and text."""
        lines = [{"name": c.name, "u_mm": c.u_mm, "source": c.source} for c in self.components]
        return {"u_mm": self.u_mm, "expanded_mm": self.expanded_mm(), "components": lines}


# 0.105 mm rms in space over random poses (the arm's fact sheet), along one axis
ROUNDING_MM = 0.105 / 3**0.5
CHI2_95 = 7.814727903251179  # 95 % of chi-square with 3 degrees of freedom
REGISTRATION, CARRY = "registration", "carry"
REGISTRATION_SOURCE = (
    "the table frame's three touches, each with the arm's accuracy, propagated to this teat end"
)

Floats = NDArray[np.float64]
Triple = tuple[float, float, float]
Matrix = tuple[Triple, Triple, Triple]


class How(StrEnum):
    """How a truth was had."""

    TOUCHED = "touched"
    CARRIED = "carried"


@dataclass(frozen=True, slots=True)
class TruthPoint:
    """A teat end: ``point_mm`` in the world frame, and its budget of standard uncertainties along
    one axis.

    ``carry_mm2`` is the covariance that the carry added, None for a touched end; its line in the
    budget is the worst direction's.
    """

    point_mm: Triple
    uncertainty: TruthUncertainty
    how: How = How.TOUCHED
    carry_mm2: Matrix | None = None

    @property
    def covariance_mm2(self) -> Floats:
        """(3, 3): the carry as it is, all other components the same along every axis."""
        alike = sum(c.u_mm**2 for c in self.uncertainty.components if c.name != CARRY)
        return np.asarray(
            alike * np.eye(3) + (0.0 if self.carry_mm2 is None else np.array(self.carry_mm2))
        )

    def holds(self, point_mm: Iterable[float]) -> bool:
        """Whether the stated 95 % region, an ellipsoid of
        ``covariance_mm2``, holds a point (3,).
        """
        off = np.asarray(tuple(point_mm), dtype=np.float64) - np.array(self.point_mm)
        return bool(off @ np.linalg.solve(self.covariance_mm2, off) <= CHI2_95)


def touched(tips_mm: Floats, arm: Arm, *, registration_mm: float | None = None) -> TruthPoint:
    """The mean of readings (n, 3) of one teat end, tip radius already taken off.

    The scatter of the readings enters as the uncertainty of their mean. ``registration_mm`` is what
    the table frame adds at this place, None where the world is the arm's own frame. Raises
    ValueError without a reading.
    """
    tips = np.asarray(tips_mm, dtype=np.float64)
    if tips.ndim != 2 or tips.shape[1] != 3 or not len(tips):
        raise ValueError(f"touches must be (n, 3) with n at least 1, not {tips.shape}")
    scatter = (
        float(np.sqrt(np.mean(np.var(tips, axis=0, ddof=1)) / len(tips))) if len(tips) > 1 else 0.0
    )
    frame = (
        ()
        if registration_mm is None
        else (Component(REGISTRATION, registration_mm, REGISTRATION_SOURCE),)
    )
    ball = (
        ()
        if not arm.tip_radius_mm
        else (Component("tip radius", tip_radius_u_mm(arm), _tip_source(arm)),)
    )
    components = (
        Component(
            "arm", arm.accuracy_mm, "the arm's stated accuracy, taken along each axis (rig file)"
        ),
        *frame,
        Component(
            "definition",
            arm.definition_mm,
            "how well a hand finds the apex of the rounded end (rig file)",
        ),
        *ball,
        Component(
            "resolution", ROUNDING_MM, "rounding of the arm's encoder counts, rms over its reach"
        ),
        Component("scatter", scatter, f"standard deviation of the mean of {len(tips)} touches"),
    )
    return TruthPoint(triple(tips.mean(axis=0)), TruthUncertainty(components))


def moved(
    point: TruthPoint, to_mm: Floats, carry_mm2: Floats, source: str, registration_mm: float | None
) -> TruthPoint:
    """``point`` carried to (3,): its own budget, the table frame's part at the new place, and a
    line for the carry.
    """
    kept = [
        (
            replace(c, u_mm=registration_mm)
            if c.name == REGISTRATION and registration_mm is not None
            else c
        )
        for c in point.uncertainty.components
    ]
    worst = float(np.sqrt(max(np.linalg.eigvalsh(carry_mm2)[-1], 0.0)))
    rows = triple(carry_mm2[0]), triple(carry_mm2[1]), triple(carry_mm2[2])
    return TruthPoint(
        triple(to_mm),
        TruthUncertainty.of([*kept, Component(CARRY, worst, source)]),
        How.CARRIED,
        rows,
    )


def reading_u_mm(arm: Arm) -> float:
    """Standard uncertainty along an axis by which two readings of one end differ: the hand and the
    rounding, not the arm's accuracy.
    """
    return hypot(arm.definition_mm, ROUNDING_MM)


def end_u_mm(arm: Arm, readings: int) -> float:
    """Standard uncertainty along an axis of one end's mean, against that of another place, before
    anything was read.
    """
    return sqrt(
        arm.accuracy_mm**2
        + arm.definition_mm**2
        + tip_radius_u_mm(arm) ** 2
        + ROUNDING_MM**2
        + reading_u_mm(arm) ** 2 / readings
    )


def tip_radius_u_mm(arm: Arm) -> float:
    """What a ball tip adds: the teat's axis is known within ``axis_u_rad``, which turns the radius;
    and the radius itself.
    """
    return (
        hypot(arm.tip_radius_mm * arm.axis_u_rad, arm.tip_radius_u_mm) if arm.tip_radius_mm else 0.0
    )


def triple(vector: Floats) -> Triple:
    """A vector (3,) as three plain numbers."""
    x, y, z = (float(v) for v in vector)
    return x, y, z


def _tip_source(arm: Arm) -> str:
    return (
        f"ball tip of {arm.tip_radius_mm:g} mm, along a teat axis known within {arm.axis_u_rad:g}"
        " rad (rig file)"
    )
