"""Rigid, similarity and affine fits of points to points, with residuals and held-out errors.

The rigid fit is the answer; a much better affine one means that a set is measured wrongly. Points
in a plane: its normal maps to the other's, at scale 1. Kabsch 1976 (rigid), Umeyama 1991
(similarity); Fitzpatrick, West and Maurer, IEEE Trans. Med. Imaging 17 (1998) 694 (fiducial and
target error).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

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


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """The three fits, and each one's held-out rms error in mm (None: too few pairs)."""

    rigid: Fit
    similarity: Fit
    affine: Fit
    held_out_mm: dict[str, float | None]

    @property
    def fits(self) -> tuple[Fit, Fit, Fit]:
        """In the order of their freedom."""
        return self.rigid, self.similarity, self.affine


def fit_rigid(target_mm: ArrayLike, source_mm: ArrayLike) -> Fit:
    """Rotation and shift, no reflection. Raises ValueError as `detector.geometry.rigid_fit`."""
    motion = rigid_fit(target_mm, source_mm)
    return _left_over("rigid", motion.R, motion.T, target_mm, source_mm)


def fit_similarity(target_mm: ArrayLike, source_mm: ArrayLike) -> Fit:
    """Rotation, shift and one scale (Umeyama 1991, eq. 42). Raises ValueError as the rigid fit."""
    motion = rigid_fit(target_mm, source_mm)
    target, source = (
        np.asarray(target_mm, dtype=np.float64),
        np.asarray(source_mm, dtype=np.float64),
    )
    centred_t, centred_s = target - target.mean(axis=0), source - source.mean(axis=0)
    scale = float(np.sum(centred_t * (centred_s @ motion.R.T)) / np.sum(centred_s**2))
    A = scale * motion.R
    return _left_over(
        "similarity", A, target.mean(axis=0) - A @ source.mean(axis=0), target, source
    )


def fit_affine(target_mm: ArrayLike, source_mm: ArrayLike) -> Fit:
    """A linear map and a shift; for points in a plane, its normal goes to the other's. Raises
    ValueError as the rigid fit.
    """
    target, source = (
        np.asarray(target_mm, dtype=np.float64),
        np.asarray(source_mm, dtype=np.float64),
    )
    rigid_fit(target, source)  # refuses what determines no fit, in the same words
    centred_t, centred_s = target - target.mean(axis=0), source - source.mean(axis=0)
    _, extent, axes = np.linalg.svd(centred_s, full_matrices=True)
    rank = int(np.count_nonzero(extent > _FLAT * extent[0]))
    slopes = np.linalg.lstsq(centred_s @ axes[:rank].T, centred_t, rcond=None)[0].T
    if rank == 2:
        normal = np.cross(slopes[:, 0], slopes[:, 1]) * np.sign(np.linalg.det(axes))
        slopes = np.column_stack([slopes, normal / np.linalg.norm(normal)])
    A = slopes @ axes
    return _left_over("affine", A, target.mean(axis=0) - A @ source.mean(axis=0), target, source)


def compare(target_mm: ArrayLike, source_mm: ArrayLike) -> Comparison:
    """All three fits of pairs (n, 3) with held-out errors. Raises ValueError as the rigid fit."""
    models = {"rigid": fit_rigid, "similarity": fit_similarity, "affine": fit_affine}
    held_out = {name: rms_held_out_mm(fit, target_mm, source_mm) for name, fit in models.items()}
    rigid, similarity, affine = (fit(target_mm, source_mm) for fit in models.values())
    return Comparison(rigid, similarity, affine, held_out)


def held_out_mm(
    fit: Callable[[ArrayLike, ArrayLike], Fit], target_mm: ArrayLike, source_mm: ArrayLike
) -> Array:
    """Distances (n,) of pairs (n, 3) from the fit of all others; NaN where those determine none."""
    target, source = (
        np.asarray(target_mm, dtype=np.float64),
        np.asarray(source_mm, dtype=np.float64),
    )
    missed = np.full(len(source), np.nan)
    for row in range(len(source)):
        others = np.arange(len(source)) != row
        if np.linalg.matrix_rank(
            source[others] - source[others].mean(axis=0)
        ) < np.linalg.matrix_rank(source - source.mean(axis=0)):
            continue
        if others.sum() >= 3:
            missed[row] = np.linalg.norm(
                target[row] - fit(target[others], source[others]).apply(source[row])
            )
    return missed


