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

from detector.geometry import Array, Motion

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
_CELL_NAMES_ROWS, _CELL_NAMES_COLUMNS = (
    ("top", "middle", "bottom"),
    (
        "far left",
        "left",
        "right",
        "far right",
    ),
)


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """``corners`` (ROWS, COLUMNS) by cell; ``tilted`` views by `SIDES`; nearest and farthest mm."""

    views: int
    corners: Array
    tilted: tuple[int, int, int, int]
    distances_mm: tuple[float, float] | None

    @property
    def share(self) -> float:
        """Share of the picture's cells that are covered, 0 to 1."""
        return float(np.mean(self.corners >= LEAST_CORNERS))

    @property
    def missing(self) -> tuple[str, ...]:
        """What is still to be shown, as instructions; empty when nothing is."""
        return (*self._area(), *self._tilts(), *self._distance(), *self._count())

    def _area(self) -> list[str]:
        empty = [
            f"{_CELL_NAMES_ROWS[row]} {_CELL_NAMES_COLUMNS[column]}"
            for row, column in np.argwhere(self.corners < LEAST_CORNERS)
        ]
        return [f"show the board in the picture's {', '.join(empty)}"] if empty else []

    def _tilts(self) -> list[str]:
        few = [side for side, count in zip(SIDES, self.tilted, strict=True) if count < LEAST_TILTED]
        return [f"tilt the board by 20 to 40 degrees, {side}" for side in few]

    def _distance(self) -> list[str]:
        if self.distances_mm is None:
            return []
        near, far = self.distances_mm
        if far >= DISTANCE_RATIO * near:
            return []
        return [f"hold the board nearer and farther: all views are {near:.0f} to {far:.0f} mm away"]

    def _count(self) -> list[str]:
        more = LEAST_VIEWS - self.views
        return [f"{more} more view{'s' if more > 1 else ''}"] if more > 0 else []


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
    tilted = np.zeros(4, dtype=int)
    for pose in poses:
        tilted += _leans(pose)
    depths = [float(pose.T[2]) for pose in poses]
    sides = (int(tilted[0]), int(tilted[1]), int(tilted[2]), int(tilted[3]))
    return Coverage(len(pixels_px), corners, sides, (min(depths), max(depths)) if depths else None)


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
    K = np.array(
        [
            [focal, 0.0, (image_size[0] - 1) / 2],
            [0.0, focal, (image_size[1] - 1) / 2],
            [0.0, 0.0, 1.0],
        ]
    )
    poses = []
    for board, pixels in zip(object_points, image_points, strict=True):
        _, turn, shift = cv2.solvePnP(board, pixels, K, np.zeros(5), flags=cv2.SOLVEPNP_IPPE)
        poses.append(Motion.from_vectors(turn.reshape(-1), shift.reshape(-1)))
    return poses


def _leans(pose: Motion) -> Array:
    """Which of `SIDES` the view is tilted to, (4,) of 0 and 1, by the board's normal."""
    normal = pose.R[:, 2] * (1.0 if pose.R[2, 2] > 0 else -1.0)
    x, y = np.degrees(np.arcsin(np.clip(normal[:2], -1.0, 1.0)))
    # a normal (away from the camera) that points to the right means that the left edge is farther
    # away
    return np.array([x < -TILT_DEG, x > TILT_DEG, y < -TILT_DEG, y > TILT_DEG], dtype=int)
