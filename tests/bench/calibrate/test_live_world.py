"""The world's live step: touches that go wrong, boards that aren't seen, a ball tip."""

from __future__ import annotations

import errno
from collections.abc import Callable, Mapping
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.calibrate import world
from bench.calibrate.views import write_picture
from bench.calibrate.world import TouchSession, gather_points, nine, read_points, under_ball
from bench.rig.model import ArmTable
from bench.truth.touching import TipReader
from detector.calibration.boards import Board
from detector.geometry import Array, Motion
from instruments.errors import DeviceError, LinkError
from instruments.microscribe.configuration import Identity
from instruments.microscribe.driver import Reading
from instruments.microscribe.errors import ArmMovesError
from instruments.operators.operator import DONE, Answer, BoardPose, BoardTouch, Request, no_check
from tests.bench.calibrate.board_pictures import BOARD, LEFT, RIGHT, RIGHT_FROM_LEFT, picture, poses

pytestmark = pytest.mark.slow

Grey = NDArray[np.uint8]
WORLD_FROM_BOARD = Motion.from_vectors([-1.4, 0.1, 0.05], [-300.0, 200.0, 250.0])
NORMAL = -WORLD_FROM_BOARD.R[:, 2]  # towards who sees the print
RADIUS_MM = 1.5


class Lab:
    """An arm whose tip is at the board, which the cameras see at some looks."""

    def __init__(
        self, *, wrong: Mapping[int, int] | None = None, moves_at: int = 0, hidden_looks: int = 0
    ) -> None:
        self.wrong = dict(wrong or {})  # at that touch (from 1) another of the board's points
        self.moves_at, self.hidden_looks = moves_at, hidden_looks
        self.touched, self.looks, self.lost_at, self.found = 0, 0, 0, Mock()
        self.again: list[str] = []
        self.boards: list[BoardPose] = []
        self.text: list[str] = []
        self._tip: Array = np.zeros(3)
        self.off_mm = 0.0  # along each axis

    def look(self) -> dict[str, Grey]:
        self.looks += 1
        if self.looks <= self.hidden_looks:
            return dict.fromkeys(("left", "right"), np.full((360, 480), 120, np.uint8))
        pose = poses(4, 5)[self.looks % 2]
        return {"left": picture(LEFT, pose, 1), "right": picture(RIGHT, RIGHT_FROM_LEFT @ pose, 2)}

    def ask(self, request: Request, check: Callable[[], None] = no_check) -> Answer:
        if isinstance(request, BoardPose):
            self.boards.append(request)
        elif isinstance(request, BoardTouch):
            self.touched += 1
            self.again += [request.again] if request.again else []
            at = self.wrong.get(self.touched, request.corner)
            self._tip = WORLD_FROM_BOARD.apply(BOARD.points_mm[at]) + RADIUS_MM * NORMAL
        return DONE

    @property
    def identity(self) -> Identity:
        raise AssertionError("nobody asks here who the arm is")

    touches = False

    def touch(self, point_mm: Array, axis: Array) -> None:
        raise AssertionError("it is moved by hand")

    def read(self, n: int = 8, max_spread_mm: float = 1.0) -> Reading:
        if self.touched == self.lost_at:
            raise LinkError("arm", "silent")
        if self.touched == self.moves_at:
            raise ArmMovesError("arm", f"the tip moved by more than {max_spread_mm} mm")
        return Reading(
            tip_mm=self._tip + self.off_mm, axis=NORMAL, spread_mm=0.05, n=n, counts=(0, 0, 0, 0, 0)
        )

    def points(self, folder: Path, board: Board = BOARD) -> Array:
        tip = TipReader(self, ArmTable(url="emulator:"), None)
        asking = TouchSession(self.look, self, tip, RADIUS_MM, self.text.append, self.found)
        return gather_points(asking, board, folder).touched_mm


def expected() -> Array:
    points = WORLD_FROM_BOARD.apply(BOARD.points_mm[list(nine(BOARD))])
    return np.vstack([points, points])


def test_points_of_one_position_are_kept_whatever_becomes_of_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, image: Grey) -> None:
        if path.name == "position-2.png":
            raise OSError(errno.ENOSPC, "No space left on device")
        write_picture(path, image)

    monkeypatch.setattr(world, "write_picture", full)
    with pytest.raises(OSError, match="No space"):
        (lab := Lab()).points(tmp_path)
    assert len(read_points(tmp_path / "points.csv").touched_mm) == 9
    assert f"9 points are kept in {tmp_path / 'points.csv'}" in lab.text


