"""Perturbations do what their physics says, and nothing where their amount is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.campaign.chunk import Bench, SceneId
from bench.campaign.perturbations import KINDS, Applied
from bench.campaign.plan import open_plan
from bench.rig.loading import RIGS, find_rig, load_rig
from bench.rig.scenes import warm
from instruments.camera.frame import FrameSet
from instruments.world.situations import situation
from tests.bench.campaign.small_campaign import run_chunk, small_plan

SEEDS = (1, 2, 3)
CALIBRATION = load_rig(find_rig(None)).calibration


def bar() -> FrameSet:
    """Pictures with a bright bar, and a thermal picture that falls from side to side."""
    grey = np.full((60, 80), 40, np.uint8)
    grey[:, 30:40] = 200
    ck = np.tile(np.linspace(29500, 30500, 40), (30, 1)).astype(np.uint16)
    thermal = np.tile(np.linspace(220, 30, 80), (60, 1)).astype(np.uint8)
    return FrameSet(grey, grey.copy(), thermal, ck)


def middle_px(image: np.ndarray) -> float:
    """Of the bright bar, along the rows."""
    light = image.astype(float).mean(axis=0) - 40.0
    return float(light @ np.arange(len(light)) / light.sum())


def changed(name: str, amount: float) -> FrameSet:
    return Applied(name, amount).frames(bar(), SEEDS)


@pytest.mark.parametrize("px", [3.0, -2.5, 0.5])
def test_pictures_out_of_step_move_the_right_one_alone(px: float) -> None:
    seen = changed("out-of-step", px)
    assert middle_px(seen.right) - middle_px(bar().right) == pytest.approx(px, abs=0.02)
    np.testing.assert_array_equal(seen.left, bar().left)


@pytest.mark.parametrize("px", [2.0, 5.0, 9.0])
def test_a_blur_spreads_by_what_a_box_of_its_length_does_and_only_along_its_way(px: float) -> None:
    def spread(image: np.ndarray) -> float:
        light = image.astype(float).mean(axis=0) - 40.0
        return float(light @ (np.arange(len(light)) - middle_px(image)) ** 2 / light.sum())

    # pixels at the kernel's ends count in part
    more = spread(changed("blur-across", px).left) - spread(bar().left)
    assert more == pytest.approx(px**2 / 12.0, abs=0.1 * px)
    np.testing.assert_array_equal(changed("blur-down", px).left, bar().left)
    more = spread(changed("defocus", px).left) - spread(bar().left)
    assert more == pytest.approx(px**2 / 4.0, rel=0.06)


def test_light_tone_compression_noise_and_dirt() -> None:
    assert changed("exposure", 1.2).left.max() == 240
    assert changed("exposure", 2.5).left.max() == 255
    assert changed("exposure", 0.5).right.min() == 20
    assert changed("gamma", 0.45).left[0, 35] == round(255 * (200 / 255) ** 0.45)
    rough = changed("jpeg", 40.0).left.astype(float) - bar().left
    assert rough.shape == bar().left.shape
    assert 0.0 < np.sqrt((rough**2).mean()) < 8.0
    noise = changed("noise", 5.0).left.astype(float) - bar().left
    assert noise.std() == pytest.approx(5.0, rel=0.05)
    dirty = changed("dirt", 4.0)
    assert (dirty.left <= bar().left).all()
    assert not np.array_equal(dirty.left, dirty.right)  # each lens has its own


def test_thermal_drift_and_noise_are_in_kelvin() -> None:
    before = bar().thermal_k
    drifted, noisy = changed("thermal-drift", 1.5), changed("thermal-noise", 0.3)
    assert before is not None
    assert drifted.thermal_k is not None
    assert noisy.thermal_k is not None
    np.testing.assert_allclose(drifted.thermal_k - before, 1.5, atol=1e-9)
    assert (noisy.thermal_k - before).std() == pytest.approx(0.3, rel=0.06)
    assert drifted.thermal is not None
    assert bar().thermal is not None
    np.testing.assert_array_equal(drifted.thermal, bar().thermal)  # its gain follows


def test_calibrations_are_off_by_what_geometry_says() -> None:
    ends = situation("ideal", 0).phantom.ends_mm
    left_px, right_px = CALIBRATION.project(ends)
    disparity_mm = CALIBRATION.depth_per_disparity_px_mm(ends)
    depth = CALIBRATION.world_from_right.inverse()

    def deeper_mm(name: str, amount: float) -> np.ndarray:
        told = Applied(name, amount).stated(CALIBRATION)
        return np.abs((depth.apply(told.place(left_px, right_px)) - depth.apply(ends))[:, 2])

    # the pair converges a little, and its axes are not quite parallel
    np.testing.assert_allclose(deeper_mm("column", 0.5), 0.5 * disparity_mm, rtol=0.1)
    focal_px = CALIBRATION.right.fc[0]
    vergence_px = np.radians(0.1) * focal_px
    np.testing.assert_allclose(deeper_mm("vergence", 0.1), vergence_px * disparity_mm, rtol=0.2)
    told = Applied("focal", 0.2).stated(CALIBRATION)
    np.testing.assert_allclose(np.array(told.left.fc), 1.002 * np.array(CALIBRATION.left.fc))
    told = Applied("thermal-pose", 0.3).stated(CALIBRATION)
    assert told.thermal_from_left is not None
    assert CALIBRATION.thermal_from_left is not None
    turn = told.thermal_from_left @ CALIBRATION.thermal_from_left.inverse()
    assert np.degrees(np.linalg.norm(turn.om)) == pytest.approx(0.3)


def test_scenes_get_cool_quarters_and_warm_rooms() -> None:
    state = warm(situation("ideal", 0))
    cooler = Applied("cool-quarters", 5.0).state(state, SEEDS)
    off = np.asarray(state.teat_temps_c) - cooler.teat_temps_c
    np.testing.assert_allclose(sorted(off), [0.0, 1.5, 3.0, 5.0])
    assert Applied("warm-room", 30.5).state(state, SEEDS).ambient_c == 30.5


def test_light_and_paint_of_a_scene_are_set_and_the_rest_stays() -> None:
    state = warm(situation("ideal", 0))
    painted = Applied("teat-paint", 0.5).state(state, SEEDS)
    assert painted.teat_paint == replace(state.teat_paint, albedo=0.5)
    assert Applied("teat-gloss", 0.2).state(state, SEEDS).teat_paint.gloss == 0.2
    assert Applied("board", 0.9).state(state, SEEDS).backdrop.board_albedo == 0.9
    dimmer = Applied("light", 0.5).state(state, SEEDS).lighting
    assert dimmer == replace(state.lighting, brightness=0.5 * state.lighting.brightness)
    even = Applied("even-light", 2.2).state(state, SEEDS).lighting
    assert (even.lamps, even.ambient) == ((), 2.2)
    assert replace(painted, teat_paint=state.teat_paint) == state


@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if kind.none is not None])
def test_no_amount_changes_no_byte(name: str) -> None:
    none = KINDS[name].none
    assert none is not None
    applied, frames, state = Applied(name, none), bar(), warm(situation("ideal", 0))
    assert applied.frames(frames, SEEDS) is frames
    assert applied.state(state, SEEDS) is state
    assert applied.stated(CALIBRATION) is CALIBRATION


@pytest.mark.slow
def test_a_plan_s_perturbations_are_in_its_rows_and_its_identity(tmp_path: Path) -> None:
    plain = small_plan(tmp_path)
    off = small_plan(tmp_path, perturbations=[{"name": "noise", "amount": 8.0}])
    (job, same), (other_job, other) = open_plan(plain), open_plan(off)
    assert same["plan"] != other["plan"]
    assert job.exact  # it draws by the calibration that detectors get
    elsewhere = (RIGS / "thesis-calibration.toml").as_posix()
    assert not open_plan(small_plan(tmp_path, calibration=elsewhere))[0].exact
    scene, rows = SceneId("ideal", 0), []
    for one in (job, other_job, other_job):
        bench: Bench = one.bench(one.renderer(), one.make_detectors())
        rows.append(run_chunk(bench, [scene]).scenes)
    assert rows[0] != rows[1] == rows[2]
