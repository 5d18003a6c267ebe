"""Homographies from thermal to optical pixels out of point pairs, as the thesis made them by hand.

Strategy: OpenCV's RANSAC, then a least-squares fit of the inliers; which pairs were left out is part of the answer. A homography is right
on the plane of its points and nowhere else. May not know where the pairs come from.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from detector.geometry import Array, apply_homography

LEAST_PAIRS = 6  # four fix a homography and leave nothing to see by whether they are right
RANSAC_PX = 3.0
RANSAC_SEED = 1


@dataclass(frozen=True, slots=True, eq=False)
class MappedPairs:
    """The homography (3, 3) from un-mirrored thermal px to optical px, which pairs (n,) it holds for, and by how much it misses each.

    ``missed_px`` (n,), over all pairs.
    """

    H: Array
    inliers: NDArray[np.bool_]
    missed_px: Array

    @property
    def rms_px(self) -> float:
        """Over the inliers."""
        return float(np.sqrt(np.mean(self.missed_px[self.inliers] ** 2)))


def fit_homography(thermal_px: ArrayLike, optical_px: ArrayLike) -> MappedPairs:
    """From pairs (n, 2) each. Raises ValueError for too few, or for points that determine none (all on one line)."""
    thermal, optical = (np.asarray(points, dtype=np.float64) for points in (thermal_px, optical_px))
    if len(thermal) != len(optical) or len(thermal) < LEAST_PAIRS:
        raise ValueError(f"a homography needs at least {LEAST_PAIRS} pairs, got {len(thermal)} thermal and {len(optical)} optical points")
    for points, which in ((thermal, "thermal"), (optical, "optical")):
        extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if extent[1] < 1e-3 * extent[0]:
            raise ValueError(f"the {which} points lie on one line: they must spread over the picture")
    cv2.setRNGSeed(RANSAC_SEED)
    H, marked = cv2.findHomography(thermal, optical, cv2.RANSAC, RANSAC_PX)
    if H is None or int(marked.sum()) < LEAST_PAIRS:
        raise ValueError(
            "no homography holds for six of the pairs: are thermal and optical columns swapped, or is the picture still mirrored?"
        )
    inliers = np.asarray(marked.reshape(-1) > 0)
    refined = np.asarray(cv2.findHomography(thermal[inliers], optical[inliers], 0)[0], dtype=np.float64)
    return MappedPairs(refined, inliers, np.linalg.norm(apply_homography(refined, thermal) - optical, axis=1))
