"""The guide asks for what is missing, in words and a picture, until nothing is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from bench.calibrate.views import (
    GUIDE,
    ViewsRequest,
    find_pictures,
    gather,
    pattern_of,
)
from bench.config import ConfigError
from bench.rig.reconnecting import Reconnecting
from detector.calibration.boards import Board
from detector.geometry import Camera, Motion
from instruments.clock import VirtualClock
from instruments.errors import InstrumentError, LinkError
from instruments.operators.operator import (
    DONE,
    Answer,
    BoardPose,
    OperatorEnough,
    Request,
    no_check,
)
from instruments.world.boards import Pattern
from tests.bench.calibrate.board_pictures import picture

pytestmark = pytest.mark.slow

SIZE = (960, 720)
LEFT = Camera(SIZE, (910.0, 912.0), (477.0, 362.0), 0.0, (-0.1, 0.05, 0.0, 0.0, 0.0))
SMALL = Board("chessboard", 7, 5, 15.0)
TILT_RAD = 0.5
LEFT_ALONE = ViewsRequest(("left",), ("left",))
NOTHING: NDArray[np.uint8] = np.full((SIZE[1], SIZE[0]), 120, np.uint8)


def in_cell(cell: int) -> Motion:
    """left_from_board: in that cell of twelve, tilted to each side, near and far in turn."""
    row, column = divmod(cell, 4)
    way, depth_mm = column * np.pi / 2, (520.0, 700.0)[(row + cell) % 2]
    R = Motion.from_vectors(TILT_RAD * np.array([np.cos(way), np.sin(way), 0.0]), np.zeros(3)).R
    u, v = (column + 0.5) * SIZE[0] / 4, (row + 0.5) * SIZE[1] / 3
    aim = depth_mm * np.array([(u - LEFT.cc[0]) / LEFT.fc[0], (v - LEFT.cc[1]) / LEFT.fc[1], 1.0])
    return Motion(R, aim - R @ SMALL.points_mm.mean(axis=0))


@cache
def held_picture(number: int) -> NDArray[np.uint8]:
    held = in_cell((number - 1) % 12)
    return picture(LEFT, held, number, board=SMALL, pitch_mm=SMALL.pitch_mm)


class Room:
    """An operator with the board in each cell in turn; now and then it is not there."""

    def __init__(
        self,
        *,
        empty: tuple[int, ...] = (),
        enough_at: int | None = None,
        gone_after: int | None = None,
    ) -> None:
        self.asked: list[BoardPose] = []
        self.note: list[str] = []
        self.lost: list[InstrumentError] = []
        self._empty, self._enough_at, self._shown = empty, enough_at, 0
        self._gone_after = gone_after

    def ask(self, asked: Request, check: Callable[[], None] = no_check) -> Answer:
        assert isinstance(asked, BoardPose)
        self.asked.append(asked)
        if asked.number == self._enough_at:
            raise OperatorEnough("his arms are tired")
        return DONE

    def look(self) -> Mapping[str, NDArray[np.uint8]]:
        if self.lost:
            raise self.lost.pop()
        if self._shown == self._gone_after:
            raise LinkError("left camera", "can't be opened")
        if self.asked[-1].number in self._empty:
            return {"left": NOTHING}
        self._shown += 1
        return {"left": held_picture(self._shown)}

    def gather(
        self,
        folder: Path,
        wanted: ViewsRequest = LEFT_ALONE,
        find: Callable[[InstrumentError], None] = lambda _: None,
    ) -> int:
        return gather(self.look, self, SMALL, wanted, folder, self.note.append, find)


@pytest.mark.weekly
def test_it_asks_for_less_and_less_and_ends_when_nothing_is_missing(tmp_path: Path) -> None:
    room = Room(empty=(3,))
    kept = room.gather(tmp_path)
    assert room.note[-1] == "Nothing is missing any more."
    assert kept == 13, "twelve cells, and the view that was refused"
    assert room.note[2].startswith("view 3: left refused: no 7 x 5 chessboard found")
    assert len(find_pictures([tmp_path], ["left"])["left"]) == kept
    first, late = room.asked[0].instruction, room.asked[-1].instruction
    show = "Missing: left: show the board in the picture's"
    assert f"where left sees all of it. {show} top far left, top left" in first
    assert "; and 3 more." in first
    assert late.endswith(f"{show} bottom far right; left: 1 more view.")


def test_who_has_had_enough_reads_what_is_missing_and_sees_green_where_it_is_covered(
    tmp_path: Path,
) -> None:
    room = Room(enough_at=3)
    assert room.gather(tmp_path) == 2
    missing = "Still missing: left: show the board in the picture's"
    assert room.note[-1].startswith(f"Enough: his arms are tired. {missing}")
    drawn = np.asarray(cv2.imread(str(tmp_path / GUIDE))).astype(int)
    high, wide = drawn.shape[0] // 3, drawn.shape[1] // 4
    redder = [
        drawn[5 + high : 60 + high, 5 + at * wide : wide - 5 + at * wide, 2].mean()
        for at in range(4)
    ]
    green = [drawn[70 : high - 5, 5 + at * wide : 30 + at * wide] for at in (0, 1)]
    assert all((cell[..., 1] > cell[..., 2]).mean() > 0.9 for cell in green), (
        "the two cells where the board was"
    )
    assert min(redder) > drawn[5 + high : 60 + high, :, 1].mean(), "the row below, where it was not"


def test_without_a_camera_to_guide_so_many_views_are_taken(tmp_path: Path) -> None:
    room = Room()
    assert room.gather(tmp_path, ViewsRequest(("left",), (), most=3)) == 3
    assert room.asked[0].instruction.endswith("another way each time: 3 views.")
    assert room.note[-1] == "3 views are enough. Still missing: nothing."


def test_who_shows_nothing_is_not_asked_for_ever(tmp_path: Path) -> None:
    room = Room(empty=(1, 2, 3))
    assert room.gather(tmp_path, ViewsRequest(("left",), ("left",), most=3)) == 3
    assert "12 more views" in room.note[-1]


def test_a_camera_that_comes_back_costs_no_view(tmp_path: Path) -> None:
    room, fault = Room(), LinkError("left camera", "can't be opened")
    room.lost = [fault, fault]
    assert room.gather(tmp_path, ViewsRequest(("left",), (), most=1)) == 1
    assert len(room.asked) == 3
    assert room.note[0] == f"view 1: {fault} The view is asked for again."
    room.lost = [fault] * 3
    with pytest.raises(LinkError):
        room.gather(tmp_path, LEFT_ALONE)


def test_a_camera_that_was_lost_is_waited_for_and_one_that_stays_away_ends_it(
    tmp_path: Path,
) -> None:
    """As `take_views` waits: its pictures are asked for every two seconds, for as long as a run."""
    said, clock, fault = list[str](), VirtualClock(), LinkError("left camera", "can't be opened")
    for back_at_s in (30.0, 3000.0):
        started_s = clock.now()

        def look(back_s: float = started_s + back_at_s) -> None:
            if clock.now() < back_s:
                raise fault

        kept = "The views so far are kept."
        find = Reconnecting({"cameras": look}, print, clock, said.append, 600.0, kept).wait
        room = Room()
        room.lost = [fault]
        if back_at_s < 600.0:
            room.gather(tmp_path, ViewsRequest(("left",), (), most=1), find)
            assert 30.0 <= clock.now() - started_s <= 32.0
            assert said[-1] == "The cameras are back."
            continue
        with pytest.raises(LinkError):
            room.gather(tmp_path, ViewsRequest(("left",), (), most=1), find)
        assert 600.0 <= clock.now() - started_s <= 602.0
    assert kept in said[0]


def test_a_camera_that_stays_away_leaves_what_was_taken_and_says_where(tmp_path: Path) -> None:
    room = Room(gone_after=1)
    with pytest.raises(LinkError):
        room.gather(tmp_path, ViewsRequest(("left",), (), most=3))
    assert room.note[-1] == f"Taken so far: 1 view, in {tmp_path}, to be given with further ones."
    assert (tmp_path / "left" / "01.png").is_file()


def test_a_disk_that_is_full_at_the_second_view_leaves_the_first_and_says_where(
    tmp_path: Path,
) -> None:
    room = Room()
    (tmp_path / "left" / "02.png").mkdir(parents=True)  # what the system refuses to write over
    with pytest.raises(OSError, match=r"02\.png"):
        room.gather(tmp_path, ViewsRequest(("left",), (), most=3))
    assert room.note[-1] == f"Taken so far: 1 view, in {tmp_path}, to be given with further ones."


def test_a_camera_that_delivers_nothing_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the rig has no thermal camera: left delivered pictures"):
        Room().gather(tmp_path, ViewsRequest(("left", "thermal"), ("thermal",)))


def test_both_sides_mean_the_same_board() -> None:
    for board in (
        SMALL,
        Board("charuco", 11, 7, 25.0, 18.0, "4x4_50"),
        Board("circles", 7, 5, 18.0, circle_mm=9.0),
    ):
        pattern = pattern_of(board)
        apart = pattern.corners_mm - pattern.corners_mm[0] - board.points_mm[:, :2]
        assert np.abs(apart).max() < 1e-9
        assert isinstance(pattern, Pattern)
