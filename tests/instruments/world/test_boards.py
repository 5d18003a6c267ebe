"""Calibration boards in the scene, by light and by heat, still and moving, against OpenCV."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from instruments.world.boards import Board, Pattern, poses
from instruments.world.optics import Floats
from instruments.world.sensor import Exposure, Image
from instruments.world.state import SceneState
from tests.examples import few
from tests.instruments.world.scenes import NOBODY, by_opencv, centroid, eye, matrix, renderer

pytestmark = pytest.mark.slow

CHESS = Pattern("chessboard", 10, 7, 25.0, 20.0)
CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
UPRIGHT = Board((-340.0, 300.0, 260.0), pattern=CHESS)


def with_board(board: Board, **more: object) -> SceneState:
    return replace(NOBODY, boards=(board,), **more)  # type: ignore[arg-type]


@cache
def held(pattern: Pattern) -> tuple[Board, ...]:
    return poses(pattern, renderer().cameras[:2], (450.0, 1200.0), seed=3)


def grey(picture: Image) -> NDArray[np.uint8]:
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def refined(picture: Image, corners_px: Floats, window: int = 4) -> Floats:
    start = corners_px.astype(np.float32).reshape(-1, 1, 2) + np.float32(0.3)
    found = cv2.cornerSubPix(grey(picture), start, (window, window), (-1, -1), CRITERIA)
    return np.asarray(found.reshape(-1, 2), dtype=np.float64)


@pytest.mark.parametrize("which", ["left", "right"])
@pytest.mark.parametrize("number", few([0, 7, 13], 3))
def test_corners_lie_where_opencv_projects_them(which: str, number: int) -> None:
    """Within 0.05 px rms of `cv2.projectPoints`, in tilted poses, before noise, and on the mean
    within 0.01 px.

    Through a soft lens and in a large window, for `cornerSubPix` itself is off by up to 0.1 px on
    pictures that are exact, as the next test shows that these are.
    """
    board = held(replace(CHESS, square_mm=40.0))[number]
    soft = eye(which, blur_px=1.0)
    expected = by_opencv(soft.view.camera, board.corners_mm)
    inside = np.all((expected > 16.0) & (expected < np.array([1343.0, 1007.0])), axis=1)
    assert inside.sum() >= 30
    seen = refined(soft.expected(with_board(board)), expected[inside], window=10)
    off = np.linalg.norm(seen - expected[inside], axis=1)
    assert np.sqrt((off**2).mean()) < 0.05
    assert off.max() < 0.1
    assert np.abs((seen - expected[inside]).mean(axis=0)).max() < 0.01


@pytest.mark.parametrize("pattern", [CHESS, Pattern("charuco", 7, 5, 36.0, 10.0)])
def test_every_pixel_has_its_exact_share_of_dark(pattern: Pattern) -> None:
    """Against 40 x 40 samples a pixel, whose rays `cv2.undistortPoints` gives."""
    view, samples, half = renderer().left.view, 40, 7
    board = replace(held(CHESS)[7], pattern=pattern)
    seen = view.board(board)
    share = np.zeros((1024, 1360))
    share[seen.cover.row, seen.cover.column] = seen.dark
    u0, v0 = by_opencv(view.camera, board.corners_mm[[0]])[0].round().astype(int)
    fine = (np.arange(samples * (2 * half + 1)) + 0.5) / samples - half - 0.5
    u, v = np.meshgrid(u0 + fine, v0 + fine)
    dark = _dark_at(board, np.column_stack([u.ravel(), v.ravel()])).reshape(u.shape)
    expected = dark.reshape(2 * half + 1, samples, 2 * half + 1, samples).mean(axis=(1, 3))
    around = share[v0 - half : v0 + half + 1, u0 - half : u0 + half + 1]
    assert np.abs(expected - around).max() < 0.003


def charuco(pattern: Pattern) -> cv2.aruco.CharucoBoard:
    """OpenCV's own board."""
    size, marker_mm = (pattern.columns, pattern.rows), 0.75 * pattern.square_mm
    dictionary = cv2.aruco.getPredefinedDictionary(pattern.dictionary)
    return cv2.aruco.CharucoBoard(size, pattern.square_mm, marker_mm, dictionary)


