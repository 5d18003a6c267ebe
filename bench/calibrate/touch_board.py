"""Points that both cameras see and the arm touches: nine of a board's at each of two positions,
asked for one by one.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.calibrate.capture import pattern_of, write_picture
from bench.calibrate.world import POINT_COLUMNS, TouchedPoints
from bench.files import write_synced
from bench.truth.arm_tip import TipReader
from detector.calibration.boards import Board
from detector.calibration.corners import Found, ViewRefusedError, find_board, order_alike
from detector.geometry import Array
from instruments.camera.frame import Grey
from instruments.errors import DeviceError
from instruments.microscribe.errors import ArmMovesError
from instruments.microscribe.stream import Reading
from instruments.operators.operator import BoardAsked, BoardTouch, Operator, Release

POSITIONS = 2
TRIES = 4  # of one position, or of one point, before it is given up
ROWS, COLUMNS = ("upper", "middle", "lower"), ("left", "middle", "right")
# of the pitch: touched distances that miss printed ones by more are another point's
MISTAKEN = 0.25
WHERE = ("high and near", "lower and farther, tilted another way")
POINTS_FILE = "points.csv"
COLOUR = (0, 200, 255)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A board that stays where it is, as both cameras saw it; ``corners`` are the nine points to be
    touched.
    """

    left: Found
    right: Found
    corners: tuple[int, ...]

    def pixels(self) -> tuple[Array, Array]:
        """The nine points in both pictures, (9, 2) each."""
        return _pixels(self.left, self.corners), _pixels(self.right, self.corners)


@dataclass(frozen=True, slots=True)
class Asking:
    """Who looks, who is asked, whose tip is read; ``tip_radius_mm`` is that of a ball tip, 0 for a
    point.
    """

    look: Callable[[], Mapping[str, Grey]]
    operator: Operator
    tip: TipReader
    tip_radius_mm: float
    tell: Callable[[str], None]


def gather_points(asking: Asking, board: Board, folder: Path) -> TouchedPoints:
    """All points; pictures with the nine numbered, and the points as a table, are kept in
    ``folder``.

    Raises OperatorAbort, DeviceError where a board is never found or a point never touched well,
    and as cameras and arm do.
    """
    parts = [_at_position(asking, board, position, folder) for position in range(1, POSITIONS + 1)]
    points = TouchedPoints(*(np.vstack(columns) for columns in zip(*parts, strict=True)))
    rows = np.hstack([points.left_px, points.right_px, points.touched_mm])
    table = io.BytesIO()
    np.savetxt(table, rows, "%.4f", ",", header=",".join(POINT_COLUMNS), comments="")
    write_synced(folder / POINTS_FILE, table.getvalue())
    return points


