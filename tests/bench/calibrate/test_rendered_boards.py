"""Boards before the emulated cameras, rendered, found and calibrated: what was put in comes back
within what is claimed, weekly over twenty seeds.

The emulated rig's own cameras and sensors at half their size in pixels. Corners miss by noise and
by what the corner finder makes of a picture; both are new with every pose. A chi-square over all parameters says whether the stated covariance is right, no more
and no less.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy

from bench.calibrate.views import pattern_of
from detector.calibration import dump_calibration
from detector.calibration.boards import Board
from detector.calibration.cameras import BoardView, CameraFit, calibrate_camera, join_cameras
from detector.calibration.corners import ViewRefusedError, find_board
from instruments.world.boards import poses
from instruments.world.phantom import Phantom
from instruments.world.scene import Renderer
from instruments.world.state import SceneState
from tests.bench.calibrate.small_rig import small_calibration
from tests.detector.boards_seen import missed

pytestmark = pytest.mark.weekly

SEEDS, VIEWS = 20, 8
BOARD = Board("chessboard", 9, 6, 40.0)
DEPTHS_MM = (500.0, 1200.0)


def rendered_views(table: Mapping[str, Any], seed: int) -> dict[str, list[BoardView]]:
    """Boards in new poses, found by cameras with patterns and noise of their own."""
    renderer = Renderer.from_calibration(table, seed)
    views: dict[str, list[BoardView]] = {"left": [], "right": []}
    for number, board in enumerate(
        poses(pattern_of(BOARD), renderer.cameras[:2], DEPTHS_MM, seed, VIEWS)
    ):
        state, rng = (
            SceneState(Phantom(()), (), 20.0, 20.0, boards=(board,)),
            np.random.default_rng([seed, number]),
        )
        for name, camera in (("left", renderer.left), ("right", renderer.right)):
            try:
                found = find_board(camera.expose(state, None, rng).astype(np.uint8), BOARD)
            except ViewRefusedError:
                continue
            views[name].append(BoardView(str(number), BOARD.points_mm[found.ids], found.pixels_px))
    return views


def calibrated(views: Mapping[str, list[BoardView]], size: tuple[int, int]) -> CameraFit:
    alone = {name: calibrate_camera(name, seen, size) for name, seen in views.items()}
    return join_cameras(alone, joint_lenses=("left", "right"))


def test_what_was_put_in_is_missed_by_what_the_covariance_says() -> None:
    rig = small_calibration()
    table = tomllib.loads(dump_calibration(replace(rig.part, homographies=None)))
    size = rig.left.image_size
    found = [calibrated(rendered_views(table, seed), size) for seed in range(SEEDS)]
    seen = [(missed(one, rig), one.fit.covariance) for one in found]
    off = np.array([miss / np.sqrt(np.diag(covariance)) for miss, covariance in seen])
    assert off.shape == (SEEDS, 22)
    assert np.mean(np.abs(off) > 2.0) <= 0.0455, "of a normal distribution"
    assert np.abs(off.mean(axis=0)).max() * np.sqrt(SEEDS) < 3.5, (
        "of 22 means one beyond 3.5 comes once in a hundred times"
    )
    distances = [float(miss @ np.linalg.solve(covariance, miss)) for miss, covariance in seen]
    freedom = 22 * SEEDS
    low, high = scipy.stats.chi2.ppf([0.001, 0.999], freedom)
    assert low < sum(distances) < high, (
        f"{sum(distances) / freedom:.2f} a degree of freedom, 1 is expected"
    )
    assert max(distances) < scipy.stats.chi2.ppf(1.0 - 0.001 / SEEDS, 22)
