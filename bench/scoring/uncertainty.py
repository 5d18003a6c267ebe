"""The budget of the truth: named standard uncertainties that combine to u (GUM, JCGM 100:2008, section 5.1.2, uncorrelated components).

u(e)^2 = u_arm^2 + u_registration^2 + u_definition^2 + u_resolution^2, per axis, mm. Knows numbers and their sources, no instrument.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import isfinite, sqrt


@dataclass(frozen=True, slots=True)
class Component:
    """One line of the budget: standard uncertainty along each axis, and where the figure comes from."""

    name: str
    u_mm: float
    source: str

    def __post_init__(self) -> None:
        if not (isfinite(self.u_mm) and self.u_mm >= 0.0):
            raise ValueError(f"uncertainty component {self.name!r}: {self.u_mm} mm must be finite and not negative")

    @classmethod
    def from_half_width(cls, name: str, half_width_mm: float, source: str) -> Component:
        """A value anywhere within +-half width with equal chance: u = half width / sqrt(3) (GUM 4.3.7)."""
        return cls(name, half_width_mm / sqrt(3.0), source)

    @classmethod
    def from_resolution(cls, name: str, step_mm: float, source: str) -> Component:
        """A reading rounded to a step: u = step / sqrt(12) (GUM F.2.2.1)."""
        return cls(name, step_mm / sqrt(12.0), source)

    @classmethod
    def from_expanded(cls, name: str, expanded_mm: float, coverage: float, source: str) -> Component:
        """A certificate's U with its coverage factor k: u = U / k."""
        if coverage <= 0.0:
            raise ValueError(f"uncertainty component {name!r}: coverage factor {coverage} must be above 0")
        return cls(name, expanded_mm / coverage, source)


@dataclass(frozen=True, slots=True)
class TruthUncertainty:
    """The budget of the ground truth, per axis. Two components of one name are a mistake and raise ValueError."""

    components: tuple[Component, ...]

    def __post_init__(self) -> None:
        names = [c.name for c in self.components]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"uncertainty budget: {', '.join(twice)} given twice; a contribution counts once")
        if not names:
            raise ValueError("uncertainty budget: no component at all; a truth without uncertainty has to say so with a component of 0 mm")

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
