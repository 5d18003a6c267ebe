"""Finds a board's points in a picture to a fraction of a pixel, or says what is wrong with it.

The sub-pixel window never reaches the next corner; colours tell the first point where they can;
blur is refused by the width of edges. A stray corner shows against its neighbours in row and
column.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.calibration.boards import Board
from detector.geometry import Array, homogeneous

STRAY = 0.25  # of the distance between corners
_DOUBTFUL = 0.08  # the same, of one that is looked for where its neighbours have it


def between_neighbours(grid_px: NDArray[Any]) -> Array:
    """Expected corners (rows, columns, 2) by the neighbours; three or more each way."""
    text: list[Array] = []
    for axis in (0, 1):
        along = np.moveaxis(np.asarray(grid_px, dtype=np.float64), axis, 0)
        padded = np.pad(along, [(2, 2), (0, 0), (0, 0)], constant_values=np.nan)
        before, last, following, after = padded[:-4], padded[1:-3], padded[3:-1], padded[4:]
        ways = (0.5 * (last + following), 2.0 * last - before, 2.0 * following - after)
        text += [np.moveaxis(way, 0, axis) for way in ways]
    return np.asarray(np.nanmedian(text, axis=0))


def strays(grid_px: NDArray[Any]) -> NDArray[np.bool_]:
    """Which corners of (rows, columns, 2) are off by more than `STRAY`, (rows, columns)."""
    return _off(grid_px) > STRAY


def _off(grid_px: NDArray[Any]) -> Array:
    """How far corners (rows, columns, 2) are from where their neighbours have them, in steps."""
    steps = [np.linalg.norm(np.diff(grid_px, axis=axis), axis=2) for axis in (0, 1)]
    usual = float(min(np.median(step) for step in steps))
    return np.asarray(np.linalg.norm(grid_px - between_neighbours(grid_px), axis=2) / usual)


Gray = NDArray[np.uint8]
LARGEST_WINDOW_PX = 11  # half of the sub-pixel window's side
SMALLEST_WINDOW_PX = 2
REACH = 0.3  # of the least distance between corners, to each side of one: its edges alone are there
_MOST_ASTRAY = 8  # corners that are put into their places
_RIM = 0.2  # squares beyond the outer squares, where the rim is looked at
_AS_DARK = 0.15  # of the squares' contrast: a rim no lighter than this is dark
NO_EDGES_PX = 9999.0  # OpenCV's, where none could be measured
BLURRED_PX = 5.0  # width of an edge from 10 to 90 %: sharp pictures have 2 to 3
MOVED_RATIO = 1.8  # edges across one direction this much wider than across the other
LEAST_CHARUCO = 8  # points of a partly hidden board that make a view
# of the picture's width: the neighbourhoods that a circle may be darker than
AROUND = (0.02, 0.04, 0.08)
LEAST_STEP = 0.06  # of the picture's range, by which it is
LEAST_FILL = 0.5  # of a circle's box
MOST_OBLONG = 4.0  # the longer side of that box over the shorter
MOST_UNLIKE = 3.0  # one circle's area over another's
MOST_BLOBS = 4  # times the board's circles: more is texture


@dataclass(frozen=True, slots=True)
class SubPixel:
    """Half the window's side (None: the largest safe one), and when to stop."""

    window_px: int | None = None
    steps: int = 60
    epsilon_px: float = 0.001

    def refine(
        self, image: Gray, corners: NDArray[Any], grid_px: NDArray[Any], reach: float = REACH
    ) -> tuple[NDArray[Any], int]:
        """Refined corners (n, 1, 2) and the window; ``grid_px`` (rows, columns, 2), NaN if hidden.
        ``reach``: the window's part of the least distance between corners, on each side.
        """
        steps = [np.linalg.norm(np.diff(grid_px, axis=axis), axis=2) for axis in (0, 1)]
        least = min(float(np.nanmin(step)) for step in steps if np.isfinite(step).any())
        largest = int(np.clip(reach * least, SMALLEST_WINDOW_PX, LARGEST_WINDOW_PX))
        window = self.window_px or largest
        until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, self.steps, self.epsilon_px)
        return cv2.cornerSubPix(image, corners, (window, window), (-1, -1), until), window


