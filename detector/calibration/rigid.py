"""Rigid, similarity and affine fits of points to points, and camera to world by them.

The rigid fit is the answer; a much better affine one means that a set is measured wrongly. The
world's covariance is joint with lenses and stereo: their errors partly cancel at touched points.
Kabsch 1976 (rigid), Umeyama 1991 (similarity); Fitzpatrick, West and Maurer, IEEE Trans. Med.
Imaging 17 (1998) 694 (fiducial and target error).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from detector.calibration.bundle import POSE
from detector.calibration.values import STEP, Pair, ParameterCovariance
from detector.geometry import Array, Motion, rigid_fit

_FLAT = 1e-9  # of the largest extent: thinner than this is no extent


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """x -> A x + t: A (3, 3), t (3,) mm; ``residuals_mm`` (n, 3) are target less fitted source."""

    model: str
    A: Array
    t: Array
    residuals_mm: Array

    @property
    def fre_mm(self) -> float:
        """Fiducial registration error: the root mean square length of the residuals."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_mm**2, axis=1))))

    @property
    def singular_values(self) -> Array:
        """Singular values (3,) of A, largest first: all 1 for a rigid motion."""
        return np.asarray(np.linalg.svd(self.A, compute_uv=False))

    def apply(self, points_mm: ArrayLike) -> Array:
        """Map points (n, 3) or one point (3,)."""
        return np.asarray(np.asarray(points_mm, dtype=np.float64) @ self.A.T + self.t)


MODELS = ("rigid", "similarity", "affine")


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """The three fits, and each one's held-out rms error in mm (None: too few pairs)."""

    rigid: Fit
    similarity: Fit
    affine: Fit
    held_out_mm: dict[str, float | None]

    @property
    def fits(self) -> tuple[Fit, Fit, Fit]:
        return self.rigid, self.similarity, self.affine


def fit_points(model: str, target_mm: ArrayLike, source_mm: ArrayLike) -> Fit:
    """One of `MODELS` from pairs (n, 3): "rigid" without reflection; "similarity" with one scale
    (Umeyama 1991, eq. 42); "affine", where a plane's normal goes to the other's. Raises ValueError
    as `detector.geometry.rigid_fit`.
    """
    target, source = (np.asarray(each, dtype=np.float64) for each in (target_mm, source_mm))
    A = rigid_fit(target, source).R
    centred_t, centred_s = target - target.mean(axis=0), source - source.mean(axis=0)
    if model == "similarity":
        A = A * float(np.sum(centred_t * (centred_s @ A.T)) / np.sum(centred_s**2))
    if model == "affine":
        _, extent, axes = np.linalg.svd(centred_s, full_matrices=True)
        rank = int(np.count_nonzero(extent > _FLAT * extent[0]))
        slopes = np.linalg.lstsq(centred_s @ axes[:rank].T, centred_t, rcond=None)[0].T
        if rank == 2:
            normal = np.cross(slopes[:, 0], slopes[:, 1]) * np.sign(np.linalg.det(axes))
            slopes = np.column_stack([slopes, normal / np.linalg.norm(normal)])
        A = slopes @ axes
    t = target.mean(axis=0) - A @ source.mean(axis=0)
    return Fit(model, A, t, target - (source @ A.T + t))


def compare(target_mm: ArrayLike, source_mm: ArrayLike) -> Comparison:
    """All three fits of pairs (n, 3) with held-out errors. Raises ValueError as the rigid fit."""
    rigid, similarity, affine = (fit_points(model, target_mm, source_mm) for model in MODELS)
    held_out: dict[str, float | None] = {}
    for model in MODELS:
        missed = held_out_mm(model, target_mm, source_mm)
        known = missed[np.isfinite(missed)]
        held_out[model] = float(np.sqrt(np.mean(known**2))) if len(known) else None
    return Comparison(rigid, similarity, affine, held_out)


def held_out_mm(model: str, target_mm: ArrayLike, source_mm: ArrayLike) -> Array:
    """Distances (n,) of pairs (n, 3) from the fit of all others; NaN where those determine none."""
    target, source = (np.asarray(each, dtype=np.float64) for each in (target_mm, source_mm))
    missed = np.full(len(source), np.nan)
    rank = np.linalg.matrix_rank(source - source.mean(axis=0))
    for row in range(len(source)):
        others = np.arange(len(source)) != row
        rest = source[others] - source[others].mean(axis=0)
        if others.sum() >= 3 and np.linalg.matrix_rank(rest) >= rank:
            found = fit_points(model, target[others], source[others]).apply(source[row])
            missed[row] = np.linalg.norm(target[row] - found)
    return missed


def target_error_mm(fle_mm: float, fiducials_mm: ArrayLike, at_mm: ArrayLike) -> Array:
    """Expected target error (m,) at points (m, 3): <TRE^2(r)> = <FLE^2>/N (1 + 1/3 sum d_k^2 /
    f_k^2), d_k, f_k (rms): distances from principal axis k (Fitzpatrick et al. 1998, eq. 46).
    """
    source, at = _fiducials(fiducials_mm), np.atleast_2d(np.asarray(at_mm, dtype=np.float64))
    centre = source.mean(axis=0)
    axes = np.linalg.svd(source - centre, full_matrices=True)[2]
    own, there = (source - centre) @ axes.T, (at - centre) @ axes.T
    f2 = np.mean(np.sum(own**2, axis=1)[:, None] - own**2, axis=0)
    d2 = np.sum(there**2, axis=1)[:, None] - there**2
    with np.errstate(divide="ignore"):
        return np.asarray(fle_mm * np.sqrt((1.0 + np.sum(d2 / f2, axis=1) / 3.0) / len(source)))


