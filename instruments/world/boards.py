"""Flat things with a pattern: calibration boards (chessboard, ChArUco, circles), panels, and
weaves.

What is dark on a board is a list of polygons, so each pixel's share of dark is an exact area. Dark
and light squares have a temperature each. `poses` holds a board all over the pictures, tilted to
every side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Literal

import cv2
import numpy as np

from instruments.world.objects import Warmth
from instruments.world.optics import CameraModel, Floats
from instruments.world.sensor import Image
from instruments.world.solids import Point, as_point

Kind = Literal["plain", "chessboard", "charuco", "circles"]
ROUND = 64  # corners of a circle
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@dataclass(frozen=True, slots=True)
class Pattern:
    """``columns`` x ``rows`` squares of ``square_mm``, the first dark, with a rim of ``margin_mm``.
    "charuco": markers of ``feature_mm`` in light squares; "plain": no dark squares; "circles" of
    ``feature_mm``, ``square_mm`` apart. ``feature_mm`` 0: three quarters or half a square. Raises
    ValueError.
    """

    kind: Kind = "chessboard"
    columns: int = 10
    rows: int = 7
    square_mm: float = 25.0
    margin_mm: float = 20.0
    dictionary: int = cv2.aruco.DICT_4X4_100
    feature_mm: float = 0.0

    def __post_init__(self) -> None:
        rim_fits = self.square_mm > 0.0 and self.margin_mm >= 0.0
        fits = rim_fits and 0.0 <= self.feature_mm <= self.square_mm
        if not (self.columns >= 1 and self.rows >= 1 and fits):
            raise ValueError(
                "a board's pattern needs squares with a size, and markers or circles that fit, is"
                f" {self}"
            )

    @property
    def feature_share(self) -> float:
        """Side of a marker, or diameter of a circle, as a share of a square's side."""
        usual = 0.5 if self.kind == "circles" else 0.75
        return self.feature_mm / self.square_mm or usual

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height with the rim."""
        rim = 2.0 * self.margin_mm
        return self.columns * self.square_mm + rim, self.rows * self.square_mm + rim

    @property
    def corners_mm(self) -> Floats:
        """Inner corners or circles' middles, row by row, (n, 2) mm from the first corner."""
        first, off = (0, 0.5) if self.kind == "circles" else (1, 0.0)
        u, v = np.meshgrid(np.arange(first, self.columns) + off, np.arange(first, self.rows) + off)
        return np.asarray(np.column_stack([u.ravel(), v.ravel()]) * self.square_mm + self.margin_mm)


@dataclass(frozen=True, slots=True)
class Board:
    """A board in the world: first corner, and unit vectors along width and height; across x along
    points away from the pattern's viewer. ``light_albedo``, ``dark_albedo``; temperatures in degC,
    "teat" or "ambient"; ``velocity_mm_s`` its own.
    """

    corner_mm: Point
    across: Point = (1.0, 0.0, 0.0)
    along: Point = (0.0, 0.0, -1.0)
    pattern: Pattern = Pattern()
    name: str = "board"
    light_albedo: float = 0.8
    dark_albedo: float = 0.05
    emissivity: float = 0.93
    light: Warmth = "ambient"
    dark: Warmth = "ambient"
    velocity_mm_s: Point = (0.0, 0.0, 0.0)

    @property
    def normal(self) -> Floats:
        """Towards who sees the pattern, (3,)."""
        return np.cross(self.along, self.across)

    @property
    def corners_mm(self) -> Floats:
        """The pattern's inner corners, row by row, world frame, (n, 3) mm."""
        return self.placed(self.pattern.corners_mm)

    @property
    def outline_mm(self) -> Floats:
        """The rectangle, world frame, (4, 3) mm."""
        return self.placed(SQUARE * self.pattern.size_mm)

    def placed(self, flat_mm: Floats) -> Floats:
        """Points on the board (..., 2) mm from its first corner, to world (..., 3) mm."""
        return np.asarray(
            np.asarray(self.corner_mm)
            + flat_mm[..., :1] * np.asarray(self.across)
            + flat_mm[..., 1:] * np.asarray(self.along)
        )

    def moved(self, seconds: float) -> Board:
        """Where it is that much later."""
        corner = np.asarray(self.corner_mm) + seconds * np.asarray(self.velocity_mm_s)
        return replace(self, corner_mm=as_point(corner))


