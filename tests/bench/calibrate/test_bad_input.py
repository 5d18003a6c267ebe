"""Wrong pictures and tables: one sentence says what, where and what to do; no file."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.calibrate.board_print import board_figure, board_pdf, sheet_mm
from bench.calibrate.exchange import (
    read_bouguet,
    read_opencv,
    read_ros,
    write_bouguet,
    write_opencv,
    write_ros,
)
from bench.config import ConfigError
from bench.rig.loading import BOARDS, RIGS, load_board
from detector.calibration import load_calibration
from detector.calibration.corners import find_board
from tests.bench.calibrate.board_pictures import (
    BOARD_TOML,
    LEFT,
    picture,
    poses,
    write_image,
    write_pairs,
)
from tests.bench.commands import Said
from tests.detector.thesis_fits import thesis_published

pytestmark = pytest.mark.slow

WANTED = "or a table with --pairs"


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    (tmp_path / "board.toml").write_text(BOARD_TOML, encoding="utf-8")
    return tmp_path


@pytest.fixture(scope="module")
def three_pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pairs(tmp_path_factory.mktemp("pictures") / "day", 3)


BLACK, GREY = np.zeros((100, 100), np.uint8), np.full((360, 480), 128, np.uint8)


def both(image: NDArray[np.uint8], count: int = 1) -> dict[str, NDArray[np.uint8]]:
    names = (f"{camera}/{at:02d}.png" for camera in ("left", "right") for at in range(count))
    return dict.fromkeys(names, image)


@pytest.mark.parametrize(
    ("name", "made", "more", "why"),
    [
        ("nowhere", dict, "", "nowhere: no such folder; a set of pictures is a folder with left/"),
        ("", dict, "", "no picture found; wanted: left/NAME.png"),
        ("half", lambda: {"left/00.png": BLACK}, "", "no picture of the right camera was found"),
        ("empty", lambda: both(GREY), "", "left has 0 usable views of the board, at least 3 are"),
        ("day", dict, "--max-views 2", "2 usable views of the board"),
        ("same", lambda: both(picture(LEFT, poses(1)[0], 1), 4), "", "from one side"),
        ("day", lambda: {"left/02.png": BLACK}, "", "02.png: 100 x 100 px, but"),
        ("broken", lambda: both(GREY), "", "00.png: is not an image that can be read (17 bytes)"),
    ],
)
def test_pictures_that_make_no_calibration(
    lab: Path,
    three_pairs: Path,
    said: Said,
    name: str,
    made: Callable[[], Mapping[str, NDArray[np.uint8]]],
    more: str,
    why: str,
) -> None:
    if name == "day":
        shutil.copytree(three_pairs, lab / "day")
    for path, image in made().items():
        write_image(lab / name / path, image)
        if name == "broken":
            (lab / name / path).write_bytes(b"no picture at all")
    given = lab / name, lab / "board.toml", lab / "cameras.toml", more.split()
    assert why in said(2, "calibrate cameras {} --board {} --out {} {}", *given).err
    assert not (lab / "cameras.toml").exists()


def test_a_board_that_is_none(lab: Path, three_pairs: Path, said: Said) -> None:
    (lab / "board.toml").write_text('kind = "chessboard"\ncolumns = 7\nrows = 5\n', "utf-8")
    given = three_pairs, lab / "board.toml", lab / "cameras.toml"
    seen = said(2, "calibrate cameras {} --board {} --out {}", *given).err
    assert re.search(r"board\.toml(.|\n)*pitch_mm", seen)


def test_one_touched_point_is_too_few(lab: Path, in_lab: Said) -> None:
    text = "left_x,left_y,right_x,right_y,x_mm,y_mm,z_mm\n1,2,3,4,5,6,7\n"
    (lab / "points.csv").write_text(text, encoding="utf-8")
    cameras = RIGS / "thesis-calibration.toml"
    why = in_lab(2, "calibrate world points.csv --cameras {} --out w.toml", cameras).err
    assert "1 touched points are too few: at least 4" in why


def test_tables_of_pairs_need_the_pictures_size(lab: Path, in_lab: Said) -> None:
    columns = "thermal_x,thermal_y,left_x,left_y,right_x,right_y\n"
    (lab / "pairs.csv").write_text(columns, encoding="utf-8")
    for pairs, why in (("--pairs pairs.csv", "--pairs needs --image-size"), ("", WANTED)):
        assert why in in_lab(2, f"calibrate thermal {pairs} --out t.toml").err


@pytest.mark.parametrize("name", sorted(path.stem for path in BOARDS.glob("*.toml")))
def test_a_shipped_board_is_printed_in_true_size(name: str, tmp_path: Path) -> None:
    board = load_board(BOARDS / f"{name}.toml").board
    figure = board_figure(board)
    width, height = sheet_mm(board, None)
    dots_per_mm = 4
    figure.set_dpi(25.4 * dots_per_mm)
    figure.savefig(tmp_path / "board.png", dpi=25.4 * dots_per_mm)
    from bench.record.recording import read_grey

    image = read_grey(tmp_path / "board.png")
    assert image.shape == (height * dots_per_mm, width * dots_per_mm)
    found = find_board(image, board)
    assert len(found.ids) == board.columns * board.rows
    grid = np.column_stack([board.points_mm[found.ids, :2], np.ones(len(found.ids))])
    slopes = np.linalg.lstsq(grid, found.pixels_px, rcond=None)[0]
    np.testing.assert_allclose(slopes[:2] / dots_per_mm, np.eye(2), atol=1e-3)
    assert f"/MediaBox [ 0 0 {width * 72 / 25.4:.4f}"[:22].encode() in board_pdf(board)


def test_a_sheet_that_is_too_small(lab: Path, in_lab: Said) -> None:
    print_board = "calibrate board chessboard-9x6-40 --pdf"
    assert "more than A4 has; it fits A2" in in_lab(2, f"{print_board} b.pdf --paper A4").err
    in_lab(0, f"{print_board} b.pdf")
    assert (lab / "b.pdf").read_bytes().startswith(b"%PDF")
    nowhere = Path("typo/b.pdf")
    assert f"--pdf {nowhere}: there is no folder" in in_lab(2, f"{print_board} {{}}", nowhere).err
    assert not nowhere.parent.exists()


def test_each_format_comes_back_as_it_went(tmp_path: Path) -> None:
    part = load_calibration(RIGS / "calibration.toml").part
    assert part.right_from_left is not None
    write_opencv(part, tmp_path / "a.yml")
    write_bouguet(part, tmp_path / "b.mat")
    for taken in (read_opencv(tmp_path / "a.yml"), read_bouguet(tmp_path / "b.mat")):
        assert (taken.left, taken.right) == (part.left, part.right)
        assert taken.right_from_left is not None
        np.testing.assert_allclose(taken.right_from_left.R, part.right_from_left.R, atol=1e-12)
        np.testing.assert_allclose(taken.right_from_left.T, part.right_from_left.T, atol=1e-9)
    for camera in ("left", "right"):
        write_ros(part, tmp_path / f"{camera}.yaml", camera)
    taken = read_ros(tmp_path / "left.yaml", tmp_path / "right.yaml")
    assert (taken.left, taken.right) == (part.left, part.right)


def test_opencvs_own_file(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "opencv_stereo_chessboards" / "data" / "intrinsic.yml"
    with pytest.raises(ConfigError, match="`image_size`"):
        read_opencv(path)
    with pytest.raises(ConfigError, match="only k1 k2 p1 p2 k3 can be taken over"):
        read_opencv(path, (640, 480))


def test_files_of_other_tools_by_command(lab: Path, in_lab: Said) -> None:
    rig = RIGS / "thesis-calibration.toml"
    in_lab(0, "calibrate export {} --format bouguet --out c.mat", rig)
    in_lab(0, "calibrate import c.mat --format bouguet --out c.toml")
    assert 'with_what = "teatbench' in (lab / "c.toml").read_text(encoding="utf-8")


def test_the_published_calibration_ships_with_its_defects_stated() -> None:
    shipped = load_calibration(RIGS / "thesis-calibration.toml")
    published = thesis_published()
    assert shipped.left == published.left
    assert shipped.covariance is not None
    assert shipped.covariance.sd("left", "fx") == pytest.approx(0.9)
    np.testing.assert_allclose(shipped.homographies.left, published.homographies.left)
    text = (RIGS / "thesis-calibration.toml").read_text(encoding="utf-8")
    assert "1.000, 0.990 and 0.920" in text
    assert "no rigid motion" in text


def test_a_board_that_no_thermal_camera_sees_whole_is_refused_by_name(
    tmp_path: Path, said: Said
) -> None:
    board, out = "chessboard-9x6-40", tmp_path / "thermal.toml"
    cameras = RIGS / "calibration.toml"
    command = "calibrate thermal --rig emulated --board {} --cameras {} --out {}"
    why = said(2, command, board, cameras, out).err
    assert f"--board {board}: no place found for a board of 440 x 320 mm" in why
    assert "left and thermal see all of it: take a smaller board" in why
    assert not list(tmp_path.iterdir())
