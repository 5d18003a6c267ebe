"""Is the arm as good as it is said to be? Figures of the two tests that standards give for arms,
from touches.

Articulated location: the tip sits in one conical divot while wrist and elbow swing. Every reading
is of one point, so what they differ by is the arm's error. Length: a calibrated distance, both ends
touched, in several directions. After ASME B89.4.22 (single point articulation; volumetric
performance) and ISO 10360-12 (articulated location; length), but for two things: a tip in a divot
stands for their sphere, and the tester chooses how many.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LEAST_TOUCHES = 5  # the orientations of ISO 10360-12
TOUCHES = 10  # of ASME B89.4.22, single point articulation
LEAST_SWING_DEG = 30.0  # with less, the joints hardly moved, and the test could not fail


@dataclass(frozen=True, slots=True, eq=False)
class LocationTest:
    """Readings of one divot: ``tips_mm`` (n, 3), ``axes`` (n, 3) unit, from the tip up the stylus.
    Raises ValueError for fewer than two.
    """

    where: str
    tips_mm: Floats
    axes: Floats

    def __post_init__(self) -> None:
        if (
            self.tips_mm.ndim != 2
            or self.tips_mm.shape[1:] != (3,)
            or self.tips_mm.shape != self.axes.shape
            or len(self.tips_mm) < 2
        ):
            raise ValueError(
                "a location test needs (n, 3) tips and axes, n at least 2; got"
                f" {self.tips_mm.shape} and {self.axes.shape}"
            )

    @property
    def n(self) -> int:
        """How many readings."""
        return len(self.tips_mm)

    @property
    def centre_mm(self) -> Floats:
        """The mean of the readings (3,)."""
        return np.asarray(self.tips_mm.mean(axis=0))

    @property
    def deviations_mm(self) -> Floats:
        """Distance of each reading from the mean (n,): delta_i of ASME B89.4.22."""
        return np.asarray(np.linalg.norm(self.tips_mm - self.centre_mm, axis=1))

    @property
    def largest_mm(self) -> float:
        """The articulated location error: the largest deviation."""
        return float(self.deviations_mm.max())

    @property
    def two_sd_mm(self) -> float:
        """2 s with s^2 = sum(delta_i^2) / (n - 1), as ASME B89.4.22 states it."""
        return 2.0 * float(np.sqrt(np.sum(self.deviations_mm**2) / (self.n - 1)))

    @property
    def sphere_mm(self) -> float:
        """Diameter of the least sphere that holds all readings: the form in which ISO 10360-12
        states it.
        """
        return least_sphere_mm(self.tips_mm)

    @property
    def swing_deg(self) -> float:
        """The largest angle between two stylus directions."""
        return float(np.degrees(np.arccos(np.clip((self.axes @ self.axes.T).min(), -1.0, 1.0))))


@dataclass(frozen=True, slots=True, eq=False)
class LengthTest:
    """One calibrated length: its two ends as touched, (3,) mm each."""

    where: str
    a_mm: Floats
    b_mm: Floats
    calibrated_mm: float

    @property
    def measured_mm(self) -> float:
        """The distance between the ends."""
        return float(np.linalg.norm(self.b_mm - self.a_mm))

    @property
    def error_mm(self) -> float:
        """Measured less calibrated."""
        return self.measured_mm - self.calibrated_mm


@dataclass(frozen=True, slots=True)
class Limits:
    """What an arm has to keep, mm. ``length_mm`` is None where lengths are not asked for."""

    location_mm: float
    length_mm: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Verification:
    """What one arm showed on one day."""

    made: datetime
    serial_number: str
    locations: tuple[LocationTest, ...]
    lengths: tuple[LengthTest, ...] = ()

    @property
    def location_mm(self) -> float:
        """The largest articulated location error over the distances."""
        return max(test.largest_mm for test in self.locations)

    @property
    def length_mm(self) -> float | None:
        """The largest error of a length, without its sign; None where none was measured."""
        return max((abs(test.error_mm) for test in self.lengths), default=None)

    @property
    def length_two_rms_mm(self) -> float | None:
        """2 sqrt(sum(e^2) / n), as ASME B89.4.22 states the volumetric performance; None where none
        was measured.
        """
        errors = [test.error_mm for test in self.lengths]
        return 2.0 * float(np.sqrt(np.mean(np.square(errors)))) if errors else None

    def faults(self, limits: Limits) -> tuple[str, ...]:
        """A sentence for each limit that the arm breaks, and for each thing that was not shown.
        Empty: verified.
        """
        return (*self.broken(limits), *self.gaps(limits))

    def broken(self, limits: Limits) -> tuple[str, ...]:
        """A sentence for each limit that the arm breaks."""
        found = [fault for test in self.locations for fault in broken_by(test, limits.location_mm)]
        return (*found, *_wrong_lengths(self.lengths, limits.length_mm))

    def gaps(self, limits: Limits) -> tuple[str, ...]:
        """A sentence for each thing that was not shown: too few touches, too little swing, no
        length.
        """
        found = [gap for test in self.locations for gap in gaps_of(test, LEAST_TOUCHES)]
        none = limits.length_mm is not None and not self.lengths
        return (*found, *(["no calibrated length was measured"] if none else []))


def as_dict(verification: Verification) -> dict[str, Any]:
    """Plain numbers and text: what was touched, from which all figures follow."""
    locations = [
        {"where": t.where, "tips_mm": t.tips_mm.tolist(), "axes": t.axes.tolist()}
        for t in verification.locations
    ]
    lengths = [
        {
            "where": t.where,
            "a_mm": t.a_mm.tolist(),
            "b_mm": t.b_mm.tolist(),
            "calibrated_mm": t.calibrated_mm,
        }
        for t in verification.lengths
    ]
    made = verification.made.isoformat()
    return {
        "made": made,
        "serial_number": verification.serial_number,
        "locations": locations,
        "lengths": lengths,
    }


def from_dict(table: Mapping[str, Any]) -> Verification:
    """The inverse of `as_dict`."""
    locations = tuple(
        LocationTest(t["where"], np.array(t["tips_mm"]), np.array(t["axes"]))
        for t in table["locations"]
    )
    lengths = tuple(
        LengthTest(t["where"], np.array(t["a_mm"]), np.array(t["b_mm"]), t["calibrated_mm"])
        for t in table["lengths"]
    )
    return Verification(
        datetime.fromisoformat(table["made"]), table["serial_number"], locations, lengths
    )


def broken_by(test: LocationTest, limit_mm: float) -> list[str]:
    """What speaks against the arm at one divot."""
    if test.largest_mm <= limit_mm:
        return []
    return [
        (
            f"{test.where}: readings of one point lie up to {test.largest_mm:.2f} mm from"
            f" their mean, limit {limit_mm:g} mm"
        )
    ]


def gaps_of(test: LocationTest, least: int) -> list[str]:
    """Why a test at one divot shows too little, whatever its figures."""
    gaps = []
    if test.swing_deg < LEAST_SWING_DEG:
        gaps.append(
            f"{test.where}: the stylus was swung by {test.swing_deg:.0f} degrees only;"
            f" {LEAST_SWING_DEG:g} are needed"
        )
    if test.n < least:
        gaps.append(f"{test.where}: {test.n} touches only; {least} are needed")
    return gaps


def _wrong_lengths(tests: Sequence[LengthTest], limit_mm: float | None) -> list[str]:
    worst = max(tests, key=lambda test: abs(test.error_mm), default=None)
    if worst is None or limit_mm is None or abs(worst.error_mm) <= limit_mm:
        return []
    return [
        (
            f"{worst.where}: {worst.calibrated_mm:g} mm were measured {worst.error_mm:+.2f}"
            f" mm wrong, limit {limit_mm:g} mm"
        )
    ]


def least_sphere_mm(points_mm: Floats) -> float:
    """Diameter of the least sphere round points (n, 3); 0 for a single one.

    The least sphere touches two, three or four of them: the largest of the least spheres of all
    such sets is it, since each set's is no larger than that of the whole. Meant for the few dozen
    readings of a test.
    """
    return max(
        (
            _sphere_of(points_mm[list(few)])
            for k in (2, 3, 4)
            for few in combinations(range(len(points_mm)), k)
        ),
        default=0.0,
    )


def _sphere_of(few: Floats) -> float:
    """Diameter of the sphere through all points (k, 3) with its centre in their plane; 0 where that
    isn't their least one.
    """
    sides = few[1:] - few[0]
    weights, *_ = np.linalg.lstsq(2.0 * sides @ sides.T, np.sum(sides**2, axis=1), rcond=None)
    if (weights < 0.0).any() or weights.sum() > 1.0:
        return 0.0  # the centre is outside their hull, so fewer of them have the same least sphere
    return 2.0 * float(np.linalg.norm(weights @ sides))
