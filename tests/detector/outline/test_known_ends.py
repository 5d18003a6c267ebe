"""Where the pictures show ends whose places are known, and a calibration that puts them elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from bench.campaign.perturbations import Applied
from detector.calibration import Calibration
from detector.external.serve import Pictures
from detector.outline.known_ends import offsets_at
from tests.detector.fused.conftest import Body, Draw

pytestmark = pytest.mark.slow

Expected = tuple[float, float, float]  # disparity and rows, px; thermal columns, sensor px


@pytest.fixture(scope="module")
def frames(draw_scene: Draw, udder: list[Body]) -> Pictures:
    return draw_scene(udder)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (None, (0.0, 0.0, 0.0)),
        ("column=0.5", (0.5, 0.0, 0.0)),
        ("row=0.5", (0.0, -0.5, 0.0)),
        ("thermal-pose=0.1", (0.0, 0.0, -0.95)),
        ("row=-8", (0.0, 8.0, 0.0)),
        ("column=-18", (-18.0, 0.0, 0.0)),
        ("thermal-pose=0.8", (0.0, 0.0, -7.3)),
    ],
)
def test_what_the_calibration_gets_wrong_is_measured(
    frames: Pictures, rig: Calibration, udder: list[Body], change: str | None, expected: Expected
) -> None:
    stated = Applied.parse(change).stated(rig) if change else rig
    found = offsets_at(frames, stated, np.array([body.end_mm for body in udder]))
    figures = np.array([[one.disparity_px, one.rows_px, one.thermal_px[0]] for one in found])
    np.testing.assert_allclose(np.median(figures.astype(float), axis=0), expected, atol=0.06)


def test_what_is_farther_off_is_no_figure(
    frames: Pictures, rig: Calibration, udder: list[Body]
) -> None:
    stated = Applied("row", 14.0).stated(rig)
    found = offsets_at(frames, stated, np.array([body.end_mm for body in udder]))
    assert {(one.disparity_px, one.rows_px) for one in found} == {(None, None)}


def test_an_end_that_no_picture_shows_has_no_offset(
    frames: Pictures, rig: Calibration, udder: list[Body]
) -> None:
    nowhere = np.array([udder[0].end_mm]) + np.array([[0.0, 0.0, 90.0]])
    (found,) = offsets_at(frames, rig, nowhere)
    assert (found.disparity_px, found.rows_px, found.thermal_px) == (None, None, (None, None))