class ViewRefusedError(ValueError):
    """A picture that can't be used; the reason as a sentence."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectedBoard:
    """``ids`` (n,) at ``pixels_px`` (n, 2); ``edges_px``: 10 to 90 % of the rise along rows and
    columns, None if not measurable; ``window_px``: half the sub-pixel window's side.
    """

    ids: NDArray[np.intp]
    pixels_px: Array
    edges_px: tuple[float, float] | None
    window_px: int

    def turned(self, board: Board) -> DetectedBoard:
        """The same points counted from the board's other end."""
        return replace(self, ids=np.asarray(board.columns * board.rows - 1 - self.ids))


def find_board(image: Gray, board: Board, *, sub_pixel: SubPixel = SubPixel()) -> DetectedBoard:
    """The board in an 8-bit picture, dark or bright. Raises ViewRefusedError."""
    if image.ndim != 2 or image.dtype != np.uint8:
        kind = f"{image.dtype} of shape {image.shape}"
        raise ValueError(f"find_board wants an 8-bit grey picture, not {kind}")
    finder = {"chessboard": _chessboard, "charuco": _charuco, "circles": _circles}[board.kind]
    for picture in (image, np.asarray(255 - image, dtype=np.uint8)):  # a heated board is bright
        if found := finder(picture, board, sub_pixel):
            better, worse = sorted(found.edges_px or (0.0, 0.0))
            wide = f"edges are {worse:.1f} px wide"
            if worse > BLURRED_PX and worse > MOVED_RATIO * better:
                other = f"along one direction, {better:.1f} px along the other"
                raise ViewRefusedError(f"the board moved: {wide} {other}")
            if worse > BLURRED_PX:
                hint = f"at most {BLURRED_PX:g} px are of use; focus, or hold it still"
                raise ViewRefusedError(f"blurred: {wide}, {hint}")
            return found
    what = f"no {board.columns} x {board.rows} {board.kind} found"
    raise ViewRefusedError(f"{what}: is the whole board in the picture, sharp and lit?")


def counted_corners(image: Gray) -> tuple[int, int] | None:
    """Columns and rows of inner corners of whatever chessboard is in a picture; None for none."""
    flags = cv2.CALIB_CB_LARGER + cv2.CALIB_CB_EXHAUSTIVE
    for picture in _half_and_whole(image):
        done, _, squares = cv2.findChessboardCornersSBWithMeta(picture, (3, 3), flags)
        rows, columns = squares.shape[:2] if done else (0, 0)
        if columns * rows > 9:  # 3 x 3: a part of one
            return columns, rows
    return None


def _half_and_whole(image: Gray) -> Iterator[Gray]:
    """At half the size a board is found in a quarter of the time, unless squares are too small."""
    half = image.shape[1] // 2, image.shape[0] // 2
    yield np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    yield image


def order_alike(first: DetectedBoard, second: DetectedBoard, board: Board) -> DetectedBoard:
    """``second`` counted from ``first``'s end; the cameras differ by less than a right angle."""
    if not board.reads_the_same_turned:
        return second
    one, other = (
        np.linalg.lstsq(homogeneous(board.points_mm[found.ids, :2]), found.pixels_px, rcond=None)[0]
        for found in (first, second)
    )
    return second if float(one[0] @ other[0]) >= 0.0 else second.turned(board)