def _dark_at(board: Board, pixels: Floats) -> Floats:
    """1 where the board is dark, at pixels (n, 2), by OpenCV's inverse of the lens."""
    camera = renderer().left.view.camera
    pattern, corner = board.pattern, np.asarray(board.corner_mm)
    plane = cv2.undistortPoints(pixels[:, None, :], matrix(camera), camera.kc)[:, 0]
    rays = np.column_stack([plane, np.ones(len(plane))]) @ camera.R
    depth = ((corner - camera.centre_mm) @ board.normal) / (rays @ board.normal)
    on = camera.centre_mm + depth[:, None] * rays - corner
    flat = np.column_stack([on @ board.across, on @ board.along]) - pattern.margin_mm
    if pattern.kind == "chessboard":
        squares = np.floor(flat / pattern.square_mm)
        return np.asarray(squares.sum(axis=1) % 2 == 0, dtype=np.float64)
    scale = 20  # a ChArUco board is OpenCV's own drawing, 20 px a mm
    size = tuple(round(n * pattern.square_mm * scale) for n in (pattern.columns, pattern.rows))
    picture = charuco(pattern).generateImage(size)
    at = np.floor(flat * scale).astype(int)
    inside = np.all((at >= 0) & (at < np.array(size)), axis=1)
    dark = np.zeros(len(at))
    dark[inside] = picture[at[inside, 1], at[inside, 0]] < 128
    return dark


def test_opencv_reads_the_charuco_board() -> None:
    """Markers, their numbers and the corners between them, as OpenCV lays such a board out."""
    pattern = Pattern("charuco", 8, 6, 40.0, 15.0)
    board = Board((-360.0, 150.0, 275.0), pattern=pattern)
    referee, picture = charuco(pattern), grey(renderer().left.expected(with_board(board)))
    corners, ids, _, marker_ids = cv2.aruco.CharucoDetector(referee).detectBoard(picture)
    assert len(marker_ids) == 24
    assert sorted(int(i) for i in ids.ravel()) == list(range(35))
    expected = by_opencv(renderer().cameras[0], board.corners_mm)[ids.ravel()]
    # the detector's own refinement; order and place are the point
    assert np.linalg.norm(corners.reshape(-1, 2) - expected, axis=1).max() < 0.25
    laid_out = np.asarray(referee.getChessboardCorners())[:, :2]
    assert board.pattern.corners_mm - pattern.margin_mm == pytest.approx(laid_out)


def test_circles_lie_where_opencv_projects_them_by_heat() -> None:
    """The middle of each circle's heat, in thermal pixels."""
    pattern = Pattern("circles", 4, 3, 36.0, 9.0, feature_mm=18.0)
    board = Board((-175.0, 240.0, 155.0), pattern=pattern, light=20.0, dark=36.0)
    camera = renderer().cameras[2].resized(160, 120)
    warmth = renderer().thermal.expected_k(with_board(board)) - 293.15
    reach = round(18.0 * camera.fc[0] / 1080.0)
    for u, v in by_opencv(camera, board.corners_mm):
        at = centroid(warmth, (round(u), round(v)), reach)
        assert at == pytest.approx([u, v], abs=0.05)


def test_a_board_from_behind_is_plain() -> None:
    away = replace(UPRIGHT, corner_mm=(-50.0, 300.0, 260.0), across=(-1.0, 0.0, 0.0))
    u, v = by_opencv(renderer().cameras[0], UPRIGHT.corners_mm).round().astype(int).T
    patch = renderer().left.expected(with_board(away))[v.min() : v.max(), u.min() : u.max()]
    assert patch.min() > 150.0  # where a dark square would be some 20


