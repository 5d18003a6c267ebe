"""How errors spread: ellipsoids, and what errors depend on.

Ellipsoids of the next error and of the bias rest on Hotelling's T^2 (Chew, JASA 61, 1966); their
rows have to be independent: the mean of each pose (`pose_means`).

What the truths of all rows share, C, the scatter between poses doesn't show: the mean has the
covariance V = S/n + C, of which S/n is estimated. T^2 = m' V^-1 m then has nu degrees of freedom
instead of n - 1 (Krishnamoorthy and Yu, Statistics and Probability Letters 66, 2004), with G = S/n
V^-1: nu = (n - 1) (3 + 9) / (tr(G^2) + tr(G)^2).

A trend is a line through errors against place, time, temperature or tilt. Rows of one pose share
its error: the slope's standard error is the jackknife over poses (Efron and Stein, Annals of
Statistics 9, 1981; CV3 of MacKinnon, Nielsen and Webb, Journal of Applied Econometrics 38, 2023).
Few groups far out make most of it, so Student's t has fewer degrees of freedom than groups - 1:
those of Satterthwaite for independent errors, tr(A)^2 / tr(A^2) with A the covariance of the
groups' slopes (Bell and McCaffrey, Survey Methodology 28, 2002). What varies within poses can be
asked within them: each stratum then has a level of its own. Many questions are adjusted after Holm.
With a truth that rows share, the line is that of generalised least squares, and what the truth may
make of the slope is added to its variance, with degrees of freedom after Welch and Satterthwaite.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from math import sqrt

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, hstack
from scipy.special import chdtri, fdtrc, fdtri, ndtri, stdtr, stdtrit

from bench.scoring.comparison import holm
from bench.scoring.errors import Bools, Floats, as_points, as_values, numbered
from bench.scoring.joint import JointCovariance

AXES = 3
# rows: one more than the covariance needs, so that something is left to judge it by
LEAST_POSES = AXES + 2
KNOWN = 1e6  # degrees of freedom of what is not estimated


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


def prediction_ellipsoid(
    errors_mm: npt.ArrayLike, share: float = 0.95, common_mm2: Floats | None = None
) -> Ellipsoid | None:
    """Where the next error lies with the probability `share`; `errors_mm` (n, 3) share but
    `common_mm2` (3, 3); None for fewer than LEAST_POSES: (e - mean)' S^-1 (e - mean) <= 3 (n^2 - 1)
    / (n (n - 3)) F(share; 3, n - 3).
    """
    return _ellipsoid(errors_mm, share, 1.0, common_mm2)


def bias_ellipsoid(
    errors_mm: npt.ArrayLike, confidence: float = 0.95, common_mm2: Floats | None = None
) -> Ellipsoid | None:
    """Where the mean error lies; as `prediction_ellipsoid`, but n (m - mean)' S^-1 (m - mean) <= 3
    (n - 1) / (n - 3) F(confidence; 3, n - 3). No bias is shown where it holds 0.
    """
    return _ellipsoid(errors_mm, confidence, 0.0, common_mm2)


def bias_test(errors_mm: npt.ArrayLike, common_mm2: Floats | None = None) -> BiasTest:
    """T^2 = n mean' S^-1 mean, F-distributed after (n - 3) / (3 (n - 1)) (Hotelling, Annals of
    Mathematical Statistics 2, 1931); with what the truths share as above.
    """
    errors = as_points(errors_mm, "errors")
    n = len(errors)
    if n < LEAST_POSES:
        return BiasTest(n)
    mean = errors.mean(axis=0)
    whole, freedom = _known_to(np.cov(errors.T) / n, n, common_mm2)
    if np.linalg.matrix_rank(whole) < AXES:
        return BiasTest(n)
    over = freedom - AXES + 1.0
    t_squared = float(mean @ np.linalg.solve(whole, mean))
    return BiasTest(n, t_squared, float(fdtrc(AXES, over, t_squared * over / (AXES * freedom))))


def _known_to(estimated: Floats, n: int, common_mm2: Floats | None) -> tuple[Floats, float]:
    """V of the head of this file, and nu; n - 1 where all of it is ``estimated``."""
    if common_mm2 is None or not common_mm2.any():
        return estimated, n - 1.0
    whole = estimated + common_mm2
    share = np.linalg.pinv(whole) @ estimated
    spent = float(np.trace(share @ share)) + float(np.trace(share)) ** 2
    freedom = (n - 1.0) * (AXES + AXES**2) / spent if spent > 0.0 else KNOWN
    return whole, min(freedom, KNOWN)


def consistency(
    errors_mm: npt.ArrayLike,
    covariances_mm2: npt.ArrayLike,
    confidence: float = 0.95,
    truth: JointCovariance | None = None,
) -> Consistency:
    """Errors (n, 3) against the covariances (n, 3, 3) claimed for them, the truth's own included.

    Normalised estimation error squared (Bar-Shalom, Li, Kirubarajan, Estimation with Applications
    to Tracking and Navigation, 2001, 5.4): its sum is chi-square with 3 n degrees of freedom; with
    a `truth` that the ends share, as many fewer as its variance is larger (Satterthwaite). Raises
    ValueError for a covariance that is none.
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
    tail, freedom, each = (1.0 - confidence) / 2.0, float(AXES * n), 1.0
    if truth is not None and truth.shares:
        shared = truth.common @ truth.common.transpose(0, 2, 1)
        whole = JointCovariance(truth.common, covariances - shared, truth.sources)
        mean, variance = whole.squares(np.linalg.inv(covariances))
        freedom, each = 2.0 * mean**2 / variance, mean / (AXES * n)
    return Consistency(
        n,
        float(squared.sum()) / (AXES * n),
        each * float(chdtri(freedom, 1.0 - tail)) / freedom,
        each * float(chdtri(freedom, tail)) / freedom,
    )


