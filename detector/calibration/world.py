"""Camera to world from points that the arm touched and the cameras saw, with its covariance.

The triangulated points are fitted rigidly; similarity and affine are the diagnosis. The covariance
is joint with lenses and stereo, as their errors partly cancel where points were touched.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from detector.calibration.bundle import POSE
from detector.calibration.rigid import Comparison, compare, fle_from_fre_mm, target_error_mm
from detector.calibration.uncertainty import STEP, Pair, ParameterCovariance
from detector.geometry import Array, Camera, Motion, rigid_fit, triangulate

POINT_STEP_MM = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class WorldFit:
    """``comparison`` of touched with triangulated points (right camera's frame), and joint
    covariance. ``in_right_mm``, ``touched_mm`` (n, 3); ``covariance``: the pair's parameters and
    the world's six.
    """

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
        """Standard deviation of `scale` as the residuals tell it."""
        left_over = self.comparison.similarity.residuals_mm
        freedom = max(left_over.size - 7, 1)
        spread = self.in_right_mm - self.in_right_mm.mean(axis=0)
        return float(np.sqrt(np.sum(left_over**2) / freedom / np.sum(spread**2)))

    def target_error_mm(self, world_mm: ArrayLike) -> Array:
        """Expected error (m,) at world points (m, 3), by the fit's residuals."""
        fle_mm = fle_from_fre_mm(self.comparison.rigid.fre_mm, len(self.touched_mm))
        return target_error_mm(fle_mm, self.touched_mm, world_mm)


def fit_world(
    left: Camera,
    right: Camera,
    right_from_left: Motion,
    left_px: ArrayLike,
    right_px: ArrayLike,
    touched_mm: ArrayLike,
    *,
    pair_covariance: ParameterCovariance | None,
    pixel_sd_px: float,
    touch_sd_mm: float,
) -> WorldFit:
    """World from pixel pairs (n, 2) of points touched at (n, 3) mm. Raises ValueError without a
    fit. ``touch_sd_mm`` along each axis, ``pixel_sd_px`` of a coordinate.
    """
    seen = np.asarray(left_px, dtype=np.float64), np.asarray(right_px, dtype=np.float64)
    touched = np.asarray(touched_mm, dtype=np.float64)
    in_right = triangulate(*seen, left, right, right_from_left)[0]
    if not np.isfinite(in_right).all():
        bad = int(np.flatnonzero(~np.isfinite(in_right).all(axis=1))[0]) + 1
        raise ValueError(
            f"point {bad} can't be triangulated: its pixels are outside of what the lenses were"
            " calibrated for"
        )
    pair = Pair(left, right, right_from_left, rigid_fit(touched, in_right))
    covariance = _joint(
        pair,
        seen,
        touched,
        pair_covariance or ParameterCovariance((), np.zeros((0, 0))),
        pixel_sd_px,
        touch_sd_mm,
    )
    return WorldFit(
        pair.world_from_right, compare(touched, in_right), covariance, in_right, touched
    )


def _joint(
    pair: Pair,
    seen: tuple[Array, Array],
    touched: Array,
    given: ParameterCovariance,
    pixel_sd_px: float,
    touch_sd_mm: float,
) -> ParameterCovariance:
    """The pair's parameters pass through; the world's follow from them, pixels and touches."""
    here = pair.world_from_right

    def world(changed: Pair, left_px: Array, right_px: Array, touched_mm: Array) -> Array:
        in_right = triangulate(
            left_px, right_px, changed.left, changed.right, changed.right_from_left
        )[0]
        there = rigid_fit(touched_mm, in_right)
        return np.concatenate([_near(there.om, here.om), there.T])

    columns = [
        _slope(lambda h, o=o, n=n: world(pair.moved(o, n, h), *seen, touched), STEP * sd)  # type: ignore[misc]
        for (o, n), sd in given.sds.items()
    ]
    by_pair = np.column_stack(columns) if columns else np.zeros((6, 0))
    own = np.zeros((6, 6))
    for side, sd in ((0, pixel_sd_px), (1, pixel_sd_px), (2, touch_sd_mm)):
        own += sd**2 * _sum_over_entries(world, pair, (*seen, touched), side)
    top = np.hstack([given.matrix, given.matrix @ by_pair.T])
    bottom = np.hstack([by_pair @ given.matrix, by_pair @ given.matrix @ by_pair.T + own])
    names = (*given.names, *(("world", name) for name in POSE))
    return ParameterCovariance(names, np.vstack([top, bottom]))


def _sum_over_entries(
    world: Callable[..., Array], pair: Pair, data: tuple[Array, Array, Array], side: int
) -> Array:
    """The sum over all numbers of one of the three inputs of slope times slope, (6, 6)."""
    total = np.zeros((6, 6))
    for at in np.ndindex(data[side].shape):

        def moved(h: float, at: tuple[int, ...] = at) -> Array:
            changed = list(data)
            changed[side] = data[side].copy()
            changed[side][at] += h
            return world(pair, *changed)

        slope = _slope(moved, POINT_STEP_MM)
        total += np.outer(slope, slope)
    return total


def _near(om_rad: Array, reference_rad: Array) -> Array:
    """The same rotation with its vector on the reference's side of half a turn."""
    angle = float(np.linalg.norm(om_rad))
    other = om_rad * (1.0 - 2.0 * np.pi / angle) if angle > 0 else om_rad
    return min((om_rad, other), key=lambda om: float(np.linalg.norm(om - reference_rad)))


def _slope(place: Callable[[float], Array], step: float) -> Array:
    return (place(step) - place(-step)) / (2.0 * step)
