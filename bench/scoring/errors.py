"""Errors of matched teats: bias, spread and distance, per axis and radial. Knows neither teats nor poses: only difference vectors.

No signed mean is ever called "the error": bias and spread stand side by side, rms^2 = bias^2 + sd^2 holds exactly (sd divides by n), and
the distance has figures of its own. Percentiles are observed values (the smallest with at least that share at or below it), not
interpolated.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt

from bench.scoring.points import Floats, as_points, as_values

AXES = ("x", "y", "z")


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
    """Errors in one frame of reference. `components` pools the three axes (3 n values): what the thesis's "average error" averaged."""

    n: int
    frame: str
    x: AxisSummary
    y: AxisSummary
    z: AxisSummary
    components: AxisSummary
    radial: RadialSummary

    def as_dict(self) -> dict[str, object]:
        """Plain numbers, text and None, nested as the fields are."""
        return asdict(self)


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
        raise ValueError(f"distances: {distances.min()} mm is negative; give distances, not signed errors")
    return RadialSummary(
        n=len(distances),
        mean_mm=float(distances.mean()),
        rms_mm=float(np.sqrt(np.mean(distances**2))),
        median_mm=float(np.median(distances)),
        p95_mm=percentile(distances, 95),
        p99_mm=percentile(distances, 99),
        max_mm=float(distances.max()),
    )


def summarise(errors_mm: npt.ArrayLike, camera_from_world: npt.ArrayLike | None = None) -> ErrorSummary:
    """Errors found - truth, (n, 3) in world axes; with a rotation (3, 3) the summary is along the camera's axes (z is depth).

    Raises ValueError where the shape is wrong or the matrix is no proper rotation.
    """
    errors = as_points(errors_mm, "errors")
    if camera_from_world is not None:
        errors = errors @ _as_rotation(camera_from_world).T
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
    """The smallest of the values with at least `percent` of them at or below it. Raises ValueError where there are none."""
    given = as_values(values, "values")
    if not len(given):
        raise ValueError("percentile: there are no values; say 'not measured' instead")
    return float(np.percentile(given, percent, method="inverted_cdf"))


def _as_rotation(matrix: npt.ArrayLike) -> Floats:
    rotation = np.asarray(matrix, dtype=np.float64)
    if rotation.shape != (3, 3):
        raise ValueError(f"camera_from_world: expected a rotation matrix (3, 3), got shape {rotation.shape}")
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
        raise ValueError("camera_from_world: the matrix is no proper rotation, so it would change lengths; use a rigid fit")
    return rotation
