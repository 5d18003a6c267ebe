"""The thesis's chain on its own tables: the stages' pictures in golden/, and printed figures."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.protocol import Detection
from detector.thesis.detector import ThesisDetector, published_homography
from tests.detector import thesis_tables as tables
from tests.detector.thesis_fits import thesis_published

# Canny's edges at sigma 12 lie where the outline's corners are smoothed away, not on the outline
SIDE_COLUMNS, SIDE_ROWS, END_COLUMNS, END_ROWS = 2, 9, 16, 4


def golden(name: str) -> NDArray[np.uint8]:
    picture = cv2.imread(str(tables.GOLDEN / f"thesis-{name}.png"), cv2.IMREAD_GRAYSCALE)
    assert picture is not None, name
    return np.asarray(picture, dtype=np.uint8)


def points(found: Detection, stage: str, what: str = "points_px") -> NDArray[np.float64]:
    there = found.stage(stage)
    assert there is not None, found.reason
    return np.asarray(there.data[what], dtype=np.float64)


@pytest.fixture(scope="module")
def found() -> Detection:
    return published_homography().detect(tables.frames(), thesis_published())


def test_the_tables_are_the_published_ones(shared: Path) -> None:
    p = tomllib.loads((shared / "seed" / "published.toml").read_text(encoding="utf-8"))
    assert tables.TABLE_4_1.tolist() == p["thermal_detector"]["vertical_line_ends"]
    assert tables.TABLE_4_2.tolist() == p["thermal_detector"]["horizontal_middles"]
    assert tables.SECTION_4_1_7.tolist() == p["thermal_detector"]["teat_ends"]


def test_the_thermal_picture_is_the_drawn_one() -> None:
    assert np.array_equal(golden("thermal"), tables.thermal_picture())


@pytest.mark.parametrize("name", [*tables.MASKS, "regions"])
def test_every_stage_gives_its_picture(name: str) -> None:
    """Within a pixel: another machine's floats may put an edge on the other side of a tie."""
    made, kept = tables.stage_pictures()[name], golden(name)
    assert made.shape == kept.shape
    near = np.ones((3, 3), np.uint8)
    for one, other in ((made, kept), (kept, made)):
        assert not (one > cv2.dilate(other, near)).any()
    assert np.count_nonzero(made != kept) <= 0.05 * np.count_nonzero(kept)


def test_the_kept_verticals_end_where_table_4_1_says() -> None:
    mask = golden("verticals") > 0
    for column, row in tables.TABLE_4_1 - 1:
        low, high = int(column) - SIDE_COLUMNS, int(column) + SIDE_COLUMNS + 1
        strip = np.asarray(mask[:, low:high].any(axis=1))
        assert abs(int(np.argmax(strip)) - row) <= SIDE_ROWS
        assert strip[int(row) + SIDE_ROWS :].mean() > 0.95
    assert not mask[:, : 103 - SIDE_COLUMNS - 1].any()
    assert not mask[:, 407 + SIDE_COLUMNS + 1 :].any()


def test_the_kept_horizontals_lie_where_table_4_2_says() -> None:
    rows, columns = np.nonzero(golden("horizontals"))
    between = ((103, 147), (181, 221), (271, 315), (358, 406))
    groups = [(columns > low) & (columns < high) for low, high in between]
    assert sum(int(group.sum()) for group in groups) == len(columns)
    for group, (column, row) in zip(groups, tables.SECTION_4_1_7 - 1, strict=True):
        assert abs(columns[group].mean() - column) <= END_COLUMNS
        assert abs(rows[group] - row).max() <= END_ROWS


def test_the_chain_comes_out_at_the_tables(found: Detection) -> None:
    sides = np.abs(points(found, "vertical ends") + 1 - tables.TABLE_4_1)
    assert (sides <= [SIDE_COLUMNS, SIDE_ROWS]).all()
    ends = np.abs(points(found, "teat ends") - tables.SECTION_4_1_7)
    assert (ends <= [END_COLUMNS, END_ROWS]).all()
    assert (len(found.teats), found.hidden, found.reason) == (4, 0, None)
    for camera in ("left", "right"):
        nominated = points(found, "nominations", f"{camera}_px")
        assert np.abs(nominated - tables.optical_ends(camera)).max() <= 0.62 * END_COLUMNS + 1


def test_the_printed_homographies_are_those_of_the_printed_calibration(rig: Calibration) -> None:
    frames = tables.frames()
    printed, ours = published_homography().detect(frames, rig), ThesisDetector().detect(frames, rig)
    same = ThesisDetector().detect(frames, thesis_published())
    left, same_left = (points(found, "nominations", "left_px") for found in (printed, same))
    assert np.array_equal(left, same_left)
    right, our_right = (points(found, "nominations", "right_px") for found in (printed, ours))
    off = np.linalg.norm(right - our_right, axis=1)
    # published.toml, [derived]: at the plane of the teat ends the published homographies are about
    # 5.8 px off
    assert np.abs(off - 5.8).max() < 2.5


def test_the_printed_homographies_are_refused_for_other_pictures(rig: Calibration) -> None:
    frames = tables.frames()
    halved = replace(frames, left=np.ascontiguousarray(frames.left[::2, ::2]))
    text = published_homography().detect(
        halved, replace(rig, left=replace(rig.left, image_size=(680, 512)))
    )
    assert text.teats == ()
    sizes = "pictures of 640 x 480 and 1360 x 1024, not for the calibration's"
    assert text.reason == f"the published homographies are for {sizes}"