def rms_held_out_mm(
    fit: Callable[[ArrayLike, ArrayLike], Fit], target_mm: ArrayLike, source_mm: ArrayLike
) -> float | None:
    """Root mean square of `held_out_mm` over the pairs that have one; None where none has."""
    missed = held_out_mm(fit, target_mm, source_mm)
    known = missed[np.isfinite(missed)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None


def expected_fre_mm(fle_mm: float, n: int) -> float:
    """Root of <FRE^2> = (1 - 2/N) <FLE^2>; ``fle_mm`` is a fiducial's rms. Raises ValueError below
    3.
    """
    return fle_mm * float(np.sqrt(1.0 - 2.0 / _enough(n)))


def fle_from_fre_mm(fre_mm: float, n: int) -> float:
    """The fiducial localisation error from the FRE of ``n`` points. Raises ValueError below 3."""
    return fre_mm / float(np.sqrt(1.0 - 2.0 / _enough(n)))


def target_error_mm(fle_mm: float, fiducials_mm: ArrayLike, at_mm: ArrayLike) -> Array:
    """Expected target error (m,) at points (m, 3): <TRE^2(r)> = <FLE^2>/N (1 + 1/3 sum d_k^2 /
    f_k^2).

    d_k: the point's distance from principal axis k of the fiducials (n, 3); f_k: theirs, rms
    (Fitzpatrick, West and Maurer 1998, eq. 46). Infinite for fiducials on one line.
    """
    source, at = (
        np.asarray(fiducials_mm, dtype=np.float64),
        np.atleast_2d(np.asarray(at_mm, dtype=np.float64)),
    )
    _enough(len(source))
    centre = source.mean(axis=0)
    axes = np.linalg.svd(source - centre, full_matrices=True)[2]
    own, there = (source - centre) @ axes.T, (at - centre) @ axes.T
    f2 = np.mean(np.sum(own**2, axis=1)[:, None] - own**2, axis=0)
    d2 = np.sum(there**2, axis=1)[:, None] - there**2
    with np.errstate(divide="ignore"):
        return np.asarray(fle_mm * np.sqrt((1.0 + np.sum(d2 / f2, axis=1) / 3.0) / len(source)))


def rotation_covariance(fiducials_mm: ArrayLike, u_mm: float) -> Array:
    """Covariance (3, 3) rad^2 of a fit's rotation vector about the axes of fiducials (n, 3), first
    order. ``u_mm``: standard uncertainty of each coordinate, uncorrelated. Raises ValueError for a
    line.
    """
    source = np.asarray(fiducials_mm, dtype=np.float64)
    _enough(len(source))
    centred = source - source.mean(axis=0)
    inertia = np.sum(centred**2) * np.eye(3) - centred.T @ centred
    if np.linalg.eigvalsh(inertia)[0] <= _FLAT * np.trace(inertia):
        raise ValueError("a rotation needs points that don't all lie on one line")
    return np.asarray(u_mm**2 * np.linalg.inv(inertia))


def target_covariance(fiducials_mm: ArrayLike, u_mm: float, at_mm: ArrayLike) -> Array:
    """Covariance (3, 3) mm^2 of a mapped point (3,) in the fiducials' axes, first order. Its trace
    is `target_error_mm` squared with fle = sqrt(3) u. Raises ValueError for a line.
    """
    source = np.asarray(fiducials_mm, dtype=np.float64)
    arm = cross_matrix(np.asarray(at_mm, dtype=np.float64) - source.mean(axis=0))
    return np.asarray(
        u_mm**2 / len(source) * np.eye(3) + arm @ rotation_covariance(source, u_mm) @ arm.T
    )


def cross_matrix(vector: ArrayLike) -> Array:
    """The matrix (3, 3) whose product with w is vector x w."""
    x, y, z = np.asarray(vector, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def motion_of(fit: Fit) -> Motion:
    """The motion of a rigid fit. Raises ValueError for another model."""
    return Motion(fit.A, fit.t)


def _left_over(model: str, A: Array, t: Array, target_mm: ArrayLike, source_mm: ArrayLike) -> Fit:
    target, source = (
        np.asarray(target_mm, dtype=np.float64),
        np.asarray(source_mm, dtype=np.float64),
    )
    return Fit(model, np.asarray(A), np.asarray(t), np.asarray(target - (source @ A.T + t)))


def _enough(n: int) -> int:
    if n < 3:
        raise ValueError(f"a registration needs at least 3 points, has {n}")
    return n
