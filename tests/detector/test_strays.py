"""Corners beside their places are told by their neighbours; lens
and tilt are not mistaken for it.
"""

from __future__ import annotations

import numpy as np
import pytest

from detector.calibration.boards import Board
from detector.calibration.corners import between_neighbours, strays
from detector.geometry import Array, Camera, Motion

BOARD = Board("chessboard", 9, 6, 40.0)
WIDE = Camera((1360, 1024), (800.0, 800.0), (680.0, 512.0), 0.0, (-0.3, 0.1, 0.0, 0.0, 0.0))


def seen(om: list[float], distance_mm: float = 420.0) -> Array:
    pose = Motion.from_vectors(om, [-160.0, -100.0, distance_mm])
    return WIDE.project(pose.apply(BOARD.points_mm)).reshape(6, 9, 2)


@pytest.mark.parametrize(
    "om", [[0.0, 0.0, 0.0], [0.0, 0.7, 0.0], [-0.7, 0.0, 0.2], [0.4, 0.5, 0.0]]
)
def test_a_wide_lens_and_a_strong_tilt_make_none(om: list[float]) -> None:
    assert not strays(seen(om)).any()


@pytest.mark.parametrize("at", [(0, 0), (0, 4), (3, 8), (2, 5), (5, 0)])
def test_one_beside_its_place_is_told_and_its_neighbours_are_not(at: tuple[int, int]) -> None:
    grid = seen([0.3, -0.3, 0.1])
    beside = grid.copy()
    beside[at] += (15.0, -21.0)
    assert np.argwhere(strays(beside)).tolist() == [list(at)]
    assert np.linalg.norm(between_neighbours(beside)[at] - grid[at]) < 6.0, (
        "near enough for a sub-pixel window"
    )
