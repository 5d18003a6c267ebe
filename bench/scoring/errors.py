"""Errors of matched teats: bias, spread and distance, per axis and radial; what covers a share of
them with a stated confidence (ISO 16269-6); and the checks of every array on its way into a score.

No signed mean is ever called "the error": bias and spread stand side by side, rms^2 = bias^2 + sd^2
holds exactly (sd divides by n), and the distance has figures of its own. Percentiles are observed
values (the smallest with at least that share at or below it), not interpolated. `rate` is the share
that is covered, `confidence` how sure that is; "99/95" is a rate of 0.99 with a confidence of 0.95.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np
import numpy.typing as npt
from numpy.linalg import det
from scipy.special import bdtr, nctdtrit, ndtri

from bench.scoring.rates import zero_failure_n

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


def as_points(value: npt.ArrayLike, name: str) -> Floats:
    """`value` as float64 (n, 3); anything empty becomes (0, 3). Raises ValueError on another shape
    or on a value that is not finite.
    """
    points = np.asarray(value, dtype=np.float64)
    if points.size == 0:
        return np.zeros((0, 3))
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(
            f"{name}: expected points of shape (n, 3) in mm, got shape {points.shape}; a single"
            " point is [[x, y, z]]"
        )
    # the sum first: one look where all is well
    if not isfinite(np.add.reduce(points, axis=None)) and not np.isfinite(points).all():
        row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise ValueError(
            f"{name}: point {row} is {points[row].tolist()}, which is not finite; leave out a teat"
            " that was not found"
        )
    return points


def as_values(value: npt.ArrayLike, name: str) -> Floats:
    """`value` as float64 (n,). Raises ValueError on another shape
    or on a value that is not finite.
    """
    values = np.asarray(value, dtype=np.float64)
    if values.size == 0:
        return np.zeros(0)
    if values.ndim != 1:
        raise ValueError(f"{name}: expected a list of numbers, got shape {values.shape}")
    if not np.isfinite(values).all():
        place = int(np.flatnonzero(~np.isfinite(values))[0])
        raise ValueError(
            f"{name}: value {place} is {values[place]}, which is not finite; leave out what was not"
            " measured"
        )
    return values


def numbered(names: Sequence[Hashable]) -> npt.NDArray[np.intp]:
    """Names (n,) as numbers from 0, in order of their first appearance."""
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return np.fromiter(map(numbers.__getitem__, names), dtype=np.intp, count=len(names))


@dataclass(frozen=True, slots=True)
class AxisSummary:
    """Signed errors along one axis, mm. All None where n is 0: not measured."""

    n: int
    bias_mm: float | None = None
    sd_mm: float | None = None
    rms_mm: float | None = None
    mean_abs_mm: float | None = None
    max_abs_mm: float | None = None


@dataclass(frozen=True, slots=True)
class RadialSummary:
    """Distances between finding and teat, mm. All None where n is 0: not measured."""

    n: int
    mean_mm: float | None = None
    rms_mm: float | None = None
    median_mm: float | None = None
    p95_mm: float | None = None
    p99_mm: float | None = None
    max_mm: float | None = None


@dataclass(frozen=True, slots=True)
class ErrorSummary:
    """Errors in one frame of reference. `components` pools the three axes (3 n values): what the
    thesis's "average error" averaged.
    """

    n: int
    frame: str
    x: AxisSummary
    y: AxisSummary
    z: AxisSummary
    components: AxisSummary
    radial: RadialSummary


def summarise_axis(values_mm: npt.ArrayLike) -> AxisSummary:
    """Signed errors (n,) along one axis. sd divides by n."""
    values = as_values(values_mm, "errors along an axis")
    if not len(values):
        return AxisSummary(0)
    absolute = np.abs(values)
    return AxisSummary(
        n=len(values),
        bias_mm=float(values.mean()),
        sd_mm=float(values.std()),
        rms_mm=float(np.sqrt(np.mean(values**2))),
        mean_abs_mm=float(absolute.mean()),
        max_abs_mm=float(absolute.max()),
    )


def summarise_radial(distances_mm: npt.ArrayLike) -> RadialSummary:
    """Distances (n,), none negative."""
    distances = as_values(distances_mm, "distances")
    if not len(distances):
        return RadialSummary(0)
    if distances.min() < 0:
        raise ValueError(
            f"distances: {distances.min()} mm is negative; give distances, not signed errors"
        )
    return RadialSummary(
        n=len(distances),
        mean_mm=float(distances.mean()),
        rms_mm=float(np.sqrt(np.mean(distances**2))),
        median_mm=float(np.median(distances)),
        p95_mm=percentile(distances, 95),
        p99_mm=percentile(distances, 99),
        max_mm=float(distances.max()),
    )


def summarise(
    errors_mm: npt.ArrayLike, camera_from_world: npt.ArrayLike | None = None
) -> ErrorSummary:
    """Errors found - truth, (n, 3) in world axes; with a rotation (3, 3) the summary is along the
    camera's axes (z is depth).

    Raises ValueError where the shape is wrong or the matrix is no proper rotation.
    """
    errors = as_points(errors_mm, "errors")
    if camera_from_world is not None:
        rotation = np.asarray(camera_from_world, dtype=np.float64)
        if rotation.shape != (3, 3):
            raise ValueError(
                f"camera_from_world: expected a rotation matrix (3, 3), got {rotation.shape}"
            )
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or det(rotation) < 0:
            raise ValueError("camera_from_world: no proper rotation, so it would change lengths")
        errors = errors @ rotation.T
    along = [summarise_axis(errors[:, k]) for k in range(3)]
    return ErrorSummary(
        n=len(errors),
        frame="world" if camera_from_world is None else "camera",
        x=along[0],
        y=along[1],
        z=along[2],
        components=summarise_axis(errors.ravel()),
        radial=summarise_radial(np.linalg.norm(errors, axis=1)),
    )


def percentile(values: npt.ArrayLike, percent: float) -> float:
    """The smallest of the values with at least `percent` of them at or below it. Raises ValueError
    where there are none.
    """
    given = as_values(values, "values")
    if not len(given):
        raise ValueError("percentile: there are no values; say 'not measured' instead")
    return float(np.percentile(given, percent, method="inverted_cdf"))


def normal_k(n: int, rate: float, confidence: float = 0.95) -> float:
    """One-sided factor: mean + k sd (sd divides by n - 1) covers `rate` of a normal population.
    k(30; 95/95) = 2.220.
    """
    if n < 2:
        raise ValueError(f"tolerance factor: n = {n}; a spread needs at least 2 values")
    zero_failure_n(rate, confidence)  # refuses a rate or a confidence outside 0 to 1
    root = float(np.sqrt(n))
    return float(nctdtrit(n - 1, ndtri(rate) * root, confidence)) / root


def quantile_bounds(
    values: npt.ArrayLike, rate: float, confidence: float = 0.95
) -> tuple[float | None, float | None]:
    """One-sided lower and upper bound, each with `confidence`, of the population's quantile `rate`:
    two of the values, or None where n is too small.

    Any distribution (David and Nagaraja, Order Statistics, section 7.1). The upper bound is the
    distribution-free tolerance limit.
    """
    ordered = np.sort(as_values(values, "values"))
    n = len(ordered)
    zero_failure_n(rate, confidence)
    # P(at most k of n values lie below the quantile), k = 0 to n
    at_most = bdtr(np.arange(n + 1), n, rate)
    upper = int(np.searchsorted(at_most, confidence))
    lower = int(np.searchsorted(at_most, 1.0 - confidence)) - 1
    return (
        float(ordered[lower]) if lower >= 0 else None,
        float(ordered[upper]) if upper < n else None,
    )