def rotation_covariance(fiducials_mm: ArrayLike, u_mm: float) -> Array:
    """Covariance (3, 3) rad^2 of a fit's rotation about the axes of fiducials (n, 3), first order.
    ``u_mm``: of each coordinate. Raises ValueError for a line.
    """
    source = _fiducials(fiducials_mm)
    centred = source - source.mean(axis=0)
    inertia = np.sum(centred**2) * np.eye(3) - centred.T @ centred
    if np.linalg.eigvalsh(inertia)[0] <= _FLAT * np.trace(inertia):
        raise ValueError("a rotation needs points that don't all lie on one line")
    return np.asarray(u_mm**2 * np.linalg.inv(inertia))


def cross_matrix(vector: ArrayLike) -> Array:
    """The matrix (3, 3) whose product with w is vector x w."""
    x, y, z = np.asarray(vector, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _fiducials(points_mm: ArrayLike) -> Array:
    points = np.asarray(points_mm, dtype=np.float64)
    if len(points) < 3:
        raise ValueError(f"a registration needs at least 3 points, has {len(points)}")
    return points


POINT_STEP_MM = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class WorldFit:
    """Touched to triangulated points (n, 3): the fit, and the covariance of pair and world."""

    world_from_right: Motion
    comparison: Comparison
    covariance: ParameterCovariance
    in_right_mm: Array
    touched_mm: Array

    @property
    def scale(self) -> float:
        """Touched over triangulated lengths: far from 1, squares or baseline are wrong."""
        return float(np.cbrt(np.linalg.det(self.comparison.similarity.A)))

    @property
    def scale_sd(self) -> float:
        """Standard deviation of `scale`, by the residuals."""
        left_over = self.comparison.similarity.residuals_mm
        freedom = max(left_over.size - 7, 1)
        spread = self.in_right_mm - self.in_right_mm.mean(axis=0)
        return float(np.sqrt(np.sum(left_over**2) / freedom / np.sum(spread**2)))

    def target_error_mm(self, world_mm: ArrayLike) -> Array:
        """Expected error (m,) at world points (m, 3), by the fit's residuals."""
        # <FRE^2> = (1 - 2/N) <FLE^2>
        fle_mm = self.comparison.rigid.fre_mm / np.sqrt(1.0 - 2.0 / len(self.touched_mm))
        return target_error_mm(float(fle_mm), self.touched_mm, world_mm)


def fit_world(
    pair: Pair,
    left_px: ArrayLike,
    right_px: ArrayLike,
    touched_mm: ArrayLike,
    *,
    pair_covariance: ParameterCovariance | None,
    pixel_sd_px: float,
    touch_sd_mm: float,
) -> WorldFit:
    """World from pixel pairs (n, 2) of points touched at (n, 3) mm. Raises ValueError."""
    data = [np.array(each, dtype=np.float64) for each in (left_px, right_px, touched_mm)]
    in_right = pair.in_right_mm(data[0], data[1])
    if not np.isfinite(in_right).all():
        bad = int(np.flatnonzero(~np.isfinite(in_right).all(axis=1))[0]) + 1
        why = "its pixels are outside of what the lenses were calibrated for"
        raise ValueError(f"point {bad} can't be triangulated: {why}")
    here = rigid_fit(data[2], in_right)
    given = pair_covariance or ParameterCovariance((), np.zeros((0, 0)))

    def world(changed: Pair, left_px: Array, right_px: Array, touched_mm: Array) -> Array:
        there = rigid_fit(touched_mm, changed.in_right_mm(left_px, right_px))
        # the same rotation with its vector on the fit's side of half a turn
        angle = float(np.linalg.norm(there.om))
        other = there.om * (1.0 - 2.0 * np.pi / angle) if angle > 0 else there.om
        om = min((there.om, other), key=lambda om: float(np.linalg.norm(om - here.om)))
        return np.concatenate([om, there.T])

    by_pair = np.zeros((6, len(given.names)))
    for column, ((owner, name), sd) in enumerate(given.sds.items()):
        h = STEP * sd
        near, far = (world(pair.moved(owner, name, s), *data) for s in (-h, h))
        by_pair[:, column] = (far - near) / (2.0 * h)
    own = np.zeros((6, 6))
    for each, sd in zip(data, (pixel_sd_px, pixel_sd_px, touch_sd_mm), strict=True):
        total = np.zeros((6, 6))
        for at in np.ndindex(each.shape):
            kept, ends = each[at], []
            for step in (-POINT_STEP_MM, POINT_STEP_MM):
                each[at] = kept + step
                ends.append(world(pair, *data))
            each[at] = kept
            slope = (ends[1] - ends[0]) / (2.0 * POINT_STEP_MM)
            total += np.outer(slope, slope)
        own += sd**2 * total
    # the pair's parameters pass through; the world's follow from them, pixels and touches
    M, B = given.matrix, by_pair
    joint = np.block([[M, M @ B.T], [B @ M, B @ M @ B.T + own]])
    names = (*given.names, *(("world", name) for name in POSE))
    covariance = ParameterCovariance(names, joint)
    return WorldFit(here, compare(data[2], in_right), covariance, in_right, data[2])
