"""Each quantity's scenes have the value that they are said to have, and nothing else changes with
it.
"""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from bench.config import ConfigError
from bench.results import sensitivity
from bench.results.sensitivity import QUANTITIES, Optics, chosen
from bench.rig.loading import RIGS
from bench.rig.scenes import warm
from instruments.world.microbolometer import ThermalSensor
from instruments.world.scene import Renderer
from instruments.world.sensor import OpticalSensor
from instruments.world.situations import collisions, situation
from instruments.world.situations.situation import EYES_MM
from instruments.world.solids import clearance_mm

MEMBERS = range(6)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer.from_calibration(
        tomllib.loads((RIGS / "calibration.toml").read_text(encoding="utf-8")), 1
    )


@pytest.mark.parametrize("name", QUANTITIES)
def test_every_scene_can_be_set_up_is_seen_and_comes_again(name: str, renderer: Renderer) -> None:
    quantity = QUANTITIES[name]
    assert list(quantity.values) == sorted(quantity.values)
    for value in quantity.values:
        for member in MEMBERS:
            found = quantity.set_up(value, member, renderer)
            assert found == quantity.set_up(value, member, renderer)
            assert not list(collisions(found))
            assert renderer.visible_ends(warm(found)).all(axis=1).sum() >= 2


def test_the_range_is_the_mean_depth_of_the_ends(renderer: Renderer) -> None:
    for range_m in QUANTITIES["range"].values:
        found = sensitivity.at_range(range_m, 2, renderer)
        depth = renderer.cameras[1].camera_from_world(found.phantom.ends_mm)[:, 2]
        assert depth.mean() == pytest.approx(1e3 * range_m, abs=0.5)
        assert found.phantom.teats == situation("ideal", 2).phantom.teats


def test_the_contrast_is_that_of_the_picture(renderer: Renderer) -> None:
    """Grey levels in the middle of a teat's side and of the board beside it, as the left camera has
    them without noise.
    """
    for contrast in (0.03, 0.25, 0.85):
        state = warm(sensitivity.of_contrast(contrast, 1, renderer))
        picture = renderer.left.expected(state, renderer.shadows(state))
        teat = state.phantom.ends_mm[0] - 40.0 * state.phantom.axes[0]
        x, y = np.rint(renderer.cameras[0].project(teat[None])[0]).astype(int)
        offset = renderer.left.readout.sensor.offset_dn
        inside = picture[y - 5 : y + 6, x - 2 : x + 3].mean() - offset
        outside = (
            np.concatenate(
                [picture[y - 5 : y + 6, x + side - 2 : x + side + 3] for side in (-20, 20)]
            ).mean()
            - offset
        )
        assert 1.0 - inside / outside == pytest.approx(contrast, abs=0.02)
        assert 120.0 < outside < 235.0


def test_all_teats_lean_by_the_angle_said(renderer: Renderer) -> None:
    for lean_deg in (0.0, 10.0, 22.0):
        axes = sensitivity.leaning(lean_deg, 0, renderer).phantom.axes
        assert np.degrees(np.arccos(np.clip(axes[:, 2], -1.0, 1.0))) == pytest.approx(
            lean_deg, abs=1e-4
        )


def test_the_far_teat_is_covered_by_the_share_said(renderer: Renderer) -> None:
    for share in (-0.4, 0.2, 0.5):
        phantom = sensitivity.overlapping(share, 1, renderer).phantom
        for near, far in ((0, 2), (1, 3)):
            left, right = [], []
            for teat in (near, far):
                away = phantom.ends_mm[teat] - np.asarray(EYES_MM[2])
                radius = phantom.teats[teat].shape.radius_mm / away[1]
                left.append(away[0] / away[1] - radius)
                right.append(away[0] / away[1] + radius)
            covered = min(right) - max(left)
            assert covered / (right[1] - left[1]) == pytest.approx(share, abs=1e-6)
            assert phantom.ends_mm[far, 1] - phantom.ends_mm[near, 1] == pytest.approx(
                sensitivity.BEHIND_MM
            )


def test_the_arm_is_as_far_behind_the_teats_as_said(renderer: Renderer) -> None:
    for gap_mm in (10.0, 100.0):
        for member in (0, 1):
            found = sensitivity.before_arm(gap_mm, member, renderer)
            (arm,) = found.objects
            nearest = min(
                hull.a_mm[1] - max(hull.radius_a_mm, hull.radius_b_mm) for hull in arm.hulls
            )
            farthest = max(hull.b_mm[1] + hull.radius_b_mm for hull in found.phantom.teat_hulls())
            assert nearest - farthest == pytest.approx(gap_mm, abs=1e-6)
            assert (
                min(
                    clearance_mm(hull, teat)
                    for hull in arm.hulls
                    for teat in found.phantom.teat_hulls()
                )
                >= gap_mm - 1e-6
            )


def test_sensors_get_the_noise_said() -> None:
    usual = Optics(OpticalSensor(), ThermalSensor())
    noisy = QUANTITIES["pixel-noise"].optics(8.0, usual)
    assert noisy.optical.read_noise_e * noisy.optical.gain_dn_per_e == pytest.approx(8.0)
    assert noisy.thermal == usual.thermal
    assert QUANTITIES["netd"].optics(2.0, usual).thermal.netd_k == 2.0
    assert QUANTITIES["netd"].optics(2.0, usual).optical == usual.optical
    assert QUANTITIES["tilt"].optics(2.0, usual) is usual


def test_quantities_are_chosen_by_name() -> None:
    assert chosen([]) == tuple(QUANTITIES.values())
    assert [one.name for one in chosen(["netd", "tilt", "netd"])] == ["netd", "tilt"]
    with pytest.raises(
        ConfigError,
        match=r"no quantity 'contrats'; did you mean \"contrast\"\? \(known: pixel-noise",
    ):
        chosen(["contrats"])
