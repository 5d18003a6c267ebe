"""The physical limits against what they stand for: simulated edges, closed forms of stereo, the
sensor's model, and their own scaling.
"""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erf

from bench.results import sensitivity_limits
from bench.results.sensitivity import shifts_mm
from bench.results.sensitivity_limits import Outline, outline_of
from bench.rig.loading import RIGS
from bench.rig.scenes import warm
from detector.calibration import Calibration, ParameterCovariance, load_calibration
from instruments.world.scene import Renderer
from instruments.world.sensor import OpticalSensor
from instruments.world.situations import situation
from instruments.world.state import SceneState
from instruments.world.thermal_camera import ThermalSensor


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return load_calibration(RIGS / "calibration.toml")


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer.from_calibration(
        tomllib.loads((RIGS / "calibration.toml").read_text(encoding="utf-8")), 1
    )


@pytest.fixture(scope="module")
def state() -> SceneState:
    return warm(situation("ideal", 3))


def test_no_estimate_of_an_edge_scatters_less_than_its_information_says() -> None:
    """Edges drawn pixel by pixel, their place estimated by matching the true profile: the scatter
    is the bound, within its own error.
    """
    sigma_px, contrast, noise, rows, trials = 0.9, 80.0, 4.0, 12, 3000
    rng = np.random.default_rng(5)
    x = np.arange(-10.0, 11.0)
    profile = 0.5 * contrast * (1.0 + erf(x / (np.sqrt(2.0) * sigma_px)))
    slope = -contrast / (np.sqrt(2.0 * np.pi) * sigma_px) * np.exp(-(x**2) / (2.0 * sigma_px**2))
    seen = profile + noise / np.sqrt(rows) * rng.standard_normal((trials, len(x)))
    estimated = (seen - profile) @ slope / (slope @ slope)
    outline = Outline(
        np.tile([1.0, 0.0], (rows, 1)),
        np.ones(rows),
        np.zeros(rows),
        np.full(rows, contrast),
        np.zeros(rows),
    )
    information = sensitivity_limits.edge_information(outline, sigma_px, np.full(rows, noise))
    assert estimated.std() == pytest.approx(information[0, 0] ** -0.5, rel=0.05)
    assert information[1, 1] == 0.0


def test_noise_is_that_of_the_sensors_own_frames() -> None:
    sensor = replace(OpticalSensor(), prnu=0.0, dsnu_e=0.0, read_noise_e=60.0)
    electrons = 6500.0
    grey = sensor.offset_dn + electrons * sensor.gain_dn_per_e
    drawn = np.rint(
        grey
        + sensor.gain_dn_per_e
        * np.sqrt(electrons + 60.0**2)
        * np.random.default_rng(2).standard_normal(200_000)
    )
    assert sensitivity_limits.noise_dn(sensor, np.array([grey]), 1.0)[0] == pytest.approx(
        drawn.std(), rel=0.01
    )
    assert (
        sensitivity_limits.noise_dn(sensor, np.array([grey]), 2.0)[0]
        < 2.0 * sensitivity_limits.noise_dn(sensor, np.array([grey]), 1.0)[0]
    )


def test_an_outline_lies_where_the_picture_changes(renderer: Renderer, state: SceneState) -> None:
    """Dark teats before a light board: what is called inside is dark, what is outside is light, all
    along the upper outline.
    """
    found = replace(
        state,
        teat_paint=replace(state.teat_paint, albedo=0.05),
        backdrop=replace(state.backdrop, board_albedo=0.6),
    )
    picture = renderer.left.expected(found, renderer.shadows(found))
    outline = outline_of(found.phantom, 0, renderer.cameras[0], picture)
    top = outline.below_mm < 50.0
    assert np.count_nonzero(top) > 100
    assert (outline.outside[top] > 2.0 * outline.inside[top]).all()
    assert np.linalg.norm(outline.normal, axis=1) == pytest.approx(1.0)
    # the top of the end faces up in the picture
    assert outline.normal[outline.below_mm == 0.0][:, 1].min() < -0.99
    focal, depth = 1290.0, renderer.cameras[0].camera_from_world(found.phantom.ends_mm[:1])[0, 2]
    both_sides = 2.0 * (
        found.phantom.teats[0].shape.length_mm - found.phantom.teats[0].shape.radius_mm - 8.0
    )
    around = np.pi * found.phantom.teats[0].shape.radius_mm
    assert outline.length_px.sum() == pytest.approx((both_sides + around) * focal / depth, rel=0.05)