@lru_cache(maxsize=16)
def dark_parts_mm(pattern: Pattern) -> tuple[Floats, ...]:
    """A board's dark polygons, each (m, 2) mm from its first corner, without overlaps."""
    if pattern.kind == "plain":
        return ()
    grid = np.meshgrid(np.arange(pattern.columns), np.arange(pattern.rows))
    places = np.column_stack([axis.ravel() for axis in grid]).astype(np.float64)
    dark = places.sum(axis=1) % 2 == 0
    if pattern.kind == "circles":
        # a polygon with the area of a circle of radius 1
        step = 2.0 * np.pi / ROUND
        angles = np.arange(ROUND) * 2.0 * np.pi / ROUND
        circle = np.column_stack([np.cos(angles), np.sin(angles)]) * np.sqrt(step / np.sin(step))
        cells = list(places[:, None, :] + 0.5 + 0.5 * pattern.feature_share * circle)
    else:
        cells = list(places[dark][:, None, :] + SQUARE)
    if pattern.kind == "charuco":
        markers = cv2.aruco.getPredefinedDictionary(pattern.dictionary)
        side, share = int(markers.markerSize) + 2, pattern.feature_share
        for number, at in enumerate(places[~dark]):
            bits = np.asarray(markers.generateImageMarker(number, side, borderBits=1))
            modules = np.argwhere(bits == 0)[:, None, ::-1] + SQUARE
            cells += list(at + (modules * share / side + (1.0 - share) / 2.0))
    return tuple(np.asarray(cell * pattern.square_mm + pattern.margin_mm) for cell in cells)


GRID = (4, 3)  # parts of the narrowest picture, one after the other
TILT_DEG, TURN_DEG = 40.0, 15.0
RIM_PX = 6.0
TABLE_FRONT_MM = -245.0  # before it a board may hang lower than the table
ATTEMPTS = 400


class NoPlaceError(ValueError):
    """A board fits nowhere into the view of all cameras."""


def poses(
    pattern: Pattern,
    cameras: Sequence[CameraModel],
    depths_mm: tuple[float, float],
    seed: int,
    count: int = 24,
) -> tuple[Board, ...]:
    """Boards in ``count`` random poses by ``seed``, at ``depths_mm`` (least, most), tilted up to 40
    degrees, turned up to 15; wholly in each camera's picture. Raises NoPlaceError.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    cameras = sorted(cameras, key=lambda camera: camera.width_px / float(camera.fc[0]))
    camera, boards = cameras[0], list[Board]()
    size = np.array([camera.width_px, camera.height_px])
    for number in range(count):
        part = np.array([number % GRID[0], number // GRID[0] % GRID[1]])
        for attempt in range(ATTEMPTS):
            # A part that can't hold the board is given up half-way, in favour of any.
            share = (part + rng.random(2)) / GRID if attempt < ATTEMPTS / 2 else rng.random(2)
            plane = camera.plane_from_pixels((size * share)[None, :])[0]
            middle = camera.R.T @ (np.array([*plane, 1.0]) * rng.uniform(*depths_mm) - camera.t_mm)
            most = np.array([TILT_DEG, TURN_DEG, TILT_DEG])
            turn = cv2.Rodrigues(np.radians(rng.uniform(-most, most)))[0]
            across, along = turn @ camera.R[0], turn @ camera.R[1]
            width, height = pattern.size_mm
            corner = middle - 0.5 * (width * across + height * along)
            board = Board(as_point(corner), as_point(across), as_point(along), pattern)
            outline = board.outline_mm
            # held over the table, or before it
            free = np.all((outline[:, 2] > 5.0) | (outline[:, 1] < TABLE_FRONT_MM))
            if free and all(_in_picture(board, one) for one in cameras):
                boards.append(board)
                break
        else:
            (wide, high), (near, far) = pattern.size_mm, depths_mm
            names = " and ".join(sorted(camera.name for camera in cameras))
            raise NoPlaceError(
                f"no place found for a board of {wide:g} x {high:g} mm, {near:g} to {far:g} mm off,"
                f" where {names} see all of it: take a smaller board, or hold it farther away"
            )
    return tuple(boards)


def _in_picture(board: Board, camera: CameraModel) -> bool:
    """Whether all of a board, with its squares, is in a picture; no where edge-on or averted."""
    towards = camera.centre_mm - board.outline_mm.mean(axis=0)
    if board.normal @ towards < 0.45 * np.linalg.norm(towards):
        return False
    around = 0.7 * board.pattern.square_mm * (2.0 * SQUARE - 1.0)
    squares = board.placed((board.pattern.corners_mm[:, None, :] + around).reshape(-1, 2))
    pixels = camera.project(squares)
    high = np.array([camera.width_px, camera.height_px]) - 1.0 - RIM_PX
    return bool(np.all((pixels >= RIM_PX) & (pixels <= high)))


Weave = Literal["cloud", "grain", "waves", "planks"]
CELLS_CLOUD = ((120, 0.5), (40, 0.3), (12, 0.2), (3, 0.15), (1, 0.12))
CELLS_GRAIN = ((12, 0.2), (3, 0.45), (1, 0.6))
COARSE_CELL = 40


@lru_cache(maxsize=8)
def woven(weave: Weave, seed: int, width: int, height: int) -> Image:
    """A texture of about -1 to 1, (height, width)."""
    rng = np.random.Generator(np.random.PCG64(seed))
    cloth = np.asarray(WEAVES[weave](rng, width, height), dtype=np.float32)
    return np.clip(cloth, -1.5, 1.5, out=cloth)


@lru_cache(maxsize=32)
def _cubic(points: int, size: int) -> Image:
    """Weight of each point in OpenCV's cubic resize to ``size`` pixels, (size, points)."""
    alone = np.eye(points, dtype=np.float32)
    blown = cv2.resize(alone, (points, size), interpolation=cv2.INTER_CUBIC)
    return np.asarray(blown, dtype=np.float32)


