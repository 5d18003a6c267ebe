"""Errors as ellipsoids: where the next one will lie, and where the bias lies; and the error map of
the plane, as data.

Chew, "Confidence, prediction, and tolerance regions for the multivariate normal distribution", JASA
61, 1966; both ellipsoids rest on Hotelling's T^2. Rows have to be independent: give the mean of
each pose (`pose_means`), for repeats of one pose share its error. A cell of the map is a place of
its own, or a square of the plane where a step is named. What was missed is counted in its cell: a
map of the found alone would look best where the detector finds least.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri, fdtrc, fdtri

from bench.scoring.errors import Bools, Floats, as_points, as_values, numbered

AXES = 3
# rows: one more than the covariance needs, so that something is left to judge it by
LEAST_POSES = AXES + 2


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoid:
    """Centre (3,) mm, half axes (3,) mm with the longest first, and their unit directions, the rows
    of (3, 3).
    """

    n: int
    centre_mm: Floats
    half_axes_mm: Floats
    directions: Floats

    def outline_mm(self, first: int, second: int, points: int = 72) -> Floats:
        """Its shadow on the plane of two axes (0 x, 1 y, 2 z) as a closed line (points, 2)."""
        # a point of the surface is centre + half @ unit vector
        half = self.directions.T * self.half_axes_mm
        flat = half[[first, second]]
        values, vectors = np.linalg.eigh(flat @ flat.T)
        turn = np.linspace(0.0, 2.0 * np.pi, points)
        circle = np.column_stack([np.cos(turn), np.sin(turn)])
        return np.asarray(
            self.centre_mm[[first, second]] + circle * np.sqrt(np.maximum(values, 0.0)) @ vectors.T,
            dtype=np.float64,
        )


@dataclass(frozen=True, slots=True)
class BiasTest:
    """Is the mean error zero? Hotelling's T^2 of `n` rows, and its p-value. None where there are
    too few.
    """

    n: int
    t_squared: float | None = None
    p_value: float | None = None


@dataclass(frozen=True, slots=True)
class Consistency:
    """Do the detector's own covariances hold? The mean of e' C^-1 e over 3 (1 where they do), with
    the interval that chance leaves it.

    Above it the detector claims to be surer than it is; below it is too modest.
    """

    n: int
    ratio: float | None = None
    low: float | None = None
    high: float | None = None


def pose_means(errors_mm: npt.ArrayLike, poses: Sequence[Hashable]) -> Floats:
    """The mean error (p, 3) of each pose, in order of appearance."""
    errors = as_points(errors_mm, "errors")
    if len(poses) != len(errors):
        raise ValueError(
            f"poses: {len(poses)} names for {len(errors)} errors; give the pose of each"
        )
    codes = numbered(poses)
    count = int(codes.max(initial=-1)) + 1
    sums = np.column_stack(
        [np.bincount(codes, errors[:, axis], minlength=count) for axis in range(AXES)]
    )
    return np.asarray(sums / np.bincount(codes, minlength=count)[:, None], dtype=np.float64)


def prediction_ellipsoid(errors_mm: npt.ArrayLike, share: float = 0.95) -> Ellipsoid | None:
    """Where the next error lies with the probability `share`; `errors_mm` (n, 3) independent. None
    for fewer than LEAST.

    (e - mean)' S^-1 (e - mean) <= 3 (n^2 - 1) / (n (n - 3)) F(share; 3, n - 3).
    """
    return _ellipsoid(errors_mm, share, lambda n: AXES * (n * n - 1.0) / (n * (n - AXES)))


def bias_ellipsoid(errors_mm: npt.ArrayLike, confidence: float = 0.95) -> Ellipsoid | None:
    """Where the mean error lies; `errors_mm` (n, 3) independent. None for fewer than LEAST.

    n (m - mean)' S^-1 (m - mean) <= 3 (n - 1) / (n - 3) F(confidence; 3, n - 3). No bias is shown
    where it holds 0.
    """
    return _ellipsoid(errors_mm, confidence, lambda n: AXES * (n - 1.0) / (n * (n - AXES)))


def bias_test(errors_mm: npt.ArrayLike) -> BiasTest:
    """T^2 = n mean' S^-1 mean, F-distributed after (n - 3) / (3 (n - 1)) (Hotelling, Annals of
    Mathematical Statistics 2, 1931).
    """
    errors = as_points(errors_mm, "errors")
    n = len(errors)
    if n < LEAST_POSES:
        return BiasTest(n)
    mean, covariance = errors.mean(axis=0), np.cov(errors.T)
    if np.linalg.matrix_rank(covariance) < AXES:
        return BiasTest(n)
    t_squared = n * float(mean @ np.linalg.solve(covariance, mean))
    return BiasTest(
        n, t_squared, float(fdtrc(AXES, n - AXES, t_squared * (n - AXES) / (AXES * (n - 1.0))))
    )


def consistency(
    errors_mm: npt.ArrayLike, covariances_mm2: npt.ArrayLike, confidence: float = 0.95
) -> Consistency:
    """Errors (n, 3) against the covariances (n, 3, 3) claimed for them, the truth's own included by
    the caller.

    Normalised estimation error squared (Bar-Shalom, Li, Kirubarajan, Estimation with Applications
    to Tracking and Navigation, 2001, 5.4): its sum is chi-square with 3 n degrees of freedom.
    Raises ValueError for a covariance that is none.
    """
    errors, covariances = (
        as_points(errors_mm, "errors"),
        np.asarray(covariances_mm2, dtype=np.float64),
    )
    n = len(errors)
    if n == 0:
        return Consistency(0)
    if covariances.shape != (n, AXES, AXES) or not np.all(np.linalg.eigvalsh(covariances) > 0.0):
        raise ValueError(
            f"covariances: expected {n} positive definite matrices (3, 3) in mm^2, got shape"
            f" {covariances.shape}"
        )
    squared = np.einsum(
        "ni,ni->n", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    )
    tail, freedom = (1.0 - confidence) / 2.0, AXES * n
    return Consistency(
        n,
        float(squared.sum()) / freedom,
        float(chdtri(freedom, 1.0 - tail)) / freedom,
        float(chdtri(freedom, tail)) / freedom,
    )


def _ellipsoid(
    errors_mm: npt.ArrayLike, share: float, scale: Callable[[int], float]
) -> Ellipsoid | None:
    errors = as_points(errors_mm, "errors")
    if not 0.0 < share < 1.0:
        raise ValueError(f"share: {share} must lie between 0 and 1, for example 0.95")
    n = len(errors)
    if n < LEAST_POSES:
        return None
    factor = sqrt(scale(n) * float(fdtri(AXES, n - AXES, share)))
    values, vectors = np.linalg.eigh(np.cov(errors.T))
    half = factor * np.sqrt(np.maximum(values[::-1], 0.0))
    return Ellipsoid(n, errors.mean(axis=0), half, np.ascontiguousarray(vectors[:, ::-1].T))


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell: its centre, teats there and how many were found; of these the mean error (signed,
    world axes) and the distances, mm.

    Errors are None where nothing was found.
    """

    x_mm: float
    y_mm: float
    teats: int
    found: int
    bias_mm: tuple[float, float, float] | None = None
    mean_mm: float | None = None
    rms_mm: float | None = None
    max_mm: float | None = None


