"""Stereo's sensitivity to pixels: against OpenCV, geometry and the published figures."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from bench.config import ConfigError
from bench.report.pixel_offsets import beyond_axes, published_move_mm
from bench.rig.loading import find_rig, load_rig
from bench.script.model import TRIALS, find_script
from bench.script.pixel_offsets import (
    LoadedOffsets,
    is_offset_script,
    load_offsets,
    offset_errors,
    outcomes,
)
from detector.calibration import Calibration
from detector.geometry import Camera
from tests.bench.commands import Said

SCRIPT = TRIALS / "thesis-test-2.toml"
TENTH = """kind = "offsets"
title = "A tenth"
layout = "mine.toml"
limit_mm = 5.0
offsets = [{ teat = 1, left_px = 0.1 }]
"""


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return load_rig(find_rig(None)).calibration


@pytest.fixture
def published(shared_data: Path) -> dict[str, Any]:
    path = shared_data.parent / "seed" / "published.toml"
    return tomllib.loads(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def loaded() -> LoadedOffsets:
    return load_offsets(SCRIPT)


def matrix(camera: Camera) -> np.ndarray:
    (fx, fy), (u, v) = camera.fc, camera.cc
    return np.array([[fx, 0.0, u], [0.0, fy, v], [0.0, 0.0, 1.0]])


def by_opencv(
    calibration: Calibration, point_mm: np.ndarray, right_px: float, directions: int
) -> np.ndarray:
    """Errors (n, 3) mm of a point whose right picture is put off, by OpenCV."""
    right_from_world = calibration.world_from_right.inverse()
    left_from_right = calibration.right_from_left.inverse()
    in_right = right_from_world.apply(point_mm)
    in_left = left_from_right.apply(in_right)
    lenses = [(matrix(one), np.array(one.kc)) for one in (calibration.left, calibration.right)]
    left, right = (
        cv2.projectPoints(point[None], np.zeros(3), np.zeros(3), *lens)[0].reshape(1, 2)
        for point, lens in zip((in_left, in_right), lenses, strict=True)
    )
    angle = 2.0 * np.pi * np.arange(directions) / directions
    off = right + right_px * np.column_stack([np.cos(angle), np.sin(angle)])
    a = cv2.undistortPoints(np.repeat(left, directions, axis=0), *lenses[0]).reshape(-1, 2)
    b = cv2.undistortPoints(off, *lenses[1]).reshape(-1, 2)
    p_left = np.column_stack([left_from_right.R, left_from_right.T])
    found = cv2.triangulatePoints(p_left, np.eye(3, 4), a.T, b.T)
    return np.asarray(calibration.world_from_right.apply((found[:3] / found[3]).T) - point_mm)


def test_the_errors_are_those_that_opencv_gets(
    calibration: Calibration, loaded: LoadedOffsets
) -> None:
    """Where the offset makes rays skew, DLT and midpoint differ a little."""
    for point in loaded.points_mm:
        ours = offset_errors(calibration, point, 0.0, 2.0, 24)
        theirs = by_opencv(calibration, point, 2.0, 24)
        assert ours[[0, 12]] == pytest.approx(theirs[[0, 12]], abs=0.02)
        assert ours == pytest.approx(theirs, abs=0.5)
        assert np.abs(theirs).max() > 14.0


def test_a_pixel_of_disparity_is_what_the_geometry_says(
    published: dict[str, Any], calibration: Calibration, loaded: LoadedOffsets
) -> None:
    # its figures went through the published transformation, which shortens depth
    derived = published["derived"]
    low, high = (
        np.array(derived["depth_per_disparity_pixel_mm"])
        / derived["world_transformation_singular_values"][2]
    )
    for point in loaded.points_mm:
        # to the right, and to the left
        both_ways = offset_errors(calibration, point, 0.0, 1.0, 4)[[0, 2]]
        a_pixel = float(np.linalg.norm(both_ways, axis=1).mean())
        assert 0.97 * low <= a_pixel <= 1.03 * high


def test_the_script_says_what_the_thesis_printed(
    published: dict[str, Any], loaded: LoadedOffsets
) -> None:
    offsets = loaded.script.offsets
    known, plain, off = (published[f"table_5_{i}"]["teat_ends_mm"] for i in (1, 2, 3))
    assert loaded.points_mm == pytest.approx(np.array(known), abs=1e-9)
    assert [list(one.published_plain_mm or ()) for one in offsets] == plain
    assert [list(one.published_mm or ()) for one in offsets] == off
    sides = [{"left": one.left_px, "right": one.right_px} for one in offsets]
    asked = [{side: px for side, px in one.items() if px} for one in sides]
    assert asked == published["table_5_3"]["offsets_px"]
    assert loaded.script.limit_mm == published["requirements"]["max_error_mm"]


def test_no_direction_gives_the_published_errors_along_x(
    calibration: Calibration, loaded: LoadedOffsets
) -> None:
    """A pixel or two moves x by less than 3 mm; the thesis printed 4.7 to 8.5."""
    for one in outcomes(loaded, calibration):
        moved = published_move_mm(one.offset)
        assert moved is not None
        assert one.most_mm[0] < 3.0 < abs(moved[0])
        assert beyond_axes(one)[0] == "x"
        assert "y" not in beyond_axes(one), (
            "along the cameras' axis the printed figures are possible"
        )


def test_no_offset_is_no_error_and_twice_the_offset_about_twice(
    calibration: Calibration, loaded: LoadedOffsets
) -> None:
    point = loaded.points_mm[0]
    assert offset_errors(calibration, point, 0.0, 0.0, 8) == pytest.approx(
        np.zeros((1, 3)), abs=1e-6
    )
    small, twice = (offset_errors(calibration, point, 0.0, px, 8) for px in (0.05, 0.1))
    assert twice == pytest.approx(2.0 * small, rel=0.02, abs=1e-3)
    assert offset_errors(calibration, point, 1.0, 1.0, 6).shape == (36, 3)


def test_a_point_that_no_camera_sees_is_refused(calibration: Calibration) -> None:
    with pytest.raises(ConfigError, match="outside the left picture"):
        offset_errors(calibration, np.array([2000.0, 300.0, 135.0]), 1.0, 0.0, 8)


@pytest.mark.slow
def test_the_command_reports_and_reports_again(tmp_path: Path, said: Said) -> None:
    shown = said(1, "run thesis-test-2 --out {}", tmp_path).out
    assert "Verdict: not met (limit 5 mm)" in shown
    (folder,) = tmp_path.iterdir()
    page = (folder / "report" / "index.html").read_bytes()
    assert b"COMPUTED, NO INSTRUMENT" in page
    assert b"For teat 1, 2, 3, 4 no direction of the stated offset gives what was printed" in page
    kept = json.loads((folder / "report" / "run.json").read_text(encoding="utf-8"))
    assert [row["directions"] for row in kept["offsets"]] == [72 * 72, 72, 72, 72]
    said(1, "report {}", folder)
    assert (folder / "report" / "index.html").read_bytes() == page


@pytest.mark.slow
def test_an_offset_that_does_no_harm_is_met(tmp_path: Path, said: Said) -> None:
    (tmp_path / "mine.toml").write_text(
        'about = "x"\n[[teats]]\nname = "LF"\nbase_mm = [-190.0, 240.0]\n', encoding="utf-8"
    )
    (tmp_path / "tenth.toml").write_text(TENTH, encoding="utf-8")
    given = tmp_path / "tenth.toml", tmp_path / "runs"
    said(0, "run {} --dry-run --out {}", *given)
    assert not (tmp_path / "runs").exists()
    said(0, "run {} --out {}", *given)
    (folder,) = (tmp_path / "runs").iterdir()
    assert (folder / "mine.toml").is_file()
    assert b"not printed" in (folder / "report" / "index.html").read_bytes()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("teat = 4", "teat = 5", "offsets[4].teat: the layout has 4 teats"),
        ("left_px = 2.0\n", "", "has no offset"),
        ("directions = 72 ", "directions = 3 ", "greater than or equal to 4"),
        ('layout = "table-5-1"', 'layout = "table-5-2"', 'did you mean "table-5-1"'),
        ("limit_mm", "limt_mm", 'did you mean "limit_mm"'),
    ],
)
def test_a_wrong_script_says_where(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = SCRIPT.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "script.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigError, match=rf"{re.escape(str(path))}:(.|\n)*{re.escape(message)}"):
        load_offsets(path)


def test_only_a_script_of_its_kind_is_one() -> None:
    assert is_offset_script(SCRIPT)
    assert not is_offset_script(find_script(None))
