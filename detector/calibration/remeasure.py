"""A board measured again in space with a calibrated pair: spacing, flatness, epipolar offset. Its
views are not those of the calibration; `diagnosis` judges how errors vary with distance and place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detector.calibration.boards import Board
from detector.calibration.uncertainty import Pair
from detector.geometry import Array, triangulate

Ids = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class PairView:
    """A board seen by both cameras: points ``ids`` (n,) at left and right pixels (n, 2)."""

    name: str
    ids: Ids
    left_px: Array
    right_px: Array


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """One view measured again; mm and px; ``scale``: measured over printed lengths.

    ``off_plane_mm`` (n,): height over the fitted plane, towards the cameras. ``epipolar_px`` (n,):
    signed distance from the epipolar line in the right picture, positive downwards. ``spacing_mm``
    (m,): neighbours' distances less the pitch.
    """

    name: str
    ids: Ids
    depth_mm: float
    scale: float
    spacing_mm: Array
    off_plane_mm: Array
    epipolar_px: Array


@dataclass(frozen=True, slots=True, eq=False)
class Remeasured:
    """All views of a board measured again with ``pair``."""

    board: Board
    views: tuple[Measured, ...]

    @property
    def scale(self) -> tuple[float, float]:
        """Mean over the views, and the standard deviation of that mean."""
        return _mean([view.scale for view in self.views])

    @property
    def grows_with_distance(self) -> bool:
        """Whether a scale error proportional to distance fits better than a constant one."""
        depth, off = (
            np.array(values)
            for values in zip(
                *((view.depth_mm, view.scale - 1.0) for view in self.views), strict=True
            )
        )
        proportional = off - depth * float(depth @ off) / float(depth @ depth)
        return float(np.sum(proportional**2)) < float(np.sum((off - off.mean()) ** 2))

    @property
    def epipolar(self) -> tuple[float, float]:
        """Mean signed row offset in px over the views, and its standard deviation."""
        return _mean([float(np.mean(view.epipolar_px)) for view in self.views])

    @property
    def epipolar_rms_px(self) -> float:
        return float(
            np.sqrt(np.mean(np.concatenate([view.epipolar_px for view in self.views]) ** 2))
        )

    @property
    def spacing_rms_mm(self) -> float:
        """Of the distances between neighbours from the pitch."""
        return float(
            np.sqrt(np.mean(np.concatenate([view.spacing_mm for view in self.views]) ** 2))
        )

    @property
    def flatness_rms_mm(self) -> float:
        return float(
            np.sqrt(np.mean(np.concatenate([view.off_plane_mm for view in self.views]) ** 2))
        )

    @property
    def bend(self) -> tuple[float, float]:
        """Height of the middle over the edge, mm, by a paraboloid over all views, and its sd."""
        return _mean([_bend_mm(self.board, view) for view in self.views])


def remeasure(pair: Pair, board: Board, views: Sequence[PairView]) -> Remeasured:
    """The board of each view in space. Raises ValueError where there is no view."""
    if not views:
        raise ValueError("there is no view of the board that both cameras saw")
    return Remeasured(board, tuple(_measured(pair, board, view) for view in views))


def _measured(pair: Pair, board: Board, view: PairView) -> Measured:
    points = triangulate(view.left_px, view.right_px, pair.left, pair.right, pair.right_from_left)[
        0
    ]
    printed = board.points_mm[view.ids]
    a, b = _neighbours(board, view.ids)
    spacing = np.linalg.norm(points[a] - points[b], axis=1)
    centred, centred_printed = points - points.mean(axis=0), printed - printed.mean(axis=0)
    scale = float(np.sqrt(np.sum(centred**2) / np.sum(centred_printed**2)))
    normal = np.linalg.svd(centred, full_matrices=False)[2][2]
    normal = normal if normal[2] < 0 else -normal
    return Measured(
        view.name,
        view.ids,
        float(points[:, 2].mean()),
        scale,
        spacing - board.pitch_mm,
        centred @ normal,
        epipolar_px(pair, view),
    )


def epipolar_px(pair: Pair, view: PairView) -> Array:
    """Signed distances (n,) px of right pixels from their epipolar lines, positive downwards.

    In the undistorted picture at the right camera's focal length. Hartley and Zisserman, 2nd ed.,
    section 9.6.
    """
    a = np.column_stack([pair.left.normalize(view.left_px), np.ones(len(view.left_px))])
    b = np.column_stack([pair.right.normalize(view.right_px), np.ones(len(view.right_px))])
    x, y, z = pair.right_from_left.T
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ pair.right_from_left.R
    lines = a @ essential.T
    lines *= np.where(lines[:, 1:2] < 0, -1.0, 1.0)
    return np.asarray(
        np.sum(lines * b, axis=1) / np.linalg.norm(lines[:, :2], axis=1) * pair.right.fc[1]
    )


def _neighbours(board: Board, ids: Ids) -> tuple[Ids, Ids]:
    """Rows of ``ids`` that are next to each other on the board, as two lists of places."""
    place = np.full(board.columns * board.rows, -1)
    place[ids] = np.arange(len(ids))
    grid = place.reshape(board.rows, board.columns)
    pairs = np.vstack([
        np.column_stack([grid[:, :-1].reshape(-1), grid[:, 1:].reshape(-1)]),
        np.column_stack([grid[:-1].reshape(-1), grid[1:].reshape(-1)]),
    ])  # fmt: skip
    both = pairs[(pairs >= 0).all(axis=1)]
    return both[:, 0], both[:, 1]


def _bend_mm(board: Board, view: Measured) -> float:
    printed = board.points_mm[view.ids, :2]
    half = 0.5 * np.array([board.columns - 1, board.rows - 1]) * board.pitch_mm
    x, y = ((printed - half) / np.linalg.norm(half)).T
    terms = np.column_stack([np.ones_like(x), x, y, x**2, x * y, y**2])
    found = np.linalg.lstsq(terms, view.off_plane_mm, rcond=None)[0]
    # at the corners x^2 + y^2 = 1; along the diagonal that bends most
    bends = np.linalg.eigvalsh(np.array([[found[3], found[4] / 2], [found[4] / 2, found[5]]]))
    return float(-bends[np.argmax(np.abs(bends))])


def _mean(values: Sequence[float]) -> tuple[float, float]:
    array = np.asarray(values)
    return float(array.mean()), (
        float(array.std(ddof=1) / np.sqrt(len(array))) if len(array) > 1 else float("nan")
    )
