"""Boards before small cameras, drawn by rays: no code of the project's renderer."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.calibration.boards import Board
from detector.geometry import Array, Camera, Motion

SIZE = (480, 360)
LEFT = Camera(SIZE, (455.0, 456.0), (238.0, 181.0), 0.0, (-0.19, 0.1, 0.0, 0.0, 0.0))
RIGHT = Camera(SIZE, (452.0, 453.0), (244.0, 177.0), 0.0, (-0.2, 0.12, 0.001, 0.0, 0.0))
RIGHT_FROM_LEFT = Motion.from_vectors([0.004, -0.02, 0.008], [-100.3, 0.4, 1.1])
THERMAL = Camera((320, 240), (610.0, 612.0), (158.0, 121.0))
THERMAL_FROM_LEFT = Motion.from_vectors([-0.01, -0.03, 0.01], [-50.0, 1.0, -4.0])
HEATED = Board("circles", 6, 4, 30.0, circle_mm=15.0)
HEATED_TOML = 'kind = "circles"\ncolumns = 6\nrows = 4\npitch_mm = 30.0\ncircle_mm = 15.0\n'
BOARD = Board("chessboard", 7, 5, 40.0)
BOARD_TOML = 'kind = "chessboard"\ncolumns = 7\nrows = 5\npitch_mm = 40.0\n'
SAMPLES = 4  # a side of a pixel


def poses(count: int, seed: int = 1, board: Board = BOARD, spread: float = 1.0) -> list[Motion]:
    """left_from_board: all over ``spread`` of the picture, tilted to every side in turn."""
    rng = np.random.default_rng(seed)
    found = []
    for at in range(count):
        tilt, way = np.radians(rng.uniform(18.0, 38.0)), 2 * np.pi * (at * 0.618 + 0.05)
        lean = Motion.from_vectors(tilt * np.array([np.cos(way), np.sin(way), 0.0]), np.zeros(3))
        R = lean.R @ Motion.from_vectors([0.0, 0.0, rng.uniform(-0.2, 0.2)], np.zeros(3)).R
        depth = rng.uniform(650.0, 1050.0)
        across, up = (spread * rng.uniform(-most, most) * depth for most in (0.22, 0.16))
        aim = np.array([across + 50.0, up, depth])
        found.append(Motion(R, aim - R @ board.points_mm.mean(axis=0)))
    return found


def picture(
    camera: Camera,
    camera_from_board: Motion,
    seed: int,
    *,
    pitch_mm: float = BOARD.pitch_mm,
    board: Board = BOARD,
    bend_mm: float = 0.0,
) -> NDArray[np.uint8]:
    """The board, printed at ``pitch_mm`` and bent by ``bend_mm``, on a grey wall, with noise."""
    height, width = camera.image_size[1], camera.image_size[0]
    flat, by_column, by_row = _undistorted(camera)
    board_from_camera = camera_from_board.inverse()

    def look(at: NDArray[np.bool_] | slice, dx: float, dy: float) -> Array:
        place = flat[at] + dx * by_column[at] + dy * by_row[at]
        return _brightness(place, board_from_camera, pitch_mm, board, bend_mm)

    middle = look(slice(None), 0.0, 0.0)
    around, three = middle.reshape(height, width), np.ones((3, 3), np.uint8)
    edge = (cv2.dilate(around, three) != cv2.erode(around, three)).ravel()
    offsets = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    middle[edge] = np.mean([look(edge, dx, dy) for dx in offsets for dy in offsets], axis=0)
    noisy = cv2.GaussianBlur(middle.reshape(height, width), (0, 0), 0.6) + np.random.default_rng(
        seed
    ).normal(0.0, 1.0, (height, width))
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@cache
def _undistorted(camera: Camera) -> tuple[Array, Array, Array]:
    """Each pixel's place (n, 2) on the plane before the camera, and how it goes on by a column and
    by a row: straight within a pixel.
    """
    K = np.array([[camera.fc[0], 0, camera.cc[0]], [0, camera.fc[1], camera.cc[1]], [0, 0, 1.0]])
    rows, columns = np.mgrid[0 : camera.image_size[1], 0 : camera.image_size[0]].astype(np.float64)
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).reshape(-1, 1, 2)
    flat = np.asarray(
        cv2.undistortPoints(pixels, K, np.array(camera.kc)).reshape(-1, 2), dtype=np.float64
    )
    by_row, by_column = np.gradient(flat.reshape(*rows.shape, 2), axis=(0, 1))
    return flat, by_column.reshape(-1, 2), by_row.reshape(-1, 2)


def _brightness(
    flat: Array, board_from_camera: Motion, pitch_mm: float, board: Board, bend_mm: float
) -> Array:
    rays = np.column_stack([flat, np.ones(len(flat))]) @ board_from_camera.R.T
    at = board_from_camera.T[:2] - rays[:, :2] * (board_from_camera.T[2] / rays[:, 2])[:, None]
    middle = board.points_mm[:, :2].mean(axis=0)
    # where the ray meets the bowl, from where it met the plane
    for _ in range(3 if bend_mm else 0):
        height = bend_mm * np.sum((at - middle) ** 2, axis=1) / float(middle @ middle)
        way = (board_from_camera.T[2] - np.clip(height, 0, 3 * bend_mm)) / rays[:, 2]
        at = board_from_camera.T[:2] - rays[:, :2] * way[:, None]
    x, y = (at / pitch_mm + 1.0).T
    columns, rows = board.columns + 1, board.rows + 1
    paper = (x > -0.6) & (y > -0.6) & (x < columns + 0.6) & (y < rows + 0.6)
    if board.circle_mm is not None:
        off_x = x - np.clip(np.rint(x), 1, board.columns)
        off_y = y - np.clip(np.rint(y), 1, board.rows)
        black = np.hypot(off_x, off_y) < board.circle_mm / 2 / board.pitch_mm
    else:
        printed = (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
        black = printed & ((np.floor(x) + np.floor(y)) % 2 == 0)
    return np.where(black, 35.0, np.where(paper, 205.0, 120.0))


def write_pairs(
    folder: Path,
    count: int,
    *,
    seed: int = 1,
    pitch_mm: float = BOARD.pitch_mm,
    bend_mm: float = 0.0,
) -> Path:
    """``count`` pairs of pictures as left/NN.png and right/NN.png."""
    for number, pose in enumerate(poses(count, seed)):
        for name, camera, seen in (("left", LEFT, pose), ("right", RIGHT, RIGHT_FROM_LEFT @ pose)):
            image = picture(camera, seen, 100 * seed + number, pitch_mm=pitch_mm, bend_mm=bend_mm)
            write_image(folder / name / f"{number:02d}.png", image)
    return folder


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
