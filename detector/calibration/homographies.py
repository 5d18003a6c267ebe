"""Homographies from thermal to optical pixels: from point pairs, or for a plane from calibrated
cameras.

Pairs: OpenCV's RANSAC, then least squares of the inliers. Plane: a grid of thermal pixels is
carried to it and into the optical camera by the full lens models; the fit's residual is a few
tenths of a pixel on the thesis's rig.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from detector.calibration.bundle import BundleError
from detector.calibration.values import Homographies
from detector.geometry import Array, Camera, Motion, apply_homography

LEAST_PAIRS = 6  # four fix a homography and leave nothing to see by whether they are right
RANSAC_PX = 3.0
RANSAC_SEED = 1


@dataclass(frozen=True, slots=True, eq=False)
class MappedPairs:
    """``H`` (3, 3) from un-mirrored thermal to optical px, ``inliers`` (n,), ``missed_px`` (n,)."""

    H: Array
    inliers: NDArray[np.bool_]
    missed_px: Array

    @property
    def rms_px(self) -> float:
        """Over the inliers."""
        return float(np.sqrt(np.mean(self.missed_px[self.inliers] ** 2)))


def fit_homography(thermal_px: ArrayLike, optical_px: ArrayLike) -> MappedPairs:
    """From pairs (n, 2) each. Raises ValueError for too few, or points on a line."""
    thermal, optical = (np.asarray(points, dtype=np.float64) for points in (thermal_px, optical_px))
    if len(thermal) != len(optical) or len(thermal) < LEAST_PAIRS:
        got = f"{len(thermal)} thermal and {len(optical)} optical points"
        raise ValueError(f"a homography needs at least {LEAST_PAIRS} pairs, got {got}")
    for points, which in ((thermal, "thermal"), (optical, "optical")):
        extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if extent[1] < 1e-3 * extent[0]:
            what = "lie on one line: they must spread over the picture"
            raise ValueError(f"the {which} points {what}")
    cv2.setRNGSeed(RANSAC_SEED)
    H, marked = cv2.findHomography(thermal, optical, cv2.RANSAC, RANSAC_PX)
    if H is None or int(marked.sum()) < LEAST_PAIRS:
        raise ValueError(
            "no homography holds for six of the pairs: are thermal and optical columns swapped, or"
            " is the picture still mirrored?"
        )
    inliers = np.asarray(marked.reshape(-1) > 0)
    fitted, _ = cv2.findHomography(thermal[inliers], optical[inliers], 0)
    refined = np.asarray(fitted, dtype=np.float64)
    missed_px = np.linalg.norm(apply_homography(refined, thermal) - optical, axis=1)
    return MappedPairs(refined, inliers, missed_px)


# Of the mean teat end of table 5.2 in the thesis's rig, to a millimetre: for a rig whose file names
# no plane.
DEFAULT_PLANE_DEPTH_MM = 1076.0

_GRID = 21


def thermal_grid(image_size: tuple[int, int]) -> Array:
    """Pixels (441, 2) evenly over a picture of image_size (columns, rows), with its corners."""
    x, y = np.meshgrid(*(np.linspace(0, size - 1, _GRID) for size in image_size))
    return np.column_stack([x.ravel(), y.ravel()])


def through_plane(
    thermal_px: Array, thermal: Camera, thermal_from_right: Motion, plane_depth_mm: float
) -> Array:
    """Points (n, 3), right frame, of thermal pixels (n, 2) on Z = plane_depth_mm; NaN behind."""
    right_from_thermal = thermal_from_right.inverse()
    origin = right_from_thermal.T
    direction = thermal.rays(thermal_px) @ right_from_thermal.R.T
    distance = (plane_depth_mm - origin[2]) / direction[:, 2]
    return np.asarray(origin + direction * np.where(distance > 0, distance, np.nan)[:, None])


def plane_homography(
    thermal: Camera,
    optical: Camera,
    thermal_from_right: Motion,
    optical_from_right: Motion,
    plane_depth_mm: float,
) -> Array:
    """(3, 3) from un-mirrored thermal to optical pixels on Z = plane_depth_mm (right camera's
    frame). Raises BundleError unless the plane is before both cameras.
    """
    grid = thermal_grid(thermal.image_size)
    on_plane = through_plane(grid, thermal, thermal_from_right, plane_depth_mm)
    seen = optical.project(optical_from_right.apply(on_plane))
    if not plane_depth_mm > 0 or not np.isfinite(seen).all():
        what = "isn't in front of both cameras over the whole thermal picture"
        raise BundleError(f"the plane at {plane_depth_mm:g} mm {what}")
    # every pair counted alike: a plain least-squares fit
    H, _ = cv2.findHomography(grid, seen, 0)
    return np.asarray(H / H[2, 2], dtype=np.float64)


def derive_homographies(
    thermal: Camera,
    left: Camera,
    right: Camera,
    thermal_from_left: Motion,
    right_from_left: Motion,
    plane_depth_mm: float = DEFAULT_PLANE_DEPTH_MM,
) -> Homographies:
    """Both homographies of a rig at one plane. Raises BundleError as `plane_homography` does."""
    left_from_right = right_from_left.inverse()
    thermal_from_right = thermal_from_left @ left_from_right
    return Homographies(
        plane_homography(thermal, left, thermal_from_right, left_from_right, plane_depth_mm),
        plane_homography(thermal, right, thermal_from_right, Motion.identity(), plane_depth_mm),
        plane_depth_mm,
    )
