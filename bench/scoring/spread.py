"""How errors spread: ellipsoids, and what errors depend on.

Ellipsoids of the next error and of the bias rest on Hotelling's T^2 (Chew, JASA 61, 1966); their
rows have to be independent: the mean of each pose (`pose_means`).

A trend is a line through errors against place, time, temperature or tilt. Rows of one pose share
its error: the slope's standard error is the jackknife over poses (Efron and Stein, Annals of
Statistics 9, 1981; CV3 of MacKinnon, Nielsen and Webb, Journal of Applied Econometrics 38, 2023),
with Student's t of groups - 1. What varies within poses can be asked within them: each stratum then
has a level of its own. Many questions are adjusted after Holm.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from math import sqrt

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri, fdtrc, fdtri, stdtr, stdtrit

from bench.scoring.comparison import holm
from bench.scoring.errors import Floats, as_points, as_values, numbered

AXES = 3
# rows: one more than the covariance needs, so that something is left to judge it by
LEAST_POSES = AXES + 2


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoid:
    """Centre (3,) and half axes (3,) mm, longest first; their unit directions are rows."""

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
    """Is the mean error zero? Hotelling's T^2 of `n` rows, and its p-value; None for too few."""

    n: int
    t_squared: float | None = None
    p_value: float | None = None


@dataclass(frozen=True, slots=True)
class Consistency:
    """Do the detector's own covariances hold? The mean of e' C^-1 e over 3 with the interval that
    chance leaves it: 1 where they do, above it the detector claims too much.
    """

    n: int
    ratio: float | None = None
    low: float | None = None
    high: float | None = None


def pose_means(errors_mm: npt.ArrayLike, poses: Sequence[Hashable]) -> Floats:
    """The mean error (p, 3) of each pose, in order of appearance."""
    errors = as_points(errors_mm, "errors")
    codes = numbered(poses, len(errors))
    sums = [np.bincount(codes, column) for column in errors.T]
    return np.asarray((sums / np.bincount(codes)).T, dtype=np.float64)


def prediction_ellipsoid(errors_mm: npt.ArrayLike, share: float = 0.95) -> Ellipsoid | None:
    """Where the next error lies with the probability `share`; `errors_mm` (n, 3) independent, None
    for fewer than LEAST_POSES: (e - mean)' S^-1 (e - mean) <= 3 (n^2 - 1) / (n (n - 3)) F(share; 3,
    n - 3).
    """
    return _ellipsoid(errors_mm, share, lambda n: AXES * (n * n - 1.0) / (n * (n - AXES)))


def bias_ellipsoid(errors_mm: npt.ArrayLike, confidence: float = 0.95) -> Ellipsoid | None:
    """Where the mean error lies; as `prediction_ellipsoid`, but n (m - mean)' S^-1 (m - mean) <= 3
    (n - 1) / (n - 3) F(confidence; 3, n - 3). No bias is shown where it holds 0.
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
    """Errors (n, 3) against the covariances (n, 3, 3) claimed for them, the truth's own included.

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


RESPONSES = ("x", "y", "z", "distance")
LEAST_TREND_POSES = 5  # groups: fewer leave the spread of the slope itself unknown


@dataclass(frozen=True, slots=True)
class Trend:
    """Slope of a response (mm) per unit of a quantity of range `span`, over independent groups;
    None where it can't be fitted. `p_holm`: adjusted for all.
    """

    quantity: str
    response: str
    n: int
    groups: int
    span: float
    slope: float | None = None
    low: float | None = None
    high: float | None = None
    p_value: float | None = None
    p_holm: float | None = None

    @property
    def significant(self) -> bool:
        """At 5 % for the whole family of questions."""
        p = self.p_value if self.p_holm is None else self.p_holm
        return p is not None and p < 0.05