# OpenBLAS shares out larger products between threads, which spin while they wait for the next one:
# half of a scene's processor time where the other processors are busy.
PRODUCT_OF_ONE_THREAD = 250_000  # multiplications


def _product(left: Image, right: Image) -> Image:
    """The matrix product of (m, k) and (k, n), by one thread."""
    rows = max(PRODUCT_OF_ONE_THREAD // right.size, 1)
    product = np.empty((len(left), right.shape[1]), dtype=np.float32)
    for start in range(0, len(left), rows):
        np.matmul(left[start : start + rows], right, out=product[start : start + rows])
    return product


def _lattices(
    rng: np.random.Generator, width: int, height: int, cells: tuple[tuple[int, float], ...]
) -> Image:
    """Random lattices of several sizes, blown up smoothly and added."""
    cloth: Image | None = None
    for cell, weight in cells:
        lattice = rng.standard_normal((height // cell + 2, width // cell + 2), dtype=np.float32)
        if cell >= COARSE_CELL:  # as products, in a third of the time
            across = _product(lattice, _cubic(lattice.shape[1], width).T)
            smooth = _product(_cubic(lattice.shape[0], height), across)
        else:
            blown = cv2.resize(lattice, (width, height), interpolation=cv2.INTER_CUBIC)
            smooth = np.asarray(blown, dtype=np.float32)
        if cloth is None:
            cloth = np.asarray(smooth * np.float32(weight), dtype=np.float32)
        else:
            cv2.scaleAdd(smooth, weight, cloth, cloth)
    assert cloth is not None  # noqa: S101 - there is a size at least
    return cloth


def _waves(rng: np.random.Generator, width: int, height: int) -> Image:
    """Veins, as in stone: a wave whose phase is cloudy."""
    rows = np.arange(height, dtype=np.float32)[:, None]
    phase = rows * np.float32(2.0 * np.pi / rng.uniform(22.0, 45.0))
    phase = phase + np.float32(2.5) * _lattices(rng, width, height, ((160, 1.0), (50, 0.5)))
    return np.asarray(0.8 * np.sin(phase) + 0.5 * _lattices(rng, width, height, CELLS_GRAIN))


def _planks(rng: np.random.Generator, width: int, height: int) -> Image:
    """Long grain across, as in wood."""
    across = rng.standard_normal((height // 2 + 2, max(width // 80, 2)), dtype=np.float32)
    grain = cv2.resize(across, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(0.6 * grain + 0.4 * _lattices(rng, width, height, CELLS_CLOUD))


WEAVES: dict[Weave, Callable[[np.random.Generator, int, int], Image]] = {
    "cloud": partial(_lattices, cells=CELLS_CLOUD),
    "grain": partial(_lattices, cells=CELLS_GRAIN),
    "waves": _waves,
    "planks": _planks,
}
