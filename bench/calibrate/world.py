"""Points that both cameras see and the arm touches: gathered on a board (nine at each of two
positions) or read from a table; the camera's pose in the world from them, or whether an existing
calibration still holds.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.special import chdtri

from bench.calibrate.merge import pair_of_part
from bench.calibrate.views import pattern_of, write_picture
from bench.config import ConfigError, read_text, write_file
from bench.rig.arm_files import axes_of
from bench.rig.reconnecting import is_loss
from bench.truth.touching import TipReader, same_place_mm
from detector.calibration import Part, Record
from detector.calibration.boards import Board
from detector.calibration.corners import ViewRefusedError, find_board, order_alike
from detector.calibration.diagnosis import Finding, against_the_arm
from detector.calibration.rigid import WorldFit, fit_world
from detector.calibration.values import covariance_of_points
from detector.geometry import Array
from instruments.camera.frame import Grey
from instruments.errors import DeviceError, InstrumentError, TouchAgainError
from instruments.microscribe.driver import Reading
from instruments.operators.operator import BoardPose, BoardTouch, Operator, Release
from textfiles import tables


def read_table(path: Path | str, columns: tuple[str, ...]) -> Mapping[str, Array]:
    """Columns of numbers under a first line of names. Raises ConfigError with the line."""
    try:
        found = tables.read_table(read_text(Path(path)), columns)
        rows = [[row.number(name) for name in columns] for row in found.rows]
    except tables.TableError as error:
        raise ConfigError.plain(f"{path}:{error.line}: {error}") from error
    table = np.array(rows, dtype=np.float64).reshape(-1, len(columns))
    return dict(zip(columns, table.T, strict=True))


SIGNIFICANT = 1e-4  # of a chance to accuse a calibration that holds
MOVED_MATTERS_MM = 1.0
SCATTER_MATTERS = 2.0  # times what is expected
POINT_COLUMNS = ("left_x", "left_y", "right_x", "right_y", "x_mm", "y_mm", "z_mm")
LEAST_POINTS = 4  # three fix the pose and leave nothing to see by whether it is right


@dataclass(frozen=True, slots=True, eq=False)
class TouchedPoints:
    """Points (n, 2) px in each camera, and touched (n, 3) mm in the world frame."""

    left_px: Array
    right_px: Array
    touched_mm: Array


@dataclass(frozen=True, slots=True, eq=False)
class WorldResult:
    """The fit, and what it shows of the pair."""

    fit: WorldFit
    findings: tuple[Finding, ...]

    def part(self, record: Record) -> Part:
        fit = self.fit
        return Part(world_from_right=fit.world_from_right, covariance=fit.covariance, record=record)


def read_points(path: Path | str) -> TouchedPoints:
    """Touched points from a table (`POINT_COLUMNS`). Raises ConfigError with the line."""
    table = read_table(path, POINT_COLUMNS)
    left, right, touched = (
        np.column_stack([table[name] for name in names])
        for names in (POINT_COLUMNS[:2], POINT_COLUMNS[2:4], POINT_COLUMNS[4:])
    )
    return TouchedPoints(left, right, touched)


def calibrate_world(
    points: TouchedPoints, cameras: Part, *, pixel_sd_px: float, touch_sd_mm: float
) -> WorldResult:
    """The world's pose. Raises ConfigError for points that don't determine it, or no pair."""
    pair = pair_of_part(cameras)
    if len(points.touched_mm) < LEAST_POINTS:
        raise ConfigError.plain(
            f"{len(points.touched_mm)} touched points are too few: at least {LEAST_POINTS}, 18 at"
            " two heights are good"
        )
    try:
        fit = fit_world(
            pair,
            points.left_px,
            points.right_px,
            points.touched_mm,
            pair_covariance=cameras.covariance,
            pixel_sd_px=pixel_sd_px,
            touch_sd_mm=touch_sd_mm,
        )
    except ValueError as error:
        raise ConfigError.plain(
            f"the touched points determine no world axes: {error}. Nine at each of two heights are"
            " good."
        ) from error
    return WorldResult(fit, tuple(against_the_arm(fit)))


@dataclass(frozen=True, slots=True, eq=False)
class PointsAgain:
    """Points measured again: ``missed_mm`` (n, 3) and each expected distance (n,) mm."""

    missed_mm: Array
    expected_mm: Array


def check_points(
    part: Part, points: TouchedPoints, *, pixel_sd_px: float, touch_sd_mm: float
) -> tuple[PointsAgain, tuple[Finding, ...]]:
    """Touched points measured with a whole calibration, and findings. Raises ConfigError."""
    pair = pair_of_part(part)
    if part.world_from_right is None:
        raise ConfigError.plain(
            "touched points need a whole calibration, with [cameras.left], [cameras.right],"
            " [stereo] and [world]"
        )
    if not len(points.touched_mm):
        raise ConfigError.plain(
            "the table of touched points is empty: write a point a line under the first line"
        )
    missed = pair.place(points.left_px, points.right_px) - points.touched_mm
    if not np.isfinite(missed).all():
        bad = int(np.flatnonzero(~np.isfinite(missed).all(axis=1))[0]) + 1
        raise ConfigError.plain(
            f"point {bad} can't be triangulated: its pixels are outside of what the lenses were"
            " calibrated for"
        )
    noise = covariance_of_points(pair, None, points.touched_mm, pixel_sd_px)
    noise += touch_sd_mm**2 * np.eye(3)
    own = covariance_of_points(pair, part.covariance, points.touched_mm, 0.0)
    again = PointsAgain(missed, np.sqrt(np.trace(noise + own, axis1=1, axis2=2)))
    findings = []
    # all off the same way: the calibration's error is common, noise averages out
    mean, count = missed.mean(axis=0), len(missed)
    off_mm, covariance = float(np.linalg.norm(mean)), own.mean(axis=0) + noise.mean(axis=0) / count
    distance = float(mean @ np.linalg.solve(covariance, mean))
    if off_mm >= MOVED_MATTERS_MM and distance >= chdtri(3, SIGNIFICANT):
        x, y, z = mean
        sentence = (
            f"points are measured {off_mm:.1f} mm off on the mean ({x:+.1f}, {y:+.1f}, {z:+.1f}"
            " mm): the cameras, the arm or the table have moved against each other since"
        )
        findings.append(Finding("moved cameras", sentence))
    # off in different ways, by more than noise and calibration allow
    if free := count - 1:
        left_over = float(np.sum((missed - mean) ** 2)) / free
        expected = float(np.mean(again.expected_mm**2))
        limit = max(SCATTER_MATTERS**2, chdtri(3 * free, SIGNIFICANT) / (3 * free))
        if left_over >= limit * expected:
            sentence = (
                f"points scatter by {np.sqrt(left_over):.1f} mm, where {np.sqrt(expected):.1f} mm"
                " is to be expected: a lens or one of the cameras has moved, or points were"
                " mistaken for each other"
            )
            findings.append(Finding("scattered points", sentence))
    return again, tuple(findings)


POSITIONS = 2
TRIES = 4  # of one position, or of one point, before it is given up
ROWS, COLUMNS = ("upper", "middle", "lower"), ("left", "middle", "right")
# of the pitch: touched distances that miss printed ones by more are another point's
MISTAKEN = 0.25
WHERE = ("high and near", "lower and farther, tilted another way")
POINTS_FILE = "points.csv"
COLOUR = (0, 200, 255)
HOMED_AGAIN = "The arm was homed again."


@dataclass(frozen=True, slots=True)
class TouchSession:
    """Cameras, operator and arm; ``tip_radius_mm`` of a ball tip, 0 for a point; ``reconnect``
    waits for the instrument of a fault, or raises it.
    """

    look: Callable[[], Mapping[str, Grey]]
    operator: Operator
    tip: TipReader
    tip_radius_mm: float
    report: Callable[[str], None]
    reconnect: Callable[[InstrumentError], None]


def gather_points(asking: TouchSession, board: Board, folder: Path) -> TouchedPoints:
    """All points; pictures and table are kept in ``folder``. Raises OperatorAbort, DeviceError."""
    parts = []
    for position in range(1, POSITIONS + 1):
        seen, readings = _position(asking, board, position, folder)
        asking.operator.ask(Release())
        centres, axes = [one.tip_mm for one in readings], axes_of([one.axis for one in readings])
        parts.append((*seen, under_ball(centres, axes, asking.tip_radius_mm)))
        points = TouchedPoints(*(np.vstack(columns) for columns in zip(*parts, strict=True)))
        rows = np.hstack([points.left_px, points.right_px, points.touched_mm])
        table = io.StringIO()
        np.savetxt(table, rows, "%.4f", ",", header=",".join(POINT_COLUMNS), comments="")
        write_file(folder / POINTS_FILE, table.getvalue())  # whatever becomes of the next position
        asking.report(f"{len(rows)} points are kept in {folder / POINTS_FILE}")
    return points


class _RefusedError(DeviceError):
    """The touches of a position don't fit together: it is done again."""