def test_the_limit_is_the_disparitys_noise_times_z_squared_over_f_b(
    renderer: Renderer, state: SceneState, calibration: Calibration
) -> None:
    covariance = sensitivity_limits.end_covariances(renderer, state, [1])[0]
    end = state.phantom.ends_mm[1]
    per_picture = []
    for eye, camera in (
        (renderer.left, renderer.cameras[0]),
        (renderer.right, renderer.cameras[1]),
    ):
        outline = outline_of(state.phantom, 1, camera, eye.expected(state, renderer.shadows(state)))
        noise = sensitivity_limits.noise_dn(
            eye.readout.sensor, 0.5 * (outline.inside + outline.outside), 1.0
        )
        depth = float(camera.camera_from_world(end[None])[0, 2])
        information = sensitivity_limits.edge_information(
            outline,
            sensitivity_limits.edge_sigma_px(eye.readout.sensor, depth, float(camera.fc.mean())),
            noise,
        )
        per_picture.append(1.0 / information[0, 0])
    along = calibration.world_from_right.R[:, 2]
    depth_sd = float(np.sqrt(along @ covariance @ along))
    disparity_sd = float(np.sqrt(sum(per_picture)))
    assert depth_sd == pytest.approx(
        float(calibration.depth_per_disparity_px_mm(end)[0]) * disparity_sd, rel=0.03
    )


@pytest.mark.slow
def test_limits_grow_with_noise_and_shrink_with_contrast(
    renderer: Renderer, state: SceneState
) -> None:
    table = tomllib.loads((RIGS / "calibration.toml").read_text(encoding="utf-8"))
    noisy = Renderer.from_calibration(
        table, 1, optical=replace(OpticalSensor(), read_noise_e=800.0)
    )
    board = replace(state.backdrop, board_albedo=0.62, board_texture=0.0)
    dark, grey = (
        replace(state, backdrop=board, teat_paint=replace(state.teat_paint, albedo=a))
        for a in (0.05, 0.4)
    )
    best, worse, worst = (
        np.trace(sensitivity_limits.end_covariances(*each, [0])[0])
        for each in ((renderer, dark), (renderer, grey), (noisy, grey))
    )
    assert best < worse < worst


def test_quantiles_are_those_of_a_shifted_normal_distribution() -> None:
    one_axis = np.diag([1e-12, 1e-12, 4.0])[None]
    median, p95 = sensitivity_limits.error_quantiles_mm(one_axis, np.zeros((1, 3)), (0.5, 0.95))
    assert median == pytest.approx(2.0 * 0.6745, rel=0.05)
    assert p95 == pytest.approx(2.0 * 1.96, rel=0.05)
    shifted = sensitivity_limits.error_quantiles_mm(
        1e-12 * np.eye(3)[None], np.array([[3.0, 4.0, 0.0]]), (0.5,)
    )
    assert shifted[0] == pytest.approx(5.0, abs=1e-4)


@pytest.mark.slow
def test_a_thermal_picture_shows_teats_until_noise_drowns_what_all_their_pixels_hold(
    state: SceneState,
) -> None:
    table = tomllib.loads((RIGS / "calibration.toml").read_text(encoding="utf-8"))
    shares = []
    for netd_k in (0.05, 5.0, 40.0, 400.0):
        eyes = Renderer.from_calibration(
            table, 1, thermal=replace(ThermalSensor.from_calibration(table), netd_k=netd_k)
        )
        shares.append(sensitivity_limits.nominated_share(eyes, state, [0, 1, 2, 3]))
    assert shares[0] == pytest.approx(1.0, abs=1e-9)
    assert shares[1] == pytest.approx(1.0, abs=1e-6)
    assert shares[1] > shares[2] > shares[3]
    assert shares[3] < 0.01


def test_miscalibration_moves_perfect_pixels_as_its_covariance_says(
    calibration: Calibration, state: SceneState
) -> None:
    size_px, ends = 0.05, state.phantom.ends_mm
    shifts = np.array(
        [
            shifts_mm(calibration, sensitivity_limits.told(size_px, seed, calibration), ends)
            for seed in range(300)
        ]
    )
    spread = ParameterCovariance(
        tuple(sensitivity_limits.SPREAD_PER_PX),
        np.diag([(size_px * one) ** 2 for one in sensitivity_limits.SPREAD_PER_PX.values()]),
    )
    expected = replace(calibration, covariance=spread).covariance_of(ends)
    rms = np.sqrt((shifts**2).sum(axis=2).mean(axis=0))
    assert rms == pytest.approx(np.sqrt(np.trace(expected, axis1=1, axis2=2)), rel=0.15)


def test_miscalibration_is_seeded_scales_and_leaves_the_rest_alone(
    calibration: Calibration,
) -> None:
    one, twice = (sensitivity_limits.told(size, 4, calibration) for size in (0.1, 0.2))
    assert sensitivity_limits.told(0.1, 4, calibration).left == one.left
    assert sensitivity_limits.told(0.1, 5, calibration).left != one.left
    moved = np.subtract(one.left.cc, calibration.left.cc)
    assert np.subtract(twice.left.cc, calibration.left.cc) == pytest.approx(2.0 * moved)
    before = calibration.right_from_left.T
    carried = one.right_from_left.T - before
    assert np.allclose(twice.right_from_left.T, before + 2.0 * carried)
    assert one.world_from_right is calibration.world_from_right
    assert one.thermal_from_left is calibration.thermal_from_left
    assert shifts_mm(
        calibration,
        sensitivity_limits.told(0.0, 4, calibration),
        np.array([[-150.0, 240.0, 135.0]]),
    ) == pytest.approx(0.0, abs=1e-6)