def test_a_heated_board_shows_its_squares_to_the_thermal_camera() -> None:
    pattern = Pattern("chessboard", 5, 4, 45.0, 10.0)
    board = Board((-190.0, 240.0, 170.0), pattern=pattern, light=28.0, dark=36.0)
    camera = renderer().cameras[2].resized(160, 120)
    seen = renderer().thermal.expected_k(with_board(board))
    corners = by_opencv(camera, board.corners_mm)
    bright = ((seen - seen.min()) / np.ptp(seen) * 255.0).astype(np.float32)
    large = cv2.resize(bright, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    at = refined(np.asarray(large), 4.0 * corners + 1.5, window=10)
    off = (at - 1.5) / 4.0 - corners
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.06  # of a thermal pixel of 8 mm
    assert np.abs(off.mean(axis=0)).max() < 0.04
    two = board.placed(np.array([[10.0 + 22.5, 10.0 + 22.5], [10.0 + 67.5, 10.0 + 22.5]]))
    middle = by_opencv(camera, two).round().astype(int)
    dark, light = (seen[v, u] - 273.15 for u, v in middle)
    assert dark == pytest.approx(0.93 * 36.0 + 0.07 * 20.0, abs=0.25)
    assert light == pytest.approx(0.93 * 28.0 + 0.07 * 20.0, abs=0.25)


def test_a_board_that_moves_is_smeared_along_its_way() -> None:
    """At 50 mm/s and 0.1 s: over 5 mm, some 5.7 px, about the place at mid-exposure."""
    board = replace(UPRIGHT, pattern=Pattern("plain", 6, 6, 25.0, 0.0))
    still, moving = (
        renderer().left.expected(with_board(b, exposure=Exposure(0.1, 0.2)))
        for b in (board, replace(board, velocity_mm_s=(50.0, 0.0, 0.0)))
    )
    outline = by_opencv(renderer().cameras[0], board.outline_mm)
    u, v = outline[0]
    across = slice(round(u) - 12, round(u) + 13)
    rows = slice(round(v) + 40, round(v) + 90)
    edges = [picture[rows, across].mean(axis=0) for picture in (still, moving)]
    widths = [_width(edge) for edge in edges]
    smear = 5.0 * 1291.0 / (300.0 + 839.5)
    assert widths[1] == pytest.approx(np.hypot(widths[0], smear / np.sqrt(12.0)), rel=0.08)
    assert _place(edges[1]) == pytest.approx(_place(edges[0]), abs=0.03)


def _width(edge: Image) -> float:
    """Standard deviation of an edge's spread, px."""
    line = np.diff(edge)
    line = line / line.sum()
    at = np.arange(len(line))
    return float(np.sqrt(line @ (at - line @ at) ** 2))


def _place(edge: Image) -> float:
    line = np.diff(edge)
    return float(line @ np.arange(len(line)) / line.sum())


def test_poses_spread_tilt_and_stay_in_view() -> None:
    boards = held(CHESS)
    assert len(boards) == 24
    assert boards == poses(CHESS, renderer().cameras[:2], (450.0, 1200.0), seed=3)
    tilts = [np.degrees(np.arccos(abs(float(board.normal @ [0.0, 1.0, 0.0])))) for board in boards]
    assert max(tilts) > 30.0
    pixels = [
        np.array([by_opencv(camera, board.corners_mm) for board in boards])
        for camera in renderer().cameras[:2]
    ]
    assert all(np.all((seen > 5.0) & (seen < [1354.0, 1018.0])) for seen in pixels)
    assert np.ptp(pixels[0].reshape(-1, 2), axis=0).tolist() > [1000.0, 700.0]
    with pytest.raises(ValueError, match="take a smaller board"):
        poses(CHESS, renderer().cameras, (400.0, 450.0), seed=1)


def test_a_pattern_without_sense_is_refused() -> None:
    with pytest.raises(ValueError, match="squares with a size"):
        Pattern(square_mm=0.0)