def _chessboard(image: Gray, board: Board, sub_pixel: SubPixel) -> DetectedBoard | None:
    shape, grid = (board.columns, board.rows), (board.rows, board.columns, 2)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE
    for picture in _half_and_whole(image):
        done, corners = cv2.findChessboardCorners(picture, shape, flags=flags)
        if not done:
            continue
        scale = np.array(image.shape[::-1]) / picture.shape[::-1]  # pixels' middles are whole
        coarse = _in_their_places((corners + 0.5) * scale - 0.5, grid)
        fine, window = sub_pixel.refine(image, coarse.copy(), coarse.reshape(grid))
        placed = fine.reshape(grid)
        astray, moved_px = strays(placed), np.abs(fine - coarse).max()
        rim = _rim(image, placed)
        if picture is image or (rim > 0.5 and not astray.any() and moved_px <= 0.5 * window):
            break
    else:
        return None
    if astray.any():  # again from where the refined ones have them
        seeds = _in_their_places(fine, grid)
        fine, window = sub_pixel.refine(image, seeds.copy(), seeds.reshape(grid))
        astray = strays(fine.reshape(grid))
    if lost := int(astray.sum()):
        what = f"{lost} corners lie beside their places among the others"
        raise ViewRefusedError(f"{what}: does something cover the board, or glare?")
    pixels = np.asarray(fine.reshape(-1, 2), dtype=np.float64)
    dark_first = rim > _AS_DARK  # else it is light on dark, which the finder takes too
    if not board.reads_the_same_turned and (
        _dark_before_first(image, pixels.reshape(grid)) != dark_first
    ):
        pixels = pixels[::-1].copy()
    along, across = (
        float(np.ravel(cv2.estimateChessboardSharpness(image, shape, fine, 0.8, vertical)[0])[0])
        for vertical in (False, True)
    )
    edges_px = (along, across) if max(along, across) < NO_EDGES_PX else None
    return DetectedBoard(np.arange(len(pixels)), pixels, edges_px, window)


def _in_their_places(corners: NDArray[Any], grid: tuple[int, ...]) -> NDArray[np.float32]:
    """Rough corners (n, 1, 2): OpenCV's finder may leave one beside its place, on an edge, along
    which no window finds back.
    """
    placed = corners.reshape(grid).astype(np.float32)
    for _ in range(_MOST_ASTRAY):  # the worst first: it makes its neighbours look astray
        off = _off(placed)
        worst = np.unravel_index(off.argmax(), off.shape)
        if off[worst] <= _DOUBTFUL:
            break
        placed[worst] = between_neighbours(placed)[worst]
    return placed.reshape(-1, 1, 2)


def _charuco(image: Gray, board: Board, sub_pixel: SubPixel) -> DetectedBoard | None:
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board.aruco).detectBoard(image)
    if ids is None or len(ids) < LEAST_CHARUCO:
        return None
    numbers = ids.reshape(-1).astype(np.intp)
    grid = np.full((board.rows, board.columns, 2), np.nan)
    grid.reshape(-1, 2)[numbers] = corners.reshape(-1, 2)
    # the marker's corner must stay out of the window too
    reach = min(REACH, 0.5 * (1.0 - (board.marker_mm or 0.0) / board.pitch_mm))
    fine, window = sub_pixel.refine(image, corners.reshape(-1, 1, 2).copy(), grid, reach)
    return DetectedBoard(numbers, np.asarray(fine.reshape(-1, 2), dtype=np.float64), None, window)


def _circles(image: Gray, board: Board, _: SubPixel) -> DetectedBoard | None:
    """Dark blobs in OpenCV's grid finder, whose own detector needs 8 px; by two thresholds."""
    dark = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU)[1]
    low, high = np.percentile(image, [1.0, 99.0])
    how, step = (cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV), LEAST_STEP * (high - low)
    for share in (None, *AROUND):
        if share is not None:
            side = int(share * image.shape[1]) | 1
            dark = cv2.adaptiveThreshold(image, 255, *how, side, float(step))
        if (pixels := _grid_of_blobs(image, dark, board)) is not None:
            return DetectedBoard(np.arange(len(pixels)), pixels, None, 0)
    return None