def test_nine_points_at_each_of_two_positions_the_ball_allowed_for(tmp_path: Path) -> None:
    lab = Lab()
    np.testing.assert_allclose(lab.points(tmp_path), expected(), atol=1e-9)
    assert [(asked.number, asked.fixed) for asked in lab.boards] == [(1, True), (2, True)]
    assert lab.touched == 18
    table = (tmp_path / "points.csv").read_text(encoding="utf-8")
    assert table.startswith("left_x,left_y,right_x,right_y,x_mm,y_mm,z_mm\n")


def test_a_point_is_asked_for_again_alone_whatever_was_wrong(tmp_path: Path) -> None:
    lab = Lab(wrong={5: 3}, moves_at=8)
    lab.lost_at = 12
    np.testing.assert_allclose(lab.points(tmp_path), expected(), atol=1e-9)
    assert (lab.touched, lab.found.call_count) == (21, 1)
    assert lab.again[2] == "The touches before this one are kept."
    assert "where the print has" in lab.again[0]
    assert "another point, or the board has moved. Once more." in lab.again[0]
    assert lab.again[1].endswith("Touch it once more.")


def test_a_board_that_is_not_seen_is_asked_for_again_with_the_reason(tmp_path: Path) -> None:
    lab = Lab(hidden_looks=2)
    lab.points(tmp_path)
    assert [asked.number for asked in lab.boards] == [1, 1, 1, 2]
    assert lab.boards[1].instruction.startswith("Not found (no 7 x 5 chessboard found")
    assert lab.text[0].startswith("position 1: refused: no 7 x 5 chessboard found")


@pytest.mark.parametrize(
    ("lab", "why"),
    [
        (Lab(hidden_looks=9), "the board was not found at position 1, 4 times"),
        (
            Lab(wrong={7 * turn + touch: 0 for turn in range(4) for touch in range(4, 8)}),
            "point 4 of the board was not touched well, 4 times",
        ),
    ],
)
def test_what_never_goes_well_ends_it(lab: Lab, why: str, tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=why):
        lab.points(tmp_path)
    assert not (tmp_path / "points.csv").exists()


def test_a_position_whose_touches_do_not_fit_is_done_again_alone(tmp_path: Path) -> None:
    """Here the first touch was another point's: all after it seem wrong."""
    lab = Lab(wrong={10: 30})
    np.testing.assert_allclose(lab.points(tmp_path), expected(), atol=1e-9)
    assert [asked.number for asked in lab.boards] == [1, 2, 2]
    assert lab.touched == 9 + 1 + 4 + 9
    (why,) = [text for text in lab.text if "is done again" in text]
    assert "point 2 of the board was not touched well, 4 times" in why
    assert "The points of the position before are kept. Position 2 is done again" in why


@pytest.mark.parametrize("off_mm", [0.0, 3.0])
def test_after_the_arm_was_homed_again_one_touch_shows_whether_those_before_count(
    off_mm: float, tmp_path: Path
) -> None:
    lab = Lab()
    lab.lost_at, find = 5, lab.found

    def homed(_: object) -> None:
        find()
        lab.off_mm = off_mm

    lab.found = homed  # type: ignore[assignment]
    points = lab.points(tmp_path)
    np.testing.assert_allclose(points, expected() + off_mm, atol=1e-9)
    assert lab.again[0] == "The arm was homed again."
    assert lab.touched == 5 + 1 + (5 if not off_mm else 9) + 9
    assert any("point 4 is 5.20 mm from where it was" in text for text in lab.text) == bool(off_mm)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_ball_rests_on_the_side_from_which_the_stylus_comes(side: float) -> None:
    flat = np.array([[x, y, 0.0] for x in (0.0, 50.0, 100.0) for y in (0.0, 40.0, 80.0)])
    axis = np.array([0.3, 0.1, side])
    centres = list(flat + np.array([0.0, 0.0, 2.0 * side]))
    axes = np.tile(axis, (len(centres), 1))
    np.testing.assert_allclose(under_ball(centres, axes, 2.0), flat, atol=1e-9)
    with pytest.raises(
        DeviceError, match=r"points without the stylus's direction.*Give i, j and k"
    ):
        under_ball(centres, None, 2.0)
