"""What goes wrong with pictures of a board: each mistake its own sentence, with the picture's name
and what would fit. A calibration is judged where teats stand, wherever the board was shown.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.calibrate.cameras import calibrate_pair
from bench.calibrate.views import BoardViews, find_pictures, find_views
from bench.config import ConfigError
from bench.report.calibration import cameras_sentence
from detector.calibration import Part, dump_calibration
from detector.calibration.boards import Board
from detector.calibration.corners import DetectedBoard
from tests.bench.calibrate.board_pictures import (
    BOARD,
    BOARD_TOML,
    LEFT,
    RIGHT,
    RIGHT_FROM_LEFT,
    SIZE,
    write_pairs,
)
from tests.bench.commands import Said

pytestmark = pytest.mark.slow

PAIRS = 7
Views = dict[str, dict[str, DetectedBoard]]


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pairs(tmp_path_factory.mktemp("drawn") / "day", PAIRS)


@pytest.fixture(scope="module")
def seen(drawn: Path) -> BoardViews:
    return find_views(find_pictures([drawn], ("left", "right")), BOARD)


def with_views(seen: BoardViews, change: Callable[[Views], None]) -> BoardViews:
    found = {camera: dict(views) for camera, views in seen.found.items()}
    change(found)
    return replace(seen, found=found)


def exchanged(views: Views) -> None:
    views["left"]["03"], views["right"]["03"] = views["right"]["03"], views["left"]["03"]


def turned(camera: str) -> Callable[[Views], None]:
    """As the finder has it: the same points, which it counts from the other end."""

    def change(views: Views) -> None:
        one = views[camera]["03"]
        pixels = np.array(SIZE) - 1.0 - one.pixels_px
        views[camera]["03"] = replace(one, pixels_px=pixels[::-1].copy())

    return change


def of_another_moment(views: Views) -> None:
    views["left"]["03"] = views["left"]["05"]


def numbered_otherwise(views: Views) -> None:
    views["right"] = {f"r{name}": one for name, one in views["right"].items()}


NO_PAIR = "^left 03 and right 03 are no pair like the 6 others: "


@pytest.mark.parametrize(
    ("mistake", "why"),
    [
        (exchanged, f"{NO_PAIR}exchanged they fit the other pairs. Exchange them$"),
        (turned("right"), f"{NO_PAIR}turned by half a turn, right 03 fits. Turn it$"),
        (turned("left"), f"{NO_PAIR}turned by half a turn, left 03 fits. Turn it$"),
        (of_another_moment, f"{NO_PAIR}the board was elsewhere in the one than in the other"),
        (
            numbered_otherwise,
            "share 0 views.*left has 00, 01, 02 to 06, right has r00, r01, r02 to",
        ),
    ],
)
def test_pictures_that_are_no_pair_are_named_with_what_fits(
    seen: BoardViews, mistake: Callable[[Views], None], why: str
) -> None:
    with pytest.raises(ConfigError, match=why):
        calibrate_pair(with_views(seen, mistake), model="k1 k2")


@pytest.mark.parametrize("times", [0.1, 10.0])
def test_a_board_in_another_unit_is_named(seen: BoardViews, times: float) -> None:
    other = replace(seen, board=replace(BOARD, pitch_mm=times * BOARD.pitch_mm))
    found = calibrate_pair(other, model="k1 k2")
    (first, *_) = found.findings
    assert first.name == "wrong unit"
    assert "are the points 40 mm" in first.sentence
    assert cameras_sentence(found).startswith("Not good enough: wrong unit")


def test_fewer_pictures_never_make_it_better(seen: BoardViews) -> None:
    """The limit is held against 1.2 m, not against where boards were shown."""

    def good_mm(count: int, at_mm: float) -> float:
        names = sorted(seen.found["left"])[:count]
        few = {camera: {n: views[n] for n in names} for camera, views in seen.found.items()}
        found = calibrate_pair(replace(seen, found=few), model="k1 k2")
        text = cameras_sentence(found, at_mm)
        match = re.search(
            rf"Good to ([\d.]+) mm at {at_mm / 1000:.2f} m; at most 1.25 mm is asked for", text
        )
        assert match
        assert text.startswith("Not good enough") == (float(match[1]) > 5.0)
        assert found.not_shown(at_mm) or at_mm < 2000.0
        return float(match[1])

    near, far = good_mm(PAIRS, 1200.0), good_mm(PAIRS, 4000.0)
    assert near < good_mm(4, 1200.0)
    assert far > 5.0


@pytest.mark.parametrize(
    ("columns", "rows", "then"), [(8, 6, ": squares are"), (5, 4, r"\. Write col")]
)
def test_a_board_counted_otherwise_is_named(
    drawn: Path, columns: int, rows: int, then: str
) -> None:
    every = find_pictures([drawn], ("left", "right"))
    few = {camera: dict(list(views.items())[1:2]) for camera, views in every.items()}
    why = rf"left.0\d\.png: holds a chessboard of (7 x 5|5 x 7) inner corners.* {columns} x {rows}{then}"
    with pytest.raises(ConfigError, match=why):
        find_views(few, Board("chessboard", columns, rows, 40.0))


def test_a_picture_of_another_size_is_named_not_those_of_most(drawn: Path, tmp_path: Path) -> None:
    day, name = shutil.copytree(drawn, tmp_path / "day"), "left/00.png"
    image = cv2.imread(str(day / name))
    assert image is not None
    cv2.imwrite(str(day / name), cv2.resize(image, (320, 240)))
    why = r"png: 320 x 240 px, but 6 of the 7 left pictures have 480 x 360: .*Take it out"
    with pytest.raises(ConfigError, match=r"00\." + why):
        find_views(find_pictures([day], ("left", "right")), BOARD)


def test_a_picture_that_cannot_be_read_is_left_out_by_name(drawn: Path, tmp_path: Path) -> None:
    day = shutil.copytree(drawn, tmp_path / "day")
    (day / "left" / "04.png").write_bytes(b"no picture")
    (day / "right" / "03.png").unlink()
    found = find_views(find_pictures([day], ("left", "right")), BOARD)
    why = {(one.camera, one.view): one.reason for one in found.refused}
    assert "04.png: is not an image that can be read" in why.pop(("left", "04"))
    assert why == {("left", "03"): "it has no partner right 03, so it is no pair"}
    assert [pair.name for pair in found.pairs()] == ["00", "01", "02", "05", "06"]
    for path in (day / "right").iterdir():
        path.write_bytes(b"no picture")
    with pytest.raises(ConfigError, match=r"no right picture can be read: "):
        find_views(find_pictures([day], ("left", "right")), BOARD)


def test_a_right_hand_set_of_another_size_is_said_at_once(drawn: Path, tmp_path: Path) -> None:
    day, looked = shutil.copytree(drawn, tmp_path / "day"), list[int]()
    for path in (day / "right").iterdir():
        image = cv2.imread(str(path))
        assert image is not None
        cv2.imwrite(str(path), cv2.resize(image, (320, 240)))
    with pytest.raises(ConfigError, match="differ in size, 480 x 360 and 320 x 240 px"):
        find_views(
            find_pictures([day], ("left", "right")),
            BOARD,
            report=lambda done, _: looked.append(done),
        )
    assert looked[-1] == len(list((day / "left").iterdir())), "at the first right-hand picture"


def test_a_check_that_looked_at_too_little_is_no_objection_of_none(
    drawn: Path, tmp_path: Path, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    part = Part(LEFT, RIGHT, RIGHT_FROM_LEFT)
    Path("c.toml").write_text(dump_calibration(part), encoding="utf-8")
    Path("board.toml").write_text(BOARD_TOML, encoding="utf-8")
    for count, code, words in (
        (2, 4, "not checked: 2 views of the board tell nothing"),
        (3, 0, ""),
    ):
        for camera in ("left", "right"):
            for path in sorted((drawn / camera).iterdir())[:count]:
                Path("few", camera).mkdir(parents=True, exist_ok=True)
                shutil.copy(path, Path("few", camera, path.name))
        found = said(code, "calibrate check c.toml few --board board.toml --page page")
        assert words in found.err
        assert ("It still holds" in found.out) == (code == 0)
        page = Path("page/index.html").read_text(encoding="utf-8")
        assert ("Not decided." in page) == (code == 4)