def _position(
    asking: TouchSession, board: Board, position: int, folder: Path
) -> tuple[tuple[Array, Array], list[Reading]]:
    """The nine points' pixels and readings at one place of the board; done again from its board
    where they don't fit together. Raises DeviceError once that was so `TRIES` times.
    """
    for left in reversed(range(TRIES)):
        seen, readings = _fixed(asking, board, position, folder), list[Reading]()
        try:
            for at in range(len(nine(board))):
                readings.append(_touched(asking, board, at, readings))
        except _RefusedError as why:
            if not left:
                raise
            kept = "The points of the position before are kept. " if position > 1 else ""
            asking.report(
                f"{why}\n{kept}Position {position} is done again: fix the board so that no touch"
                " moves it, and look for the numbers in its picture."
            )
            continue
        return seen, readings
    raise AssertionError("the last try returns or raises")


def nine(board: Board) -> tuple[int, ...]:
    """The points to be touched: corners, edges' middles and middle of the board."""
    rows, columns = (0, board.rows // 2, board.rows - 1), (0, board.columns // 2, board.columns - 1)
    return tuple(row * board.columns + column for row in rows for column in columns)


def _fixed(asking: TouchSession, board: Board, position: int, folder: Path) -> tuple[Array, Array]:
    """The board fixed where both cameras see all of it: the nine points' pixels, (9, 2) each."""
    again = ""
    for _ in range(TRIES):
        where = WHERE[(position - 1) % len(WHERE)]
        text = (
            f"{again}Position {position} of {POSITIONS}, {where}: fix the board where both cameras"
            " see all of it and the arm reaches all of it, so that a touch can't move it. Take"
            " hands and arm out of the pictures."
        )
        asking.operator.ask(BoardPose(pattern_of(board), text, position, fixed=True))
        try:
            pictures = asking.look()
            pixels = _looked(pictures, board)
        except (ViewRefusedError, InstrumentError) as why:
            if isinstance(why, InstrumentError) and is_loss(why):
                asking.reconnect(why)
            asking.report(f"position {position}: refused: {why}")
            again = f"Not found ({why}) "
            continue
        for camera, points in zip(("left", "right"), pixels, strict=True):
            write_picture(folder / camera / f"position-{position}.png", pictures[camera])
            image = np.asarray(cv2.cvtColor(pictures[camera], cv2.COLOR_GRAY2BGR), dtype=np.uint8)
            for number, (x, y) in enumerate(np.rint(points).astype(int).tolist(), 1):
                cv2.circle(image, (x, y), 8, COLOUR, 2, cv2.LINE_AA)
                font = cv2.FONT_HERSHEY_SIMPLEX
                cv2.putText(image, str(number), (x + 10, y - 8), font, 0.8, COLOUR, 2, cv2.LINE_AA)
            write_picture(folder / f"position-{position}-{camera}-numbered.png", image)
        asking.report(
            f"position {position}: found; the points to touch are numbered in"
            f" {folder / f'position-{position}-left-numbered.png'}"
        )
        return pixels
    what = f"the board was not found at position {position}, {TRIES} times"
    hint = "See the pictures: is it sharp, lit, and the board that the file describes?"
    raise DeviceError("cameras", what, hint=hint)


def _looked(pictures: Mapping[str, Grey], board: Board) -> tuple[Array, Array]:
    left, right = (find_board(pictures[camera], board) for camera in ("left", "right"))
    right, corners = order_alike(left, right, board), nine(board)
    for camera, found in (("left", left), ("right", right)):
        if hidden := [str(at + 1) for at, corner in enumerate(corners) if corner not in found.ids]:
            raise ViewRefusedError(
                f"the {camera} camera does not see point {', '.join(hidden)} of the nine: show all"
                " of the board"
            )
    in_left, in_right = (
        [np.flatnonzero(found.ids == corner)[0] for corner in corners] for found in (left, right)
    )
    return left.pixels_px[in_left], right.pixels_px[in_right]


def _touched(asking: TouchSession, board: Board, at: int, before: list[Reading]) -> Reading:
    """One point, read; again where the arm moved or its distances fit another point."""
    which, corners, again = f"{ROWS[at // 3]} {COLUMNS[at % 3]}", nine(board), ""
    text = (
        f"Touch point {at + 1} of {len(corners)}, the {which} one, with the tip and hold it still."
    )
    for _ in range(TRIES):
        try:
            asking.operator.ask(BoardTouch(corners[at], text, again))
            reading = asking.tip.read()
        except TouchAgainError as moves:
            again = f"{moves} Touch it once more."
            continue
        except InstrumentError as error:
            asking.reconnect(error)
            again = "The touches before this one are kept."
            if before:
                _compare(asking, board, before)
            continue
        printed, wrong = board.points_mm[list(corners)], ""
        for earlier, known in enumerate(before):
            apart_mm = float(np.linalg.norm(printed[at] - printed[earlier]))
            touched_mm = float(np.linalg.norm(reading.tip_mm - known.tip_mm))
            if abs(touched_mm - apart_mm) > MISTAKEN * board.pitch_mm and not wrong:
                wrong = (
                    f"That lies {touched_mm:.1f} mm from point {earlier + 1}, where the print has"
                    f" {apart_mm:.1f} mm: another point, or the board has moved. Once more."
                )
        if not wrong:
            return reading
        again = wrong
        asking.report(again)
    what = f"point {at + 1} of the board was not touched well, {TRIES} times; the last one: {again}"
    raise _RefusedError(
        "arm", what, hint="Does the board stand fast, and is its file the right one?"
    )


def _compare(asking: TouchSession, board: Board, before: list[Reading]) -> None:
    """One touch of the last point shows whether an arm that was homed again counts on from the
    same place. Raises _RefusedError where it doesn't.
    """
    at = len(before) - 1
    text = f"Touch point {at + 1} once more: it shows whether the touches before still count."
    while True:
        asking.operator.ask(BoardTouch(nine(board)[at], text, HOMED_AGAIN))
        try:
            off_mm = float(np.linalg.norm(asking.tip.read().tip_mm - before[at].tip_mm))
        except TouchAgainError as moves:
            asking.report(str(moves))
            continue
        except InstrumentError as error:
            asking.reconnect(error)
            continue
        if off_mm > (limit_mm := same_place_mm(asking.tip.settings)):
            what = f"it was homed again, and point {at + 1} is {off_mm:.2f} mm from where it was"
            raise _RefusedError("arm", f"{what}, limit {limit_mm:.2f} mm")
        return


def under_ball(centres_mm: list[Array], axes: Array | None, radius_mm: float) -> Array:
    """Points (n, 3) of a plane from the ball tip's centres. Raises DeviceError without axes."""
    points = np.array(centres_mm, dtype=np.float64)
    if radius_mm == 0.0:
        return points
    if axes is None:
        what = f"a ball tip of {radius_mm:g} mm, and points without the stylus's direction"
        hint = "Give i, j and k with the points, or touch with a pointed tip"
        raise DeviceError("arm", what, hint=hint)
    normal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    side = 1.0 if float(np.mean(axes, axis=0) @ normal) > 0 else -1.0
    return np.asarray(points - radius_mm * side * normal)