def error_map(
    places_mm: npt.ArrayLike,
    errors_mm: npt.ArrayLike,
    found: npt.ArrayLike | None = None,
    *,
    step_mm: float | None = None,
) -> tuple[Cell, ...]:
    """Cells in order of y, then x. `places_mm` (n, 2) are the true ends on the plane; `errors_mm`
    (k, 3) found - truth of those found.

    `found` (n,) says which were (none given: all). `step_mm` is a square's side, with a square's
    centre on (0, 0); without it each place, rounded to 0.01 mm, is a cell. Raises ValueError where
    the numbers of rows don't fit.
    """
    places = np.asarray(places_mm, dtype=np.float64).reshape(-1, 2)
    errors = as_points(errors_mm, "errors")
    was_found: Bools = (
        np.ones(len(places), dtype=np.bool_) if found is None else np.asarray(found, dtype=np.bool_)
    )
    if was_found.shape != (len(places),) or int(was_found.sum()) != len(errors):
        raise ValueError(
            f"error map: {len(places)} places, {int(was_found.sum())} of them found, but"
            f" {len(errors)} errors"
        )
    if step_mm is not None and not step_mm > 0.0:
        raise ValueError(f"error map: a step of {step_mm} mm is not above 0")
    as_values(places.ravel(), "places")
    side = 0.01 if step_mm is None else step_mm
    at = np.rint(places / side).astype(np.int64)
    first = at.min(axis=0, initial=0)
    width = int((at - first).max(initial=0)) + 1
    # one number a cell: y above x
    key, cell = np.unique((at - first) @ np.array([1, width]), return_inverse=True)
    centres = (np.column_stack([key % width, key // width]) + first) * side
    count, here = len(centres), cell.ravel()[was_found]
    teats, n = np.bincount(cell.ravel(), minlength=count), np.bincount(here, minlength=count)
    distance = np.linalg.norm(errors, axis=1)
    worst = np.zeros(count)
    np.maximum.at(worst, here, distance)
    sums = np.column_stack(
        [
            np.bincount(here, column, minlength=count)
            for column in (*errors.T, distance, distance**2)
        ]
    )
    means = sums / np.maximum(n, 1)[:, None]
    rows = zip(
        centres.tolist(), teats.tolist(), n.tolist(), means.tolist(), worst.tolist(), strict=True
    )
    return tuple(
        (
            Cell(x, y, all_teats, k, (m[0], m[1], m[2]), m[3], m[4] ** 0.5, largest)
            if k
            else Cell(x, y, all_teats, 0)
        )
        for (x, y), all_teats, k, m, largest in rows
    )
