"""The whole chain: on drawn frames, on unusable frames, and under changes of known effect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.geometry import Motion
from detector.protocol import Detection, Detector
from detector.thesis.detector import ThesisDetector
from detector.thesis.parameters import ThesisParameters
from detector.thesis.thermal import unmirror

Array = NDArray[np.float64]
STAGES = [
    *("thermal", "edges", "verticals", "horizontals", "vertical ends", "horizontal middles"),
    *("teat ends", "nominations", "regions", "ends", "triangulation"),
]


@pytest.fixture(scope="module")
def frames(draw: Callable[..., Any], teats_mm: Array) -> Any:
    return draw(teats_mm)


def places(detection: Detection) -> Array:
    return np.array([teat.world_mm for teat in detection.teats]).reshape(-1, 3)


@pytest.fixture(scope="module")
def plain(frames: Any, rig: Calibration) -> Detection:
    return ThesisDetector().detect(frames, rig)


def refused(frames: Any, calibration: Calibration, **changes: Any) -> str:
    """Why nothing is found in the frames with these changes."""
    found = ThesisDetector().detect(replace(frames, **changes), calibration)
    assert found.teats == ()
    assert found.reason is not None
    return found.reason


def test_it_is_a_detector() -> None:
    detector: Detector = ThesisDetector()
    assert detector.name == "thesis"
    assert detector.parameters["canny_sigma_px"] == 12.0
    assert ThesisDetector(ThesisParameters(binary_level=0.5)).parameters != detector.parameters


def test_four_plain_teats_are_found(plain: Detection, teats_mm: Array) -> None:
    assert (len(plain.teats), plain.hidden, plain.reason) == (4, 0, None)
    # not a claim of accuracy: each is nearer to its own teat than to any other, and the method's
    # dilations sink every end
    off = places(plain) - teats_mm
    assert np.linalg.norm(off, axis=1).max() < 25
    assert (off[:, 2] < 0).all()


def test_every_stage_is_kept(plain: Detection, rig: Calibration) -> None:
    assert [stage.name for stage in plain.trace] == STAGES
    data = {stage.name: stage.data for stage in plain.trace}
    regions, ends = data["regions"], data["ends"]
    assert regions["left"].shape == regions["right_bright"].shape == (4, 41, 41)
    kept = ends["left_px"], ends["right_px"], data["teat ends"]["points_px"]
    for teat, *pixels in zip(plain.teats, *kept, strict=True):
        for seen, of_stage in zip(
            (teat.left_px, teat.right_px, teat.thermal_px), pixels, strict=True
        ):
            assert np.array_equal(np.asarray(seen), of_stage)
        assert teat.covariance_mm2 is None
    assert np.allclose(places(plain), rig.place(ends["left_px"], ends["right_px"]))
    assert plain.stage("no such stage") is None


def test_a_turned_world_turns_the_answers(frames: Any, plain: Detection, rig: Calibration) -> None:
    turned_from_world = Motion.from_vectors([0.3, -0.8, 1.1], [40.0, -500.0, 7.0])
    turned = replace(rig, world_from_right=turned_from_world @ rig.world_from_right)
    expected = turned_from_world.apply(places(plain))
    assert np.allclose(places(ThesisDetector().detect(frames, turned)), expected, atol=1e-9)


def test_an_unmirrored_camera(frames: Any, plain: Detection, rig: Calibration) -> None:
    straight = replace(frames, thermal=np.ascontiguousarray(frames.thermal[:, ::-1]))
    calibration = replace(rig, thermal=replace(rig.thermal, mirrored=False))
    same = ThesisDetector().detect(straight, calibration)
    assert np.array_equal(places(same), places(plain))


def test_only_the_regions_matter(frames: Any, plain: Detection, rig: Calibration) -> None:
    left = frames.left.copy()
    left[:300] = 0
    same = ThesisDetector().detect(replace(frames, left=left), rig)
    assert np.array_equal(places(same), places(plain))


def test_shifted_pictures_shift_the_ends(frames: Any, plain: Detection, rig: Calibration) -> None:
    left, right = (np.roll(picture, 2, axis=0) for picture in (frames.left, frames.right))
    after = ThesisDetector().detect(replace(frames, left=left, right=right), rig)
    before, moved = (np.array([teat.left_px for teat in one.teats]) for one in (plain, after))
    assert (moved - before).tolist() == [[0, 2]] * 4


def test_a_radiometric_frame_alone_will_do(frames: Any, plain: Detection, rig: Calibration) -> None:
    straight = cv2.resize(unmirror(frames.thermal), (160, 120), interpolation=cv2.INTER_AREA)
    kelvin = 306.0 - straight.astype(np.float64) * 0.05
    found = ThesisDetector().detect(replace(frames, thermal=None, thermal_k=kelvin), rig)
    assert len(found.teats) == 4
    assert np.linalg.norm(places(found) - places(plain), axis=1).max() < 8


def test_a_window_outside_may_be_refused(frames: Any, rig: Calibration) -> None:
    strict = ThesisDetector(ThesisParameters(window_outside="refuse")).detect(frames, rig)
    assert strict.teats == ()
    assert "leaves the thermal picture" in str(strict.reason)


def flat(shape: tuple[int, int], grey: int, warm: Any = np.s_[:0]) -> NDArray[np.uint8]:
    picture = np.full(shape, grey, dtype=np.uint8)
    picture[warm] = 30
    return picture


def test_tall_edges_without_tops_are_no_teats(frames: Any, rig: Calibration) -> None:
    tall = flat((480, 640), 200, np.s_[:, 200:260])
    found = ThesisDetector().detect(replace(frames, thermal=tall), rig)
    why = "the thermal picture shows no short horizontal line near the ends of the vertical ones"
    assert (found.teats, found.hidden, found.reason) == ((), 4, why)


def test_a_nomination_outside_of_a_picture_is_left_out(frames: Any, rig: Calibration) -> None:
    far = rig.homographies.left.copy()
    far[0, 2] -= 5000
    reason = refused(frames, replace(rig, homographies=replace(rig.homographies, left=far)))
    assert reason == "4 of 4 nominated teats lie outside of an optical picture"


def test_a_homography_that_leads_nowhere_is_survived(frames: Any, rig: Calibration) -> None:
    nowhere = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 1]])
    assert refused(frames, replace(rig, homographies=replace(rig.homographies, left=nowhere)))
