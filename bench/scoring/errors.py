"""Errors of matched teats: bias, spread and distance, per axis and radial; what covers a share of
them with a stated confidence (ISO 16269-6); and the checks of every array that is scored.

No signed mean is called "the error": rms^2 = bias^2 + sd^2 holds exactly (sd divides by n), and
distances have figures of their own. Percentiles are observed values, not interpolated. "99/95" is a
`rate` of 0.99 covered with a `confidence` of 0.95.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import count
from math import isfinite

import numpy as np
import numpy.typing as npt
import scipy

from bench.scoring.rates import zero_failure_n

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
FEW = 1000  # values, which BLAS takes on one thread


def as_points(value: npt.ArrayLike, name: str) -> Floats:
    """`value` as float64 (n, 3). Raises ValueError for another shape, or one not finite."""
    points = np.asarray(value, dtype=np.float64)
    if points.size == 0:
        return np.zeros((0, 3))
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(
            f"{name}: expected points of shape (n, 3) in mm, got shape {points.shape}; a single"
            " point is [[x, y, z]]"
        )
    # one look where all is well; of many points it starts BLAS's threads, which spin after it
    if points.size <= FEW and isfinite(np.vdot(points, points)):
        return points
    return _finite(points, f"{name}: point")


def _finite(values: Floats, what: str) -> Floats:
    if not np.isfinite(values).all():
        row = int(np.argwhere(~np.isfinite(values))[0, 0])
        raise ValueError(
            f"{what} {row} is {values[row].tolist()}, which is not finite; leave out what was not"
            " found or measured"
        )
    return values


def as_values(value: npt.ArrayLike, name: str) -> Floats:
    """`value` as float64 (n,). Raises ValueError on another shape or a value that is not finite."""
    values = np.asarray(value, dtype=np.float64)
    if values.size == 0:
        return np.zeros(0)
    if values.ndim != 1:
        raise ValueError(f"{name}: expected a list of numbers, got shape {values.shape}")
    return _finite(values, f"{name}: value")


def numbered(names: Sequence[Hashable], rows: int | None = None) -> npt.NDArray[np.intp]:
    """Names (n,) as numbers from 0 in order of appearance. Raises ValueError unless `rows`."""
    if rows not in (None, len(names)):
        raise ValueError(f"poses: {len(names)} names for {rows} rows; give the pose of each")
    numbers: defaultdict[Hashable, int] = defaultdict(count().__next__)
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
    """Errors in one frame of reference; `components` pools the three axes (3 n values)."""

    n: int
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
    rms, absolute = np.sqrt(np.mean(values**2)), np.abs(values)
    figures = values.mean(), values.std(), rms, absolute.mean(), absolute.max()
    return AxisSummary(len(values), *map(float, figures))


def summarise_radial(distances_mm: npt.ArrayLike) -> RadialSummary:
    """Distances (n,), none negative."""
    values = as_values(distances_mm, "distances")
    if not len(values):
        return RadialSummary(0)
    if values.min() < 0:
        raise ValueError(
            f"distances: {values.min()} mm is negative; give distances, not signed errors"
        )
    high = percentile(values, 95), percentile(values, 99), values.max()
    figures = values.mean(), np.sqrt(np.mean(values**2)), np.median(values), *high
    return RadialSummary(len(values), *map(float, figures))


def summarise(
    errors_mm: npt.ArrayLike, camera_from_world: npt.ArrayLike | None = None
) -> ErrorSummary:
    """Errors found - truth, (n, 3) in world axes, or by a rotation (3, 3) in the camera's."""
    errors = as_points(errors_mm, "errors")
    if camera_from_world is not None:
        errors = errors @ np.transpose(camera_from_world)
    x, y, z, components = (summarise_axis(values) for values in (*errors.T, errors.ravel()))
    radial = summarise_radial(np.linalg.norm(errors, axis=1))
    return ErrorSummary(len(errors), x, y, z, components, radial)


def percentile(values: npt.ArrayLike, percent: float) -> float:
    """Smallest value with at least `percent` at or below it. Raises ValueError for none."""
    given = as_values(values, "values")
    if not len(given):
        raise ValueError("percentile: there are no values; say 'not measured' instead")
    return float(np.percentile(given, percent, method="inverted_cdf"))


def normal_k(n: int, rate: float, confidence: float = 0.95) -> float:
    """One-sided factor: mean + k sd covers `rate` of a normal population. k(30; 95/95) = 2.220."""
    if n < 2:
        raise ValueError(f"tolerance factor: n = {n}; a spread needs at least 2 values")
    zero_failure_n(rate, confidence)  # refuses a rate or a confidence outside 0 to 1
    root = float(np.sqrt(n))
    return float(scipy.special.nctdtrit(n - 1, scipy.special.ndtri(rate) * root, confidence)) / root


def quantile_bound(values: npt.ArrayLike, rate: float, confidence: float = 0.95) -> float | None:
    """One-sided upper bound of the population's quantile `rate` with `confidence`, for any
    distribution: one of the values, None where n is too small (David and Nagaraja, Order
    Statistics, section 7.1).
    """
    ordered = np.sort(as_values(values, "values"))
    n = len(ordered)
    zero_failure_n(rate, confidence)
    # P(at most k of n values lie below the quantile), k = 0 to n
    at_most = scipy.special.bdtr(np.arange(n + 1), n, rate)
    upper = int(np.searchsorted(at_most, confidence))
    return float(ordered[upper]) if upper < n else None
