"""Repeated poses: accuracy and repeatability (ISO 9283:1998, 7.2), distances (7.3), drift, and the components of spread (ISO 5725-2:1994).

Standard deviations divide by n - 1 here, as both standards do. Knows only points and numbers; a spread of one value is None.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
import numpy.typing as npt

from bench.scoring.points import Floats, as_points, as_values


@dataclass(frozen=True, slots=True)
class PoseAccuracy:
    """AP = |mean - commanded| with its components, and RP = mean(l) + 3 sd(l), l_j = |p_j - mean|. RP is None for one repeat."""

    n: int
    ap_mm: float | None = None
    ap_xyz_mm: tuple[float, float, float] | None = None
    rp_mm: float | None = None


@dataclass(frozen=True, slots=True)
class DistanceAccuracy:
    """AD = |mean distance - commanded|, and RD = 3 sd of the distances (None for one repeat)."""

    n: int
    ad_mm: float | None = None
    rd_mm: float | None = None


@dataclass(frozen=True, slots=True)
class Precision:
    """Standard deviations: s_r within a pose or set-up, s_L between them, s_R = sqrt(s_r^2 + s_L^2). None where the groups don't tell."""

    n: int
    groups: int
    s_r: float | None = None
    s_between: float | None = None
    s_R: float | None = None  # noqa: N815 - the standard's own symbol


def pose_accuracy(points_mm: npt.ArrayLike, commanded_mm: npt.ArrayLike) -> PoseAccuracy:
    """AP and RP of the repeats (n, 3) of one pose against its commanded (or true) position (3,)."""
    points, commanded = as_points(points_mm, "points"), _as_point(commanded_mm)
    if not len(points):
        return PoseAccuracy(0)
    centre = points.mean(axis=0)
    offset = centre - commanded
    spread = np.linalg.norm(points - centre, axis=1)
    return PoseAccuracy(
        n=len(points),
        ap_mm=float(np.linalg.norm(offset)),
        ap_xyz_mm=(float(offset[0]), float(offset[1]), float(offset[2])),
        rp_mm=float(spread.mean() + 3 * spread.std(ddof=1)) if len(points) > 1 else None,
    )


def distance_accuracy(distances_mm: npt.ArrayLike, commanded_mm: float) -> DistanceAccuracy:
    """AD and RD of the repeats (n,) of one distance."""
    distances = as_values(distances_mm, "distances")
    if not len(distances):
        return DistanceAccuracy(0)
    spread = 3 * float(distances.std(ddof=1)) if len(distances) > 1 else None
    return DistanceAccuracy(len(distances), abs(float(distances.mean()) - commanded_mm), spread)


def drift_mm(points_mm: npt.ArrayLike, commanded_mm: npt.ArrayLike, repeats: int) -> float | None:
    """Drift of AP: the largest |AP(first block) - AP(later block)|, blocks of `repeats` points (n, 3) in order of time. None below two
    blocks."""
    points = as_points(points_mm, "points")
    if repeats < 1:
        raise ValueError(f"drift: blocks of {repeats} points; at least 1")
    blocks = [points[k : k + repeats] for k in range(0, len(points) - repeats + 1, repeats)]
    if len(blocks) < 2:
        return None
    accuracy = [float(np.linalg.norm(block.mean(axis=0) - _as_point(commanded_mm))) for block in blocks]
    return max(abs(a - accuracy[0]) for a in accuracy[1:])


def precision(groups: Sequence[npt.ArrayLike]) -> Precision:
    """s_r and s_R of one quantity from groups of repeats (one-way analysis of variance; groups may differ in size, empty ones are left
    out).

    ISO 5725-2, 7.4.5: s_L^2 = (MS_between - s_r^2) / n0, at least 0, with n0 = (N - sum n_i^2 / N) / (p - 1).
    """
    values = [v for v in (as_values(g, "group of repeats") for g in groups) if len(v)]
    n, p = sum(len(v) for v in values), len(values)
    if n == p:
        return Precision(n, p)
    within = sum(float(((v - v.mean()) ** 2).sum()) for v in values) / (n - p)
    if p < 2:
        return Precision(n, p, sqrt(within))
    centre = float(np.concatenate(values).mean())
    between = sum(len(v) * (float(v.mean()) - centre) ** 2 for v in values) / (p - 1)
    n0 = (n - sum(len(v) ** 2 for v in values) / n) / (p - 1)
    variance = max(0.0, (between - within) / n0)
    return Precision(n, p, sqrt(within), sqrt(variance), sqrt(within + variance))


def _as_point(value: npt.ArrayLike) -> Floats:
    point = np.asarray(value, dtype=np.float64)
    if point.shape != (3,):
        raise ValueError(f"commanded: expected one point (3,) in mm, got shape {point.shape}")
    return as_points(point[None], "commanded").ravel()
