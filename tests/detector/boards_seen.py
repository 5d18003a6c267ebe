"""Boards before known cameras: corners with noise, by OpenCV's own projection."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache

import cv2
import numpy as np

from bench.rig.loading import RIGS
from detector.calibration import Calibration, ParameterCovariance, load_calibration
from detector.calibration.boards import Board
from detector.calibration.bundle import LENS, POSE
from detector.calibration.cameras import (
    BoardView,
    CameraFit,
    calibrate_camera,
    join_cameras,
    pair_of,
)
from detector.calibration.diagnosis import PairView
from detector.calibration.rigid import WorldFit, fit_world
from detector.calibration.values import Pair
from detector.geometry import Array, Camera, Motion

BOARD = Board("chessboard", 9, 6, 40.0)
SMALL_BOARD = Board("chessboard", 9, 6, 15.0)
NOISE_PX = 0.1
# eighteen points on the table, mm
TOUCHED = np.array(
    [(x, y, z) for z in (40, 120) for x in (-300, -190, -80) for y in (150, 235, 320)], np.float64
)


def world_fit(
    pair: Pair,
    seed: int | None,
    covariance: ParameterCovariance | None = None,
    touched_mm: Array = TOUCHED,
) -> WorldFit:
    """By the eighteen points before the thesis's rig; pixels and touches noisy with a seed."""
    rng = np.random.default_rng([seed or 0, 5])
    noisy = [
        (part, 0.0 if seed is None else sd)
        for part, sd in zip(
            (*thesis_rig().project(TOUCHED), touched_mm), (NOISE_PX, NOISE_PX, 0.2), strict=True
        )
    ]
    points = (part + rng.normal(0.0, sd, part.shape) for part, sd in noisy)
    noise = {"pixel_sd_px": NOISE_PX, "touch_sd_mm": 0.2}
    return fit_world(pair, *points, pair_covariance=covariance, **noise)


Views = Mapping[str, list[BoardView]]


def alone_of(views: Views) -> dict[str, CameraFit]:
    size = thesis_rig().left.image_size
    return {name: calibrate_camera(name, views[name], size) for name in ("left", "right")}


def joined_of(views: Views) -> CameraFit:
    return join_cameras(alone_of(views), joint_lenses=("left", "right"))


@cache
def joined(seed: int) -> CameraFit:
    """A calibration of the thesis's pair."""
    return joined_of(seen(thesis_rig(), seed))


@cache
def thesis_rig() -> Calibration:
    return load_calibration(RIGS / "calibration.toml")


def poses(seed: int, count: int, board: Board, spread: float) -> list[Motion]:
    """left_from_board: over ``spread`` of the picture, up to 40 degrees tilted, 0.8 to 1.4 m off."""
    rng = np.random.default_rng([seed, 7])
    found = []
    for at in range(count):
        tilt = np.radians(rng.uniform(12.0, 40.0))
        way = 2 * np.pi * (at + rng.uniform()) / count * 3
        turn = np.radians(rng.uniform(-15, 15))
        R = (
            cv2.Rodrigues(tilt * np.array([np.cos(way), np.sin(way), 0.0]))[0]
            @ cv2.Rodrigues(np.array([0.0, 0.0, turn]))[0]
        )
        depth = rng.uniform(800.0, 1400.0)
        x, y = spread * rng.uniform(-0.28, 0.28) * depth, spread * rng.uniform(-0.2, 0.2) * depth
        aim = np.array([x + 50.0, y, depth])
        middle = board.points_mm.mean(axis=0)
        found.append(Motion(R, aim - R @ middle))
    return found


def project(camera: Camera, camera_from_board: Motion, board_mm: Array) -> Array:
    points, pose, kc = board_mm.reshape(-1, 1, 3), camera_from_board, np.array(camera.kc)
    seen = cv2.projectPoints(points, pose.om, pose.T, camera.matrix, kc)[0]
    return np.asarray(seen.reshape(-1, 2), dtype=np.float64)


def inside(camera: Camera, pixels_px: Array) -> bool:
    return bool((pixels_px > 2).all() and (pixels_px < np.array(camera.image_size) - 3).all())


def seen(
    rig: Calibration,
    seed: int,
    *,
    shape: Callable[[Array], Array] = lambda points: points,
    thermal: bool = False,
    count: int = 24,
) -> Mapping[str, list[BoardView]]:
    """Views by camera, with noise; ``shape`` bends the printed points into the real ones."""
    rng = np.random.default_rng([seed, 8])
    cameras = {"left": (rig.left, Motion.identity()), "right": (rig.right, rig.right_from_left)}
    if thermal and rig.thermal.lens and rig.thermal_from_left:
        cameras["thermal"] = (rig.thermal.lens, rig.thermal_from_left)
    board = SMALL_BOARD if thermal else BOARD
    views: dict[str, list[BoardView]] = {name: [] for name in cameras}
    for number, pose in enumerate(poses(seed, count, board, 0.15 if thermal else 1.0)):
        for name, (camera, motion) in cameras.items():
            pixels = project(camera, motion @ pose, shape(board.points_mm))
            if inside(camera, pixels):
                noisy = pixels + rng.normal(0.0, NOISE_PX, pixels.shape)
                views[name].append(BoardView(f"{number:02d}", board.points_mm, noisy))
    return views


def pair_views(views: Mapping[str, list[BoardView]]) -> list[PairView]:
    right = {view.name: view for view in views["right"]}
    ids = np.arange(len(BOARD.points_mm))
    return [
        PairView(v.name, ids, v.pixels_px, right[v.name].pixels_px)
        for v in views["left"]
        if v.name in right
    ]


def shifted(views: list[BoardView], by_px: tuple[float, float]) -> list[BoardView]:
    return [replace(view, pixels_px=view.pixels_px + np.array(by_px)) for view in views]


def missed(found: CameraFit, put_in: Pair) -> Array:
    """Found minus put in, by parameter in the order of the covariance."""
    pair, off = pair_of(found), dict[tuple[str, str], float]()
    for name, camera, known in (
        ("left", pair.left, put_in.left),
        ("right", pair.right, put_in.right),
    ):
        off |= {(name, p): v for p, v in zip(LENS, camera.lens - known.lens, strict=True)}
    got, was = ([*m.om, *m.T] for m in (pair.right_from_left, put_in.right_from_left))
    off |= {("right", p): v for p, v in zip(POSE, np.subtract(got, was), strict=True)}
    return np.array([off[name] for name in found.fit.names])
