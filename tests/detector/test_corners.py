"""Boards in pictures: found to a fraction of a pixel, in order, or refused with the reason."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest

from detector.calibration.boards import Board
from detector.calibration.corners import (
    DetectedBoard,
    Gray,
    ViewRefusedError,
    between_neighbours,
    find_board,
    order_alike,
    strays,
)
from detector.geometry import Array, Camera, Motion, apply_homography

SUPER = 4  # samples a pixel and side
SIZE = (640, 480)
CHESS = Board("chessboard", 8, 5, 30.0)
CHARUCO = Board("charuco", 8, 5, 30.0, marker_mm=22.0, dictionary="4x4_50")
CIRCLES = Board("circles", 7, 5, 30.0, circle_mm=15.0)
MARKERS: dict[str, object] = {"kind": "charuco", "marker_mm": 20.0, "dictionary": "4x4_50"}
TURN = np.array([[-1.0, 0, SIZE[0] - 1], [0, -1.0, SIZE[1] - 1], [0, 0, 1.0]])
TILTED = np.array([[1.75, 0.25, 110.0], [0.1, 1.9, 100.0], [0.0004, 0.0002, 1.0]])  # board mm -> px


def printed(board: Board, dots_per_mm: int = 8) -> tuple[Gray, Array]:
    """The board's print with a margin, and the map from board mm to its pixels."""
    margin = 30.0
    width, height = board.size_mm
    dots = [round((side + 2 * margin) * dots_per_mm) for side in (height, width)]
    paper = np.full(dots, 255, np.uint8)
    to_paper = np.diag([dots_per_mm, dots_per_mm, 1.0])
    to_paper[:2, 2] = (margin + board.pitch_mm) * dots_per_mm - 0.5
    if board.kind == "charuco":
        inner = board.aruco.generateImage((round(width * dots_per_mm), round(height * dots_per_mm)))
        edge = round(margin * dots_per_mm)
        paper[edge : edge + inner.shape[0], edge : edge + inner.shape[1]] = inner
        return paper, to_paper
    y, x = ((np.mgrid[: dots[0], : dots[1]] + 0.5) / dots_per_mm - margin) / board.pitch_mm
    if board.kind == "chessboard":
        on = (x >= 0) & (y >= 0) & (x < board.columns + 1) & (y < board.rows + 1)
        paper[on & ((np.floor(x) + np.floor(y)) % 2 == 0)] = 0
        return paper, to_paper
    assert board.circle_mm
    radius = board.circle_mm / 2 / board.pitch_mm
    x, y = x - radius, y - radius
    nearest = np.clip(np.rint(x), 0, board.columns - 1), np.clip(np.rint(y), 0, board.rows - 1)
    paper[np.hypot(x - nearest[0], y - nearest[1]) < radius] = 0
    to_paper[:2, 2] = (margin + board.circle_mm / 2) * dots_per_mm - 0.5
    return paper, to_paper


@cache
def seen_through(board: Board, turned: bool = False) -> Array:
    """The board before a camera without blur and noise, 0 to 255; turned by half a turn."""
    H = TURN @ TILTED if turned else TILTED
    paper, to_paper = printed(board)
    finer = np.array([[SUPER, 0, (SUPER - 1) / 2], [0, SUPER, (SUPER - 1) / 2], [0, 0, 1.0]])
    through, fine = finer @ H @ np.linalg.inv(to_paper), (SIZE[0] * SUPER, SIZE[1] * SUPER)
    large = cv2.warpPerspective(paper, through, fine, borderValue=255)
    return cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA).astype(np.float64)


def picture(board: Board, turned: bool = False, *, blur_px: float = 0.8, moved_px: int = 0) -> Gray:
    """Blurred, noisy; dark 40, bright 210."""
    small = seen_through(board, turned)
    soft = cv2.blur(cv2.GaussianBlur(small, (0, 0), blur_px), (max(moved_px, 1), 1))
    grain = np.random.default_rng(1).normal(0, 1.0, soft.shape)
    return np.clip(40 + soft / 255 * 170 + grain, 0, 255).astype(np.uint8)


def missed_px(found: DetectedBoard, board: Board, H: Array = TILTED) -> Array:
    return found.pixels_px - apply_homography(H, board.points_mm[found.ids, :2])


@pytest.mark.slow
@pytest.mark.parametrize("board", [CHESS, CHARUCO, CIRCLES], ids=lambda board: board.kind)
@pytest.mark.parametrize("inverted", [False, True], ids=["dark on bright", "bright on dark"])
def test_every_board_is_found_to_a_twentieth_of_a_pixel(board: Board, inverted: bool) -> None:
    image = picture(board)
    found = find_board(255 - image if inverted else image, board)
    assert len(found.ids) == 40 if board is not CIRCLES else 35
    assert np.sqrt(np.mean(missed_px(found, board) ** 2)) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("inverted", [False, True], ids=["dark on bright", "bright on dark"])
