"""The stage's axes and what they may be off by: scale of each, and the right angles between them. Pure.

E = [[sx, -gxy, -gxz], [0, sy, -gyz], [0, 0, sz]]: a stage that is told to go by D goes by (I + E) D, in its own axes. The x axis is
the reference, and g is by how much the angle between two axes exceeds a right one.

With q the touched positions less their mean, touch noise n turns a rigid fit by w = H^-1 sum q x n, H = sum(|q|^2 I - q q^T), and axes
that are off by E turn it by w = H^-1 sum q x E q; a carry by D is then off by w x D - E D. All to first order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NAMES = ("scale x", "scale y", "squareness xy", "scale z", "squareness xz", "squareness yz")
_FLAT_MM = 1.0  # a height that varies by less has not been exercised

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class StageAccuracy:
    """What the stage is stated to be good for, as standard uncertainties: scale of each axis, squareness, and coming back to a place."""

    scale_u: float
    squareness_u_rad: float
    repeatability_mm: float

    @property
    def deformation(self) -> Floats:
        """Variances (6,) in the order of `NAMES`."""
        s, g = self.scale_u**2, self.squareness_u_rad**2
        return np.array([s, s, g, s, g, g])


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """How far one property of the axes is from ideal: 0 where the stage is perfect; ``u`` is its standard uncertainty."""

    name: str
    value: float
    u: float

    @property
    def significant(self) -> bool:
        """Beyond what touch noise explains in 99 of 100 cases."""
        return abs(self.value) > 2.576 * self.u


@dataclass(frozen=True, slots=True, eq=False)
class FreeFit:
    """The fit with all its freedom: small ``rotation`` (3,), ``theta`` (3 or 6,), both together ``covariance`` for u = 1 mm."""

    rotation: Floats
    theta: Floats
    covariance: Floats
    left_over: Floats
    freedom: int


def free_fit(q: Floats, seen: Floats) -> FreeFit:
    """The fit of q (n, 3) to the touches ``seen`` (n, 3) in the stage's axes, both less their mean; heights only where they varied."""
    used = 6 if np.std(q[:, 2]) > _FLAT_MM and np.linalg.svd(q, compute_uv=False)[2] > _FLAT_MM else 3
    turns = [np.cross(axis, q).ravel() for axis in np.eye(3)]
    bends = [(q @ entry.T).ravel() for entry in _entries()[:used]]
    design = np.column_stack([*turns, *bends])
    found = np.asarray(np.linalg.lstsq(design, (seen - q).ravel(), rcond=None)[0], dtype=np.float64)
    left_over = np.asarray((seen - q).ravel() - design @ found)
    freedom = 3 * len(q) - 3 - design.shape[1]
    covariance = np.asarray(np.linalg.inv(design.T @ design), dtype=np.float64)
    return FreeFit(found[:3], found[3:], covariance, left_over, freedom)


def _entries() -> list[Floats]:
    """The matrices (3, 3) of E's entries, in the order of `NAMES`."""
    places = ((0, 0), (1, 1), (0, 1), (2, 2), (0, 2), (1, 2))
    signed = [np.array([[float((r, c) == place) for c in range(3)] for r in range(3)]) for place in places]
    return [entry if r == c else -entry for entry, (r, c) in zip(signed, places, strict=True)]


def bent_mm(q: Floats, way_mm: Floats) -> Floats:
    """(3, 6): how a carry by ``way_mm`` (3,) is off for each entry of E, with the turn of the fit to q (n, 3) that it brings."""
    inverse = np.linalg.inv(np.sum(q**2) * np.eye(3) - q.T @ q)
    columns = []
    for entry in _entries():
        turned = inverse @ np.sum(np.cross(q, q @ entry.T), axis=0)
        columns.append(np.cross(turned, way_mm) - entry @ way_mm)
    return np.column_stack(columns)