def trends(
    quantities: Mapping[str, npt.ArrayLike],
    errors_mm: npt.ArrayLike,
    groups: Sequence[Hashable],
    *,
    within: Mapping[str, Sequence[Hashable]] | None = None,
    within_groups: Sequence[Hashable] | None = None,
    confidence: float = 0.95,
) -> tuple[Trend, ...]:
    """Every quantity (n,) against the errors' x, y, z (signed) and distance, all adjusted together;
    rows where it is not-a-number are left out. `groups` names each row's independent unit (pose).
    `within` names the strata (teat at a pose) to ask a quantity within; its unit then is that of
    `within_groups` (the frame set).
    """
    errors = as_points(errors_mm, "errors")
    responses = dict(zip(RESPONSES, (*errors.T, np.linalg.norm(errors, axis=1)), strict=True))
    found: list[Trend] = []
    for quantity, values in quantities.items():
        column = np.asarray(values, dtype=np.float64).reshape(-1)
        kept = np.isfinite(column)
        strata = (within or {}).get(quantity)
        units = groups if strata is None or within_groups is None else within_groups
        names = list(compress(units, kept))
        levels = None if strata is None else list(compress(strata, kept))
        for response, values_mm in responses.items():
            line = trend(column[kept], values_mm[kept], names, within=levels, confidence=confidence)
            found.append(replace(line, quantity=quantity, response=response))
    holms = iter(holm([one.p_value for one in found if one.p_value is not None]))
    return tuple(one if one.p_value is None else replace(one, p_holm=next(holms)) for one in found)


def trend(
    values: npt.ArrayLike,
    response: npt.ArrayLike,
    groups: Sequence[Hashable],
    *,
    within: Sequence[Hashable] | None = None,
    confidence: float = 0.95,
) -> Trend:
    """One line: `response` (n,) against `values` (n,), rows grouped by `groups` (n,), with a level
    for each of `within` (n,) if given.
    """
    x, y = as_values(values, "values"), as_values(response, "response")
    if not len(x) == len(y) == len(groups) or (within is not None and len(within) != len(x)):
        raise ValueError(
            f"trend: {len(x)} values, {len(y)} responses, {len(groups)} groups; give one of each"
            " for every row"
        )
    group, stratum = numbered(groups), numbered(within if within is not None else [0] * len(x))
    count = int(group.max()) + 1 if len(x) else 0
    empty = Trend("", "", len(x), count, float(np.ptp(x)) if len(x) else 0.0)
    if count < LEAST_TREND_POSES:
        return empty
    sxx, sxy, less_xx, less_xy = _sums(x - x.mean(), y - y.mean(), group, stratum, count)
    if sxx <= 1e-12 * max(1.0, float(np.square(x).max())) * len(x) or np.any(
        sxx - less_xx <= 1e-9 * sxx
    ):
        return empty  # it did not vary, or only in one group
    slope, without = sxy / sxx, (sxy - less_xy) / (sxx - less_xx)
    error = sqrt((count - 1) / count * float(np.square(without - without.mean()).sum()))
    reach = float(stdtrit(count - 1, (1.0 + confidence) / 2.0)) * error
    p_value = (
        2.0 * float(stdtr(count - 1, -abs(slope) / error)) if error > 0.0 else float(slope == 0.0)
    )
    return replace(empty, slope=slope, low=slope - reach, high=slope + reach, p_value=p_value)


def _sums(
    x: Floats, y: Floats, group: npt.NDArray[np.intp], stratum: npt.NDArray[np.intp], count: int
) -> tuple[float, float, Floats, Floats]:
    """Sxx and Sxy about the stratum means, and what each group adds to them."""
    blocks, block = (
        (np.arange(count), group)
        if not stratum.any()
        else np.unique(stratum * count + group, return_inverse=True)
    )
    block = block.ravel()

    def add(code: npt.NDArray[np.intp], size: int) -> tuple[Floats, ...]:
        return tuple(
            np.bincount(code, w, minlength=size).astype(np.float64)
            for w in (np.ones_like(x), x, y, x * x, x * y)
        )

    whole, part = add(stratum, int(stratum.max()) + 1), add(block, len(blocks))
    of = blocks // count
    before = _about_mean(*whole)
    after = _about_mean(*(w[of] - p for w, p in zip(whole, part, strict=True)))
    less = [
        np.bincount(blocks % count, b[of] - a, minlength=count).astype(np.float64)
        for b, a in zip(before, after, strict=True)
    ]
    return float(before[0].sum()), float(before[1].sum()), less[0], less[1]


def _about_mean(n: Floats, x: Floats, y: Floats, xx: Floats, xy: Floats) -> tuple[Floats, Floats]:
    some = np.maximum(n, 1.0)
    there = n > 0.5
    return np.where(there, xx - x * x / some, 0.0), np.where(there, xy - x * y / some, 0.0)
