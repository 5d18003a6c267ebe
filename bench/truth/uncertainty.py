"""A teat end as the truth has it: a point, how it was had, and its uncertainty budget of named
standard uncertainties (GUM, JCGM 100:2008, section 5.1.2, uncorrelated), per axis, mm: u(e)^2 =
u_arm^2 + u_registration^2 + u_definition^2 + u_resolution^2 + .... The measurand:
`instruments.teat_end`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from math import hypot, isfinite, sqrt

import numpy as np
from numpy.typing import NDArray

from bench.rig.model import Arm


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
    """The budget of the ground truth, per axis. Raises ValueError for two components of
    one name.
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

    @property
    def u_mm(self) -> float:
        """Combined standard uncertainty along each axis."""
        return sqrt(sum(c.u_mm**2 for c in self.components))

    def as_dict(self) -> dict[str, object]:
        """Plain numbers and text; expanded by k = 2."""
        lines = [asdict(c) for c in self.components]
        return {"u_mm": self.u_mm, "expanded_mm": 2.0 * self.u_mm, "components": lines}


# 0.105 mm rms in space over random poses (the arm's fact sheet), along one axis
ROUNDING_MM = 0.105 / 3**0.5
CHI2_95 = 7.814727903251179  # 95 % of chi-square with 3 degrees of freedom
REGISTRATION, CARRY = "registration", "carry"

Floats = NDArray[np.float64]
Triple = tuple[float, float, float]


class How(StrEnum):
    """How a truth was had."""

    TOUCHED = "touched"
    CARRIED = "carried"


@dataclass(frozen=True, slots=True)
class TruthPoint:
    """A teat end: ``point_mm`` in the world frame, and its budget along one axis. ``carry_mm2`` is
    the covariance that the carry added (None for touched), in the budget by its worst direction.
    """

    point_mm: Triple
    uncertainty: TruthUncertainty
    how: How = How.TOUCHED
    carry_mm2: tuple[Triple, ...] | None = None

    @property
    def covariance_mm2(self) -> Floats:
        """(3, 3): the carry as it is, all other components the same along every axis."""
        alike = sum(c.u_mm**2 for c in self.uncertainty.components if c.name != CARRY)
        return np.asarray(
            alike * np.eye(3) + (0.0 if self.carry_mm2 is None else np.array(self.carry_mm2))
        )

    def holds(self, point_mm: Iterable[float]) -> bool:
        """Whether the stated 95 % region, an ellipsoid, holds a point (3,)."""
        off = np.asarray(tuple(point_mm), dtype=np.float64) - np.array(self.point_mm)
        return bool(off @ np.linalg.solve(self.covariance_mm2, off) <= CHI2_95)


def touched(tips_mm: Floats, arm: Arm, *, registration_mm: float | None = None) -> TruthPoint:
    """The mean of readings (n, 3) of one teat end, tip radius already taken off; their scatter
    enters as the uncertainty of their mean. ``registration_mm`` is the table frame's part, None
    without one. Raises ValueError without a reading.
    """
    tips = np.asarray(tips_mm, dtype=np.float64)
    if tips.ndim != 2 or tips.shape[1] != 3 or not len(tips):
        raise ValueError(f"touches must be (n, 3) with n at least 1, not {tips.shape}")
    n = len(tips)
    scatter = float(np.sqrt(np.mean(np.var(tips, axis=0, ddof=1)) / n)) if n > 1 else 0.0
    frame = "the table frame's three touches, each with the arm's accuracy, propagated to this end"
    ball = (
        f"ball tip of {arm.tip_radius_mm:g} mm, along a teat axis known within {arm.axis_u_rad:g}"
        " rad (rig file)"
    )
    apex = "how well a hand finds the apex of the rounded end (rig file)"
    lines: list[tuple[str, float | None, str]] = [
        ("arm", arm.u_mm, _source_of(arm)),
        (REGISTRATION, registration_mm, frame),
        ("definition", arm.definition_mm, apex),
        ("tip radius", tip_radius_u_mm(arm) or None, ball),
        ("resolution", ROUNDING_MM, "rounding of the arm's encoder counts, rms over its reach"),
        ("scatter", scatter, f"standard deviation of the mean of {n} touches"),
    ]
    budget = tuple(Component(name, u, source) for name, u, source in lines if u is not None)
    return TruthPoint(triple(tips.mean(axis=0)), TruthUncertainty(budget))


def moved(
    point: TruthPoint, to_mm: Floats, carry_mm2: Floats, source: str, registration_mm: float | None
) -> TruthPoint:
    """``point`` carried to (3,): its budget, with the table frame's part there and a line for the
    carry.
    """
    kept = [
        c if c.name != REGISTRATION or registration_mm is None else replace(c, u_mm=registration_mm)
        for c in point.uncertainty.components
    ]
    worst = float(np.sqrt(max(np.linalg.eigvalsh(carry_mm2)[-1], 0.0)))
    budget = TruthUncertainty((*kept, Component(CARRY, worst, source)))
    return TruthPoint(triple(to_mm), budget, How.CARRIED, tuple(triple(row) for row in carry_mm2))


def reading_u_mm(arm: Arm) -> float:
    """By which two readings of one end differ along an axis: hand and rounding, not the arm's
    accuracy.
    """
    return hypot(arm.definition_mm, ROUNDING_MM)


def end_u_mm(arm: Arm, readings: int) -> float:
    """Along an axis, of one end's mean against that of another place, before anything was read."""
    scatter = reading_u_mm(arm) / sqrt(readings)
    return hypot(arm.u_mm, arm.definition_mm, tip_radius_u_mm(arm), ROUNDING_MM, scatter)


def _source_of(arm: Arm) -> str:
    who = arm.accuracy_source or "the arm's stated accuracy, no source named"
    by = f", {arm.accuracy_df:g} degrees of freedom, so widened" if arm.accuracy_df else ""
    return f"{who}{by}, taken along each axis (rig file)"


def tip_radius_u_mm(arm: Arm) -> float:
    """Of a ball tip: its radius, turned by the teat axis's uncertainty, and the radius itself."""
    turned_mm = arm.tip_radius_mm * arm.axis_u_rad
    return hypot(turned_mm, arm.tip_radius_u_mm) if arm.tip_radius_mm else 0.0


def triple(vector: Iterable[float]) -> Triple:
    """A vector (3,) as three plain numbers."""
    x, y, z = (float(v) for v in vector)
    return x, y, z