def nine(board: Board) -> tuple[int, ...]:
    """The points to be touched: corners, edges' middles and middle of the board."""
    rows, columns = (0, board.rows // 2, board.rows - 1), (0, board.columns // 2, board.columns - 1)
    return tuple(row * board.columns + column for row in rows for column in columns)


def _at_position(
    asking: Asking, board: Board, position: int, folder: Path
) -> tuple[Array, Array, Array]:
    seen = _fixed(asking, board, position, folder)
    readings: list[Reading] = []
    for at in range(len(seen.corners)):
        readings.append(_touched(asking, board, seen, at, readings))
    asking.operator.ask(Release())
    points = under_ball(
        [reading.tip_mm for reading in readings],
        [reading.axis for reading in readings],
        asking.tip_radius_mm,
    )
    return (*seen.pixels(), points)


def _fixed(asking: Asking, board: Board, position: int, folder: Path) -> Seen:
    """The board fixed at a place where both cameras see all of it."""
    again = ""
    for _ in range(TRIES):
        where = WHERE[(position - 1) % len(WHERE)]
        text = (
            f"{again}Position {position} of {POSITIONS}, {where}: fix the board where both cameras"
            " see all of it and the arm reaches all of it, so that a touch can't move it. Take"
            " hands and arm out of the pictures."
        )
        asking.operator.ask(BoardAsked(pattern_of(board), text, position, fixed=True))
        pictures = asking.look()
        try:
            seen = _looked(pictures, board)
        except ViewRefusedError as why:
            asking.tell(f"position {position}: refused: {why}")
            again = f"Not found ({why}) "
            continue
        for camera, found in (("left", seen.left), ("right", seen.right)):
            write_picture(folder / camera / f"position-{position}.png", pictures[camera])
            write_picture(
                folder / f"position-{position}-{camera}-numbered.png",
                _numbered(pictures[camera], found, seen.corners),
            )
        asking.tell(
            f"position {position}: found; the points to touch are numbered in"
            f" {folder / f'position-{position}-left-numbered.png'}"
        )
        return seen
    what = f"the board was not found at position {position}, {TRIES} times"
    raise DeviceError(
        "cameras",
        what,
        hint="See the pictures: is it sharp, lit, and the board that the file describes?",
    )


def _looked(pictures: Mapping[str, Grey], board: Board) -> Seen:
    left, right = (find_board(pictures[camera], board) for camera in ("left", "right"))
    right, corners = order_alike(left, right, board), nine(board)
    for camera, found in (("left", left), ("right", right)):
        if hidden := [str(at + 1) for at, corner in enumerate(corners) if corner not in found.ids]:
            raise ViewRefusedError(
                f"the {camera} camera does not see point {', '.join(hidden)} of the nine: show all"
                " of the board"
            )
    return Seen(left, right, corners)


def _touched(asking: Asking, board: Board, seen: Seen, at: int, before: list[Reading]) -> Reading:
    """One of the nine, read; asked for again where the arm moved, or where it was another point by
    its distances to those before.
    """
    which = f"{ROWS[at // 3]} {COLUMNS[at % 3]}"
    text = (
        f"Touch point {at + 1} of {len(seen.corners)}, the {which} one, with the tip and hold it"
        " still."
    )
    again = ""
    for _ in range(TRIES):
        asking.operator.ask(BoardTouch(seen.corners[at], text, again))
        try:
            reading = asking.tip.read()
        except ArmMovesError as moves:
            again = f"{moves} Touch it once more."
            continue
        again = _mistaken(board, seen.corners, at, reading, before)
        if not again:
            return reading
        asking.tell(again)
    raise DeviceError(
        "arm",
        f"point {at + 1} of the board was not touched well, {TRIES} times; the last one: {again}",
    )


def _mistaken(
    board: Board, corners: tuple[int, ...], at: int, reading: Reading, before: list[Reading]
) -> str:
    """Why a touch is not of the point asked for, or nothing: a distance to an earlier point that
    the print doesn't have.
    """
    for earlier, known in enumerate(before):
        printed = float(
            np.linalg.norm(board.points_mm[corners[at]] - board.points_mm[corners[earlier]])
        )
        touched = float(np.linalg.norm(reading.tip_mm - known.tip_mm))
        if abs(touched - printed) > MISTAKEN * board.pitch_mm:
            return (
                f"That lies {touched:.1f} mm from point {earlier + 1}, where the print has"
                f" {printed:.1f} mm: another point, or the board has moved. Once more."
            )
    return ""


def under_ball(centres_mm: list[Array], axes: list[Array], radius_mm: float) -> Array:
    """Points (n, 3) of a plane that a ball tip touched, from the ball's centres and the stylus's
    axes (3,), which point away from it.
    """
    points = np.array(centres_mm, dtype=np.float64)
    normal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    side = 1.0 if float(np.mean(axes, axis=0) @ normal) > 0 else -1.0
    return np.asarray(points - radius_mm * side * normal)


def _numbered(picture: Grey, found: Found, corners: tuple[int, ...]) -> NDArray[np.uint8]:
    image = np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    for number, (x, y) in enumerate(np.rint(_pixels(found, corners)).astype(int).tolist(), 1):
        cv2.circle(image, (x, y), 8, COLOUR, 2, cv2.LINE_AA)
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(image, str(number), (x + 10, y - 8), font, 0.8, COLOUR, 2, cv2.LINE_AA)
    return image


def _pixels(found: Found, corners: tuple[int, ...]) -> Array:
    """The points named ``corners`` in a picture, (n, 2)."""
    return found.pixels_px[[int(np.flatnonzero(found.ids == corner)[0]) for corner in corners]]
