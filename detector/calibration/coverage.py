"""Which parts of the picture, tilts and distances a set of views covers, and what is missing, in
words.

Counts over few, wide cells and bins with a least number each, so that some 20 views do; the guide
names the emptiest first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from detector.calibration.cameras import flat_pose
from detector.geometry import Array, Camera, Motion

COLUMNS, ROWS = 4, 3  # cells of the picture
LEAST_CORNERS = 12  # in a cell that counts as covered
TILT_DEG = 15.0  # from here on a view counts as tilted to a side
LEAST_TILTED = 2  # views a side
DISTANCE_RATIO = 1.3  # farthest over nearest view
LEAST_VIEWS = 12
# what a rough focal length is believed to be, in widths of the picture
FOCAL_OVER_WIDTH = (0.5, 8.0)
SIDES = (
    "its left edge towards the cameras",
    "its right edge towards the cameras",
    "its upper edge towards the cameras",
    "its lower edge towards the cameras",
)
_ROW_NAMES = ("top", "middle", "bottom")
_COLUMN_NAMES = ("far left", "left", "right", "far right")


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """``corners`` (ROWS, COLUMNS) by cell; ``tilted`` views by `SIDES`; nearest and farthest mm."""

    views: int
    corners: Array
    tilted: tuple[int, ...]
    distances_mm: tuple[float, float] | None

    @property
    def share(self) -> float:
        """Share of the picture's cells that are covered, 0 to 1."""
        return float(np.mean(self.corners >= LEAST_CORNERS))

    @property
    def missing(self) -> tuple[str, ...]:
        """What is still to be shown, as instructions; empty when nothing is."""
        found = []
        empty = [
            f"{_ROW_NAMES[row]} {_COLUMN_NAMES[column]}"
            for row, column in np.argwhere(self.corners < LEAST_CORNERS)
        ]
        if empty:
            found.append(f"show the board in the picture's {', '.join(empty)}")
        for side, count in zip(SIDES, self.tilted, strict=True):
            if count < LEAST_TILTED:
                found.append(f"tilt the board by 20 to 40 degrees, {side}")
        near, far = self.distances_mm or (0.0, 0.0)
        if self.distances_mm and far < DISTANCE_RATIO * near:
            found.append(
                f"hold the board nearer and farther: all views are {near:.0f} to {far:.0f} mm away"
            )
        more = LEAST_VIEWS - self.views
        if more > 0:
            found.append(f"{more} more view{'s' if more > 1 else ''}")
        return tuple(found)


def coverage(
    pixels_px: Sequence[Array], image_size: tuple[int, int], poses: Sequence[Motion] = ()
) -> Coverage:
    """Of views with corners (n, 2) in (columns, rows) px; ``poses``: camera_from_board if known."""
    corners = np.zeros((ROWS, COLUMNS), dtype=np.float64)
    for pixels in pixels_px:
        cell = np.clip(
            (pixels + 0.5) / image_size * (COLUMNS, ROWS), 0, (COLUMNS - 1e-9, ROWS - 1e-9)
        ).astype(int)
        np.add.at(corners, (cell[:, 1], cell[:, 0]), 1.0)
    # a normal (away from the camera) that points to the right: the left edge is farther away
    normals = np.array([pose.R[:2, 2] * np.copysign(1, pose.R[2, 2]) for pose in poses])
    x, y = np.degrees(np.arcsin(np.clip(normals.reshape(-1, 2), -1.0, 1.0))).T
    sides = (x < -TILT_DEG, x > TILT_DEG, y < -TILT_DEG, y > TILT_DEG)
    depths = [float(pose.T[2]) for pose in poses]
    tilted = tuple(int(side.sum()) for side in sides)
    return Coverage(len(pixels_px), corners, tilted, (min(depths), max(depths)) if depths else None)


def rough_poses(
    board_mm: Sequence[Array], pixels_px: Sequence[Array], image_size: tuple[int, int]
) -> list[Motion]:
    """camera_from_board of views, points (n, 3) mm at (n, 2) px, with a guessed lens: for a guide.

    Focal length by Zhang 2000, closed form; central principal point; no distortion.
    """
    if not board_mm:
        return []
    object_points, image_points = (
        [np.asarray(part, dtype=np.float32) for part in parts] for parts in (board_mm, pixels_px)
    )
    guessed = float(cv2.initCameraMatrix2D(object_points, image_points, image_size, 1.0)[0, 0])
    low, high = (ratio * image_size[0] for ratio in FOCAL_OVER_WIDTH)
    focal = min(max(guessed, low), high) if np.isfinite(guessed) else float(image_size[0])
    middle = (image_size[0] - 1) / 2, (image_size[1] - 1) / 2
    lens = Camera(image_size, (focal, focal), middle)
    return [
        flat_pose(board, pixels, lens.matrix, np.array(lens.kc))
        for board, pixels in zip(object_points, image_points, strict=True)
    ]
