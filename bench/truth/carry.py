"""Truth that the stage carries: ends touched once at a reference position, computed at every later one.

end(s) = touched + R (s - s_reference), with R the rigid registration's rotation and s the stage position as read back from the
controller. Only shifts are carried: a phantom that was turned, rearranged or shifted by hand is another `fixed`, and is touched
anew. Pure: it may not know files, instruments or persons.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.scoring.uncertainty import Component, TruthUncertainty
from bench.truth.point import Triple, TruthPoint, moved
from bench.truth.registration import Registration
from instruments.world.phantom import Phantom, PlatePose

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Reference:
    """Ends touched at one stage position (machine mm), with the teats' ``axes``; ``trial`` says when, ``fixed`` of what (`fixed_key`)."""

    trial: str
    fixed: str
    stage_mm: Triple
    points: tuple[TruthPoint, ...]
    axes: tuple[Triple, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers and text, for the store; `reference_from_dict` reads it back."""
        ends = [{"point_mm": list(p.point_mm), **p.uncertainty.as_dict()} for p in self.points]
        return {"trial": self.trial, "fixed": self.fixed, "stage_mm": list(self.stage_mm), "axes": self.axes, "ends": ends}


def reference_from_dict(stored: Mapping[str, Any]) -> Reference:
    """A reference from what `Reference.as_dict` gave."""
    points = []
    for end in stored["ends"]:
        x, y, z = end["point_mm"]
        points.append(TruthPoint((x, y, z), TruthUncertainty.of(Component(**line) for line in end["components"])))
    a, b, c = stored["stage_mm"]
    axes = tuple((x, y, z) for x, y, z in stored["axes"])
    return Reference(stored["trial"], stored["fixed"], (a, b, c), tuple(points), axes)


def fixed_key(phantom: Phantom, by_hand: PlatePose, yaw_rad: float) -> str:
    """A name for all that the stage's shifts leave as it is: the teats on their plate, the part of the pose set by hand, the turn."""
    what = (phantom.moved(PlatePose()), by_hand, round(yaw_rad, 9))
    return hashlib.sha256(repr(what).encode()).hexdigest()[:16]


def carried(
    reference: Reference, registration: Registration, stage_mm: Triple, u_registration_mm: Callable[[Floats], float | None]
) -> list[TruthPoint]:
    """The ends when the stage stands at ``stage_mm``; ``u_registration_mm`` is the table frame's part at a place, None without one."""
    way = registration.carry_mm(reference.stage_mm, stage_mm)
    covariance = registration.carry_covariance_mm2(reference.stage_mm, stage_mm)
    distance = float(np.linalg.norm(way))
    of = f"registration of {len(registration.stations)} positions, the stage's axes and repeatability"
    source = f"carried {distance:.0f} mm from the touches of {reference.trial}: {of}"
    ends = []
    for point in reference.points:
        there = np.array(point.point_mm) + way
        ends.append(moved(point, there, covariance, source, u_registration_mm(there)))
    return ends


@dataclass(frozen=True, slots=True)
class CheckTouch:
    """One end touched again: where the carry had it, and where it was."""

    teat: int
    touched_mm: Triple
    carried_mm: Triple
    limit_mm: float

    @property
    def off_mm(self) -> float:
        """Distance of the two."""
        return float(np.linalg.norm(np.subtract(self.touched_mm, self.carried_mm)))

    @property
    def held(self) -> bool:
        """Whether the carry was right, as far as the limit tells."""
        return self.off_mm <= self.limit_mm


def check_touches(touched: Sequence[TruthPoint], expected: Sequence[TruthPoint], limit_mm: float) -> tuple[CheckTouch, ...]:
    """The touched ends beside the carried ones, in the order of the teats."""
    pairs = zip(touched, expected, strict=True)
    return tuple(CheckTouch(teat, a.point_mm, b.point_mm, limit_mm) for teat, (a, b) in enumerate(pairs, 1))