@pytest.mark.parametrize("around", [20, 140])
def test_a_boards_first_corner_is_told_by_its_rim(inverted: bool, around: int) -> None:
    """Of a rim a square wide, before anything."""
    inner = CHESS.points_mm[[0, CHESS.columns - 1, -1, -CHESS.columns], :2]
    rim = inner + 2.0 * CHESS.pitch_mm * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    paper, image = np.zeros(SIZE[::-1], np.uint8), picture(CHESS)
    cv2.fillConvexPoly(paper, np.rint(apply_homography(TILTED, rim)).astype(np.int32), 1)
    image = np.where(paper > 0, 255 - image if inverted else image, around).astype(np.uint8)
    assert np.abs(missed_px(find_board(image, CHESS), CHESS)).max() < 0.3


@pytest.mark.slow
def test_a_corner_that_the_finder_leaves_on_an_edge_is_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    finder = cv2.findChessboardCorners

    def beside(*given: Any, **more: Any) -> Any:
        done, corners = finder(*given, **more)
        corners[2, 0] += 0.24 * (corners[3, 0] - corners[2, 0])
        return done, corners

    monkeypatch.setattr(cv2, "findChessboardCorners", beside)
    assert np.abs(missed_px(find_board(picture(CHESS), CHESS), CHESS)).max() < 0.3


def test_a_charuco_board_may_be_hidden_in_part() -> None:
    image = picture(CHARUCO)
    image[:, :250] = 128
    found = find_board(image, CHARUCO)
    assert 8 <= len(found.ids) < 40
    assert np.abs(missed_px(found, CHARUCO)).max() < 0.2


@pytest.mark.slow
def test_the_first_corner_is_the_prints_own_whichever_way_it_is_turned() -> None:
    found = find_board(picture(CHESS, turned=True), CHESS)
    assert np.abs(missed_px(found, CHESS, TURN @ TILTED)).max() < 0.3


@pytest.mark.slow
def test_boards_that_read_the_same_turned_are_counted_alike_in_both_cameras() -> None:
    board = Board("chessboard", 8, 6, 25.0)
    found = find_board(picture(board), board)
    assert np.array_equal(order_alike(found, found.turned(board), board).ids, found.ids)
    assert order_alike(found, found, board) is found
    assert not CHESS.reads_the_same_turned
    # colours have told it already
    assert order_alike(found, found.turned(board), CHESS).ids[0] == 47


EMPTY = np.full((480, 640), 90, np.uint8)


class TestRefusals:
    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("make", "said"),
        [
            (lambda: EMPTY, "no 8 x 5 chessboard found: is the whole board in the picture"),
            (lambda: picture(CHESS, blur_px=3.5), r"blurred: edges are \d+\.\d px wide"),
            (lambda: picture(CHESS, moved_px=13), "the board moved: edges are"),
            (lambda: np.dstack([EMPTY] * 3), "wants an 8-bit grey picture"),
        ],
        ids=["no board", "blurred", "moved", "colour"],
    )
    def test_pictures(self, make: Callable[[], Gray], said: str) -> None:
        with pytest.raises(ValueError, match=said) as refused:
            find_board(make(), CHESS)
        assert isinstance(refused.value, ViewRefusedError) == ("8-bit" not in said)

    @pytest.mark.parametrize(
        ("faulty", "said"),
        [
            ({"kind": "dots"}, "no board 'dots'"),
            ({"columns": 2}, "from 3 x 3"),
            ({"pitch_mm": float("nan")}, "points' distance"),
            ({"marker_mm": 3.0}, "belong to a charuco board"),
            (MARKERS | {"marker_mm": 40.0}, "does not fit"),
            (MARKERS | {"dictionary": "9x9"}, "no marker dictionary"),
            (MARKERS | {"columns": 20, "rows": 20}, "needs 220 markers"),
            ({"kind": "circles"}, "circle_mm belongs"),
        ],
    )
    def test_boards_that_are_none(self, faulty: dict[str, object], said: str) -> None:
        size: dict[str, object] = {"columns": 8, "rows": 5, "pitch_mm": 30.0}
        with pytest.raises(ValueError, match=said):
            Board(**({"kind": "chessboard"} | size | faulty))  # type: ignore[arg-type]


WIDE = Camera((1360, 1024), (800.0, 800.0), (680.0, 512.0), 0.0, (-0.3, 0.1, 0.0, 0.0, 0.0))


def wide_grid(om: list[float]) -> Array:
    """The corners (6, 9, 2) of a near board in a wide lens."""
    pose = Motion.from_vectors(om, [-160.0, -100.0, 420.0])
    return WIDE.project(pose.apply(Board("chessboard", 9, 6, 40.0).points_mm)).reshape(6, 9, 2)


@pytest.mark.parametrize(
    "om", [[0.0, 0.0, 0.0], [0.0, 0.7, 0.0], [-0.7, 0.0, 0.2], [0.4, 0.5, 0.0]]
)
def test_a_wide_lens_and_a_strong_tilt_make_none(om: list[float]) -> None:
    assert not strays(wide_grid(om)).any()


@pytest.mark.parametrize("at", [(0, 0), (0, 4), (3, 8), (2, 5), (5, 0)])
def test_one_beside_its_place_is_reported_and_its_neighbours_are_not(at: tuple[int, int]) -> None:
    grid = wide_grid([0.3, -0.3, 0.1])
    beside = grid.copy()
    beside[at] += (15.0, -21.0)
    assert np.argwhere(strays(beside)).tolist() == [list(at)]
    # near enough for a sub-pixel window
    assert np.linalg.norm(between_neighbours(beside)[at] - grid[at]) < 6.0