def _ellipsoid(
    errors_mm: npt.ArrayLike, share: float, ahead: float, common_mm2: Floats | None
) -> Ellipsoid | None:
    """Of the mean error, and of as many errors ``ahead``."""
    errors = as_points(errors_mm, "errors")
    if not 0.0 < share < 1.0:
        raise ValueError(f"share: {share} must lie between 0 and 1, for example 0.95")
    n = len(errors)
    if n < LEAST_POSES:
        return None
    whole, freedom = _known_to((ahead + 1.0 / n) * np.cov(errors.T), n, common_mm2)
    over = freedom - AXES + 1.0
    factor = sqrt(AXES * freedom / over * float(fdtri(AXES, over, share)))
    values, vectors = np.linalg.eigh(whole)
    half = factor * np.sqrt(np.maximum(values[::-1], 0.0))
    return Ellipsoid(n, errors.mean(axis=0), half, np.ascontiguousarray(vectors[:, ::-1].T))


RESPONSES = ("x", "y", "z", "distance")
LEAST_TREND_POSES = 5  # groups: fewer leave the spread of the slope itself unknown
# a place that varies by less than so many of its truth's standard uncertainties is one place
LEAST_SPAN_U = 20.0


@dataclass(frozen=True, slots=True)
class Trend:
    """Slope of a response (mm) per unit of a quantity of range `span`, over independent groups;
    None where it can't be fitted. `p_holm`: adjusted for all. `truth`: what the truth alone may
    make of the slope, 95 %; `least_span`: the range that is needed, where it is too small.
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
    truth: float = 0.0
    least_span: float = 0.0

    @property
    def significant(self) -> bool:
        """At 5 % for the whole family of questions."""
        p = self.p_value if self.p_holm is None else self.p_holm
        return p is not None and p < 0.05


@dataclass(frozen=True, slots=True)
class Regressor:
    """Values (n,) of a quantity. ``u``: the standard uncertainty that the truth has along it;
    ``measured``: the values are the truth's own, and not what was planned.
    """

    values: npt.ArrayLike
    u: float = 0.0
    measured: bool = False


def trends(
    quantities: Mapping[str, npt.ArrayLike | Regressor],
    errors_mm: npt.ArrayLike,
    groups: Sequence[Hashable],
    *,
    within: Mapping[str, Sequence[Hashable]] | None = None,
    within_groups: Sequence[Hashable] | None = None,
    confidence: float = 0.95,
    truth: JointCovariance | None = None,
) -> tuple[Trend, ...]:
    """Every quantity (n,) against the errors' x, y, z (signed) and distance, all adjusted together;
    rows where it is not-a-number are left out. `groups` names each row's independent unit (pose).
    `within` names the strata (teat at a pose) to ask a quantity within; its unit then is that of
    `within_groups` (the frame set). `truth`: of the rows.
    """
    errors = as_points(errors_mm, "errors")
    responses = dict(zip(RESPONSES, (*errors.T, np.linalg.norm(errors, axis=1)), strict=True))
    joint = truth or JointCovariance.exact(len(errors))
    parts = {name: _part(name, errors, joint) for name in RESPONSES}
    found: list[Trend] = []
    for quantity, values in quantities.items():
        of = values if isinstance(values, Regressor) else Regressor(values)
        column = np.asarray(of.values, dtype=np.float64).reshape(-1)
        kept = np.isfinite(column)
        strata = (within or {}).get(quantity)
        units = groups if strata is None or within_groups is None else within_groups
        names = list(compress(units, kept))
        levels = None if strata is None else list(compress(strata, kept))
        for response, values_mm in responses.items():
            line = trend(
                Regressor(column[kept], of.u, of.measured),
                values_mm[kept],
                names,
                within=levels,
                confidence=confidence,
                part=parts[response].of(kept),
            )
            found.append(replace(line, quantity=quantity, response=response))
    holms = iter(holm([one.p_value for one in found if one.p_value is not None]))
    return tuple(one if one.p_value is None else replace(one, p_holm=next(holms)) for one in found)


@dataclass(frozen=True, slots=True, eq=False)
class TruthPart:
    """What the truth makes of a response: ``common`` (n, k) columns of unit variance, and ``shift``
    (n,), by which its noise moves it in the mean.
    """

    common: Floats
    shift: Floats

    def of(self, rows: Bools) -> TruthPart:
        """Of some rows."""
        return TruthPart(self.common[rows], self.shift[rows])


def _part(response: str, errors: Floats, truth: JointCovariance) -> TruthPart:
    if response != "distance":
        return TruthPart(
            truth.along(np.eye(AXES)[RESPONSES.index(response)]), np.zeros(len(errors))
        )
    # |e + t| is |e| + t along e, and noise across makes it longer: tr(C across) / (2 |e|)
    distances = np.linalg.norm(errors, axis=1)
    ways = errors / np.maximum(distances, 1e-12)[:, None]
    covariances = truth.covariances_mm2
    whole = np.trace(covariances, axis1=1, axis2=2)
    across = np.maximum(whole - np.einsum("na,nab,nb->n", ways, covariances, ways), 0.0)
    shift = across / (2.0 * np.maximum(distances, np.sqrt(across)) + 1e-12)
    return TruthPart(truth.along(ways), shift)


def trend(
    values: npt.ArrayLike | Regressor,
    response: npt.ArrayLike,
    groups: Sequence[Hashable],
    *,
    within: Sequence[Hashable] | None = None,
    confidence: float = 0.95,
    part: TruthPart | None = None,
) -> Trend:
    """One line: `response` (n,) against `values` (n,), rows grouped by `groups` (n,), with a level
    for each of `within` (n,) if given. `part`: what the truth makes of the response.
    """
    of = values if isinstance(values, Regressor) else Regressor(values)
    x, y = as_values(of.values, "values"), as_values(response, "response")
    if not len(x) == len(y) == len(groups) or (within is not None and len(within) != len(x)):
        raise ValueError(
            f"trend: {len(x)} values, {len(y)} responses, {len(groups)} groups; give one of each"
            " for every row"
        )
    group = numbered(groups)
    stratum = np.zeros(len(x), dtype=np.intp) if within is None else numbered(within)
    count = int(group.max()) + 1 if len(x) else 0
    empty = Trend("", "", len(x), count, float(np.ptp(x)) if len(x) else 0.0)
    if count < LEAST_TREND_POSES:
        return empty
    if empty.span < LEAST_SPAN_U * of.u:
        return replace(empty, least_span=LEAST_SPAN_U * of.u)
    line, sxx, of_truth = *_ordinary(x, y, group, stratum, count), 0.0
    if line is None:
        return empty  # it did not vary, or only in one group
    if part is not None and (part.common.any() or part.shift.any()):
        if within is None and part.common.any():
            line = _generalised(x, y, group, count, part.common)
        of_truth = float(
            np.sum(np.square(line.weights @ part.common)) + (line.weights @ part.shift) ** 2
        )
    if of.measured and of.u > 0.0:  # an error of the place is one of the response too
        of_truth += (of.u**2 * len(x) / sxx) ** 2
    slope, without, freedom = line.slope, line.without, line.freedom
    scatter = (count - 1) / count * float(np.square(without - without.mean()).sum())
    error = sqrt(scatter + of_truth)
    freedom = min(freedom * ((scatter + of_truth) / scatter) ** 2, KNOWN) if scatter else KNOWN
    reach = float(stdtrit(freedom, (1.0 + confidence) / 2.0)) * error
    p_value = (
        2.0 * float(stdtr(freedom, -abs(slope) / error)) if error > 0.0 else float(slope == 0.0)
    )
    truth = float(ndtri((1.0 + confidence) / 2.0)) * sqrt(of_truth)
    found = replace(empty, slope=slope, p_value=p_value, truth=truth)
    return replace(found, low=slope - reach, high=slope + reach)


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """The slope, those without each group (count,), the weights (n,) of which it is y's sum, and
    the degrees of freedom of the jackknife.
    """

    slope: float
    without: Floats
    weights: Floats
    freedom: float


def _ordinary(
    x: Floats, y: Floats, group: npt.NDArray[np.intp], stratum: npt.NDArray[np.intp], count: int
) -> tuple[_Line | None, float]:
    """Least squares about the stratum means, and Sxx; None where x did not vary, or only in one
    group.

    Without the group g the slope is b - sum_g f e, with the residuals e = M y and f_i = (x_i - mean
    of its stratum + n_B / (n_S - n_B) (mean of its block - mean of its stratum)) / (Sxx without g);
    a block is what a group has of a stratum.
    """
    centred, in_stratum = _centred(x, stratum), np.bincount(stratum)
    blocks, block = np.unique(stratum * count + group, return_inverse=True)
    block, of = block.ravel(), blocks // count
    rest = np.maximum(in_stratum[of] - np.bincount(block), 1)
    sums, sxx = np.bincount(block, centred), float(centred @ centred)
    without_g = sxx - np.bincount(group, np.square(centred))
    without_g -= np.bincount(blocks % count, np.square(sums) / rest, minlength=count)
    if sxx <= 1e-12 * max(1.0, float(np.square(x).max())) * len(x) or np.any(
        without_g <= 1e-9 * sxx
    ):
        return None, sxx
    forms = (centred + (sums / rest)[block]) / without_g[group]
    left = _centred(y, stratum)
    slope = float(centred @ left) / sxx
    without = np.asarray(slope - np.bincount(group, forms * (left - slope * centred)))
    # a group has rows in few of all strata
    shared = np.bincount(block, forms) / np.sqrt(in_stratum[of])
    of_strata = csr_array((shared, (blocks % count, of)), (count, len(in_stratum)))
    of_slope = np.bincount(group, forms * centred)[:, None] / sqrt(sxx)
    lost = csr_array(hstack([of_strata, csr_array(of_slope)]))
    freedom = _jackknife_freedom(forms, group, lost)
    return _Line(slope, without, centred / sxx, freedom), sxx


def _jackknife_freedom(forms: Floats, group: npt.NDArray[np.intp], lost: csr_array) -> float:
    """tr(A)^2 / tr(A^2) of the groups' slopes about their mean, whose covariance A is that of sums
    of ``forms`` (n,) in each group, less ``lost`` (count, k) times its transpose; A (count, count)
    itself is never formed.
    """
    own = np.bincount(group, np.square(forms))
    count, less = len(own), np.asarray((lost * lost).sum(axis=1))
    total = own - lost @ np.asarray(lost.sum(axis=0))
    mean = float(total.sum()) / count
    trace = float(own.sum() - less.sum()) - mean
    squares = float(own @ own - 2.0 * own @ less) + float(np.square((lost.T @ lost).data).sum())
    return trace**2 / (squares - 2.0 * float(total @ total) / count + mean**2)


def _centred(x: Floats, stratum: npt.NDArray[np.intp]) -> Floats:
    """Less the mean of each stratum."""
    means = np.bincount(stratum, x) / np.bincount(stratum)
    return np.asarray(x - means[stratum])


def _generalised(
    x: Floats, y: Floats, group: npt.NDArray[np.intp], count: int, common: Floats
) -> _Line:
    """Generalised least squares with V = s^2 I + F F', s^2 from the ordinary line.

    Without the rows g it is b - c_g' Q_gg^-1 (Q y)_g, with c the weights and Q = V^-1 - V^-1 X (X'
    V^-1 X)^-1 X' V^-1, which is the covariance of Q y.
    """
    X = np.column_stack([np.ones_like(x), x - x.mean()])
    left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    noise = max(float(left @ left) / max(len(x) - 2, 1), 1e-12)
    vectors, sizes, _ = np.linalg.svd(common, full_matrices=False)
    F = (vectors * sizes)[:, sizes**2 > 1e-6 * noise]
    inner = np.linalg.inv(noise * np.eye(F.shape[1]) + F.T @ F)

    def inverse(of: Floats) -> Floats:
        return np.asarray((of - F @ (inner @ (F.T @ of))) / noise)

    VX = inverse(X)
    G = np.linalg.inv(X.T @ VX)
    weights = (VX @ G)[:, 1]
    slope, Qy = float(weights @ y), inverse(y) - VX @ (G @ (VX.T @ y))
    without, forms, sizes_of = np.empty(count), np.empty_like(x), np.bincount(group)
    starts, order = np.cumsum(sizes_of) - sizes_of, np.argsort(group, kind="stable")
    for size in np.unique(sizes_of):  # groups of one size at once
        of = np.flatnonzero(sizes_of == size)
        rows = order[starts[of][:, None] + np.arange(size)]
        own = (np.eye(size) - F[rows] @ inner @ F[rows].transpose(0, 2, 1)) / noise
        Qgg = own - VX[rows] @ G @ VX[rows].transpose(0, 2, 1)
        forms[rows] = np.linalg.solve(Qgg, weights[rows][:, :, None])[:, :, 0]
        without[of] = slope - np.sum(forms[rows] * Qy[rows], axis=1)
    lost = [
        np.column_stack([np.bincount(group, forms * column, count) for column in what.T])
        @ np.linalg.cholesky(size)
        for what, size in ((F, inner / noise), (VX, G))
        if what.size
    ]
    freedom = _jackknife_freedom(forms / sqrt(noise), group, csr_array(np.column_stack(lost)))
    return _Line(slope, without, np.asarray(weights), freedom)