def _grid_of_blobs(image: Gray, dark: NDArray[Any], board: Board) -> Array | None:
    """Circles (n, 2) px in the print's order; None where the blobs make no grid."""
    labels, stats = cv2.connectedComponentsWithStats(dark)[1:3]
    wanted = board.columns * board.rows
    left, top, width, height, area = stats.T
    # a circle's size and shape, clear of the picture's border
    longer, shorter = np.maximum(width, height), np.minimum(width, height)
    alike = (area >= 4) & (area <= image.size / (2.0 * wanted)) & (longer <= MOST_OBLONG * shorter)
    alike &= area >= LEAST_FILL * width * height
    alike &= (left > 0) & (left + width < image.shape[1])
    alike &= (top > 0) & (top + height < image.shape[0])
    alike[0] = False
    if np.count_nonzero(alike) < wanted:
        return None
    # specks are smaller and many; one circle is not much larger than another
    usual = float(np.sort(area[alike])[::-1][wanted // 2])
    alike &= (usual / MOST_UNLIKE < area) & (area < usual * MOST_UNLIKE)
    blobs = np.flatnonzero(alike)
    if not wanted <= len(blobs) <= MOST_BLOBS * wanted:
        return None
    centres = np.array([_centre(image, labels, stats[n], n) for n in blobs.tolist()], np.float32)
    shape, settings = (board.columns, board.rows), cv2.CirclesGridFinderParameters()
    # The manual allows None with points in place of a picture; OpenCV's type stubs don't.
    done, ordered = cv2.findCirclesGrid(  # type: ignore[call-overload]
        centres[:, None], shape, cv2.CALIB_CB_SYMMETRIC_GRID, None, settings
    )
    return np.asarray(ordered.reshape(-1, 2), dtype=np.float64) if done else None


def _centre(
    image: Gray, labels: NDArray[Any], box: NDArray[Any], number: int
) -> tuple[float, float]:
    """Centre of gravity of a blob's darkness, with its grey rim."""
    left, top, width, height = (int(v) for v in box[:4])
    rows, columns = slice(top - 1, top + height + 1), slice(left - 1, left + width + 1)
    part = image[rows, columns].astype(np.float64)
    blob = (labels[rows, columns] == number).astype(np.uint8)
    own = cv2.dilate(blob, np.ones((3, 3), np.uint8)) > 0
    weight = np.where(own, part[own].max() - part, 0.0)
    y, x = np.mgrid[rows, columns]
    return float((weight * x).sum() / weight.sum()), float((weight * y).sum() / weight.sum())


def _rim(image: Gray, grid_px: NDArray[Any]) -> float:
    """How light the rim is: 0 as the dark squares, 1 as the light ones."""
    rows, columns = grid_px.shape[:2]
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    to_px = cv2.findHomography(
        np.column_stack([x.ravel(), y.ravel()]).astype(np.float64), grid_px.reshape(-1, 2)
    )[0]
    x, y = np.meshgrid(np.arange(-1, columns) + 0.5, np.arange(-1, rows) + 0.5)
    squares = np.column_stack([x.ravel(), y.ravel()])
    # just beyond the outer squares
    ring = [(u, v) for u in x[0] for v in (-1 - _RIM, rows + _RIM)]
    ring += [(u, v) for v in y[:, 0] for u in (-1 - _RIM, columns + _RIM)]
    values = []
    for points in (squares, np.array(ring)):
        places = np.rint(cv2.perspectiveTransform(points[None], to_px)[0]).astype(int)
        at = np.clip(places, 0, np.array(image.shape[::-1]) - 1)
        values.append(image[at[:, 1], at[:, 0]].astype(float))
    dark, light = np.percentile(values[0], [25, 75])
    return float((np.median(values[1]) - dark) / max(light - dark, 1.0))


def _dark_before_first(image: Gray, grid_px: Array) -> bool:
    """Whether the square diagonally outside of the first corner is dark, as printed."""
    first, right, down = grid_px[0, 0], grid_px[0, 1] - grid_px[0, 0], grid_px[1, 0] - grid_px[0, 0]
    diagonals = np.array([(-1, -1), (1, 1), (1, -1), (-1, 1)])
    places = np.rint(first + 0.5 * diagonals @ np.array([right, down])).astype(int)
    columns, rows = np.clip(places, 0, np.array(image.shape[::-1]) - 1).T
    values = image[rows, columns].astype(int)
    return bool(values[0] + values[1] < values[2] + values[3])
