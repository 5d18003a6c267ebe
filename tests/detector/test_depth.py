"""The plain detector on depth alone: ends of drawn scenes with the covariances that it states, the
end itself without any error of the camera, and a sentence for what can't be used.
"""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.rig.loading import LoadedRig, find_rig, load_rig
from bench.rig.scenes import warm
from detector.depth import DepthDetector
from detector.external.serve import Pictures
from detector.protocol import Detection
from instruments.world.depth_camera import DepthCamera, DepthSensor
from instruments.world.optics import depth_from_calibration
from instruments.world.situations import situation
from tests.bench.commands import teatbench

Array = NDArray[np.float64]
FAMILIES = [
    "ideal",
    "non_vertical",
    "hot_body_at_ends",
    "cooler_bodies",
    "anywhere",
    "low_contrast",
]
NOTHING = np.zeros((2, 2), np.uint8)
USUAL = DepthSensor()
PERFECT = DepthSensor(noise_mm=0.0, cyclic_mm=0.0, second_path=0.0, blur_px=0.0)


@cache
def rig() -> LoadedRig:
    return load_rig(find_rig("emulated-depth"))


@cache
def camera(sensor: DepthSensor) -> DepthCamera:
    text = rig().calibration_path.read_text(encoding="utf-8")
    model = depth_from_calibration(tomllib.loads(text))
    assert model is not None
    return DepthCamera(model, sensor)


def seen(family: str, seed: int, sensor: DepthSensor = USUAL) -> tuple[Detection, Array]:
    """The answer on a member of a family, and its ends (n, 3)."""
    state = warm(situation(family, seed))
    tenths, _ = camera(sensor).expose(state, np.random.default_rng([seed, *family.encode()]))
    depth_mm = np.where(tenths > 0, tenths / 10.0, np.nan)
    pictures = Pictures(NOTHING, NOTHING, depth_mm=depth_mm)
    return DepthDetector().detect(pictures, rig().calibration), state.phantom.ends_mm


def matched(found: Detection, ends_mm: Array) -> tuple[Array, Array]:
    """Errors (n, 3) of answers within 25 mm of an end, and their squares by the covariances."""
    errors, squares = [], []
    for teat in found.teats:
        off = teat.world_mm - ends_mm
        nearest = off[np.argmin(np.linalg.norm(off, axis=1))]
        if np.linalg.norm(nearest) < 25.0:
            errors.append(nearest)
            squares.append(nearest @ np.linalg.solve(np.asarray(teat.covariance_mm2), nearest))
    return np.array(errors).reshape(-1, 3), np.array(squares)


@pytest.mark.weekly
def test_ends_of_drawn_scenes_and_the_covariances_that_are_stated() -> None:
    pairs = [seen(family, 300) for family in FAMILIES]
    both = [matched(*pair) for pair in pairs]
    errors, squares = (np.concatenate(parts) for parts in zip(*both, strict=True))
    assert len(errors) >= 0.85 * sum(len(ends) for _, ends in pairs)
    assert np.linalg.norm(errors, axis=1).mean() < 5.0
    # 95 % of chi squared with three degrees of freedom lie below
    assert np.mean(squares < 7.815) > 0.85
    assert squares.mean() > 0.9, "and the covariances aren't wide without need"


def test_without_errors_of_the_camera_an_end_is_within_a_pixel() -> None:
    found, ends_mm = seen("ideal", 300, PERFECT)
    errors, _ = matched(found, ends_mm)
    assert len(errors) == len(ends_mm)
    assert np.linalg.norm(errors, axis=1).max() < 2.6
    for teat in found.teats:
        pair = np.concatenate(rig().calibration.project(teat.world_mm[None]))
        assert np.allclose(np.stack([np.asarray(teat.left_px), np.asarray(teat.right_px)]), pair)


@pytest.mark.parametrize(
    ("depth_mm", "reason"),
    [
        (None, "there is no depth picture"),
        (np.ones((120, 160)), "is 160 x 120, the calibration is for 320 x 240"),
        (np.full((240, 320), np.nan), "measured nothing anywhere"),
        (np.full((240, 320), np.inf), "measured nothing anywhere"),
        (np.full((240, 320), 1000.0), "nothing narrow stands up"),
        (np.full((240, 320), -5.0), "measured nothing anywhere"),
        (np.random.default_rng(1).uniform(0.0, 6500.0, (240, 320)), "nothing narrow stands up"),
    ],
)
def test_what_cannot_be_used_is_a_sentence(depth_mm: Array | None, reason: str) -> None:
    pictures = Pictures(NOTHING, NOTHING, depth_mm=depth_mm)
    found = DepthDetector().detect(pictures, rig().calibration)
    assert (found.teats, found.hidden) == ((), 0)
    assert reason in str(found.reason)
    if depth_mm is not None:
        plain = replace(rig().calibration, depth=None, depth_from_left=None)
        why = DepthDetector().detect(pictures, plain).reason
        assert why == "the calibration has no depth camera ([cameras.depth] and [depth])"


@pytest.mark.slow
def test_the_depth_frame_is_in_the_report_of_a_recording(tmp_path: Path) -> None:
    """Three detectors side by side are scored by docs/detectors.md."""
    out, runs = tmp_path / "deep", tmp_path / "runs"
    draw = "scene record --rig emulated-depth --situation ideal --seeds 1 --out {}"
    assert teatbench(draw, out) == 0
    assert teatbench("score {} --detector depth --out {}", out, runs) in (0, 1, 4)
    (report,) = runs.glob("*/report")
    page = (report / "index.html").read_text(encoding="utf-8")
    assert "depth frame of trial" in page
    assert len([*(report / "images").glob("*-depth.jpg")]) == 1
    assert "depth: end" in page
