"""Where somebody holds a calibration board before cameras: places all over the pictures, tilted to every side.

May not know what is printed on a board, nor who calibrates.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from instruments.world.boards import Board, Pattern
from instruments.world.optics import CameraModel, Floats
from instruments.world.solids import Point

GRID = (4, 3)  # parts of the narrowest picture, one after the other
TILT_DEG, TURN_DEG = 40.0, 15.0
RIM_PX = 6.0
TABLE_FRONT_MM = -245.0  # before it a board may hang lower than the table
ATTEMPTS = 400


def poses(
    pattern: Pattern, cameras: Sequence[CameraModel], depths_mm: tuple[float, float], seed: int, count: int = 24, *, seen: float = 1.0
) -> tuple[Board, ...]:
    """Boards in ``count`` poses, drawn anew for each ``seed``: all over the narrowest view, ``depths_mm`` (least, most) away.

    Every camera sees at least the share ``seen`` of the points. Tilted up to 40 degrees about the board's own axes, turned up to 15.
    Raises ValueError where no such pose is found, as for a board too large for the narrowest view.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    cameras = sorted(cameras, key=lambda camera: camera.width_px / float(camera.fc[0]))
    boards = []
    for number in range(count):
        part = np.array([number % GRID[0], number // GRID[0] % GRID[1]])
        board = _held(pattern, cameras, depths_mm, rng, part, seen)
        if board is None:
            raise ValueError(
                f"no place found for a board of {pattern.size_mm} mm at {depths_mm} mm where {', '.join(c.name for c in cameras)} "
                f"see {seen:.0%} of it: take a smaller board, or hold it farther away"
            )
        boards.append(board)
    return tuple(boards)


def _held(
    pattern: Pattern, cameras: Sequence[CameraModel], depths_mm: tuple[float, float], rng: np.random.Generator, part: Floats, seen: float
) -> Board | None:
    camera = cameras[0]
    size = np.array([camera.width_px, camera.height_px])
    for attempt in range(ATTEMPTS):
        # A part that can't hold the board is given up half-way, in favour of any.
        aim = size * ((part + rng.random(2)) / GRID if attempt < ATTEMPTS / 2 else rng.random(2))
        ray = np.array([*camera.plane_from_pixels(aim[None, :])[0], 1.0]) * rng.uniform(*depths_mm)
        middle = camera.R.T @ (ray - camera.t_mm)
        angles = np.radians(rng.uniform([-TILT_DEG, -TURN_DEG, -TILT_DEG], [TILT_DEG, TURN_DEG, TILT_DEG]))
        turn = cv2.Rodrigues(angles)[0]
        across, along = turn @ camera.R[0], turn @ camera.R[1]
        width, height = pattern.size_mm
        corner = middle - 0.5 * (width * across + height * along)
        board = Board(_point(corner), _point(across), _point(along), pattern, name="board")
        if _free(board) and all(_seen(board, one) >= seen for one in cameras):
            return board
    return None


def _free(board: Board) -> bool:
    """Whether the board is held over the table, or before it."""
    outline = board.outline_mm
    return bool(np.all((outline[:, 2] > 5.0) | (outline[:, 1] < TABLE_FRONT_MM)))


def _seen(board: Board, camera: CameraModel) -> float:
    """Share of a board's points, with the squares around them, in a camera's picture; 0 where it is edge-on or turned away."""
    towards = camera.centre_mm - board.outline_mm.mean(axis=0)
    if board.normal @ towards < 0.45 * np.linalg.norm(towards):
        return 0.0
    around = 0.7 * board.pattern.square_mm * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
    squares = board.placed((board.pattern.corners_mm[:, None, :] + around).reshape(-1, 2))
    pixels = camera.project(squares)
    high = np.array([camera.width_px, camera.height_px]) - 1.0 - RIM_PX
    inside = np.all((pixels >= RIM_PX) & (pixels <= high), axis=1).reshape(-1, 4)
    return float(inside.all(axis=1).mean())


def _point(vector: Floats) -> Point:
    return float(vector[0]), float(vector[1]), float(vector[2])
