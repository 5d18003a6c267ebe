"""Camera to world from points that the arm touched and the cameras saw, with its covariance.

The triangulated points are fitted rigidly; similarity and affine are the diagnosis. The covariance
is joint with lenses and stereo, as their errors partly cancel where points were touched.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from detector.calibration.bundle import POSE
from detector.calibration.rigid import Comparison, compare, fle_from_fre_mm, target_error_mm
from detector.calibration.values import STEP, Pair, ParameterCovariance
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
    data = [np.array(each, dtype=np.float64) for each in (left_px, right_px, touched_mm)]
    in_right = triangulate(data[0], data[1], left, right, right_from_left)[0]
    if not np.isfinite(in_right).all():
        bad = int(np.flatnonzero(~np.isfinite(in_right).all(axis=1))[0]) + 1
        raise ValueError(
            f"point {bad} can't be triangulated: its pixels are outside of what the lenses were"
            " calibrated for"
        )
    here = rigid_fit(data[2], in_right)
    pair = Pair(left, right, right_from_left, here)
    given = pair_covariance or ParameterCovariance((), np.zeros((0, 0)))

    def world(changed: Pair, left_px: Array, right_px: Array, touched_mm: Array) -> Array:
        there = rigid_fit(touched_mm, changed.in_right_mm(left_px, right_px))
        return np.concatenate([_near(there.om, here.om), there.T])

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


def _near(om_rad: Array, reference_rad: Array) -> Array:
    """The same rotation with its vector on the reference's side of half a turn."""
    angle = float(np.linalg.norm(om_rad))
    other = om_rad * (1.0 - 2.0 * np.pi / angle) if angle > 0 else om_rad
    return min((om_rad, other), key=lambda om: float(np.linalg.norm(om - reference_rad)))
