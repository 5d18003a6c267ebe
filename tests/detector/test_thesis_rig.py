"""The emulated rig's calibration: made from published figures, and as close to them as it says."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from detector.calibration import Calibration, load_calibration
from detector.calibration import thesis_rig as printed
from detector.geometry import Array, apply_homography
from tests.detector import thesis_fits as made

CORNERS = np.array([[0.0, 0], [639, 0], [0, 479], [639, 479], [319.5, 239.5]])


def mapped(calibration: Calibration, side: str) -> Array:
    """Where the homography puts the thermal picture's corners and middle."""
    return apply_homography(getattr(calibration.homographies, side), CORNERS)


def test_constants_are_the_published_ones(shared: Path) -> None:
    p = tomllib.loads((shared / "seed" / "published.toml").read_text(encoding="utf-8"))
    for camera, name in ((printed.LEFT, "left"), (printed.RIGHT, "right")):
        entry = p["cameras"][name]
        for key in ("image_size", "fc", "cc", "kc"):
            assert list(getattr(camera, key)) == entry[key]
    assert list(printed.STEREO_OM_RAD) == p["stereo"]["om"]
    assert list(printed.STEREO_T_MM) == p["stereo"]["T"]
    assert np.array_equal(printed.HOMOGRAPHY_LEFT, p["homography"]["left"])
    assert np.array_equal(printed.HOMOGRAPHY_RIGHT, p["homography"]["right"])
    world = np.column_stack([made.WORLD_MATRIX, made.WORLD_T_MM])
    assert np.array_equal(world, p["world"]["transformation"][:3])
    assert np.array_equal(made.TEAT_ENDS_MM, p["table_5_2"]["teat_ends_mm"])


def test_the_shipped_file_is_what_the_fits_give(rig: Calibration) -> None:
    fresh = made.thesis_rig()
    assert (rig.left, rig.right) == (fresh.left, fresh.right)
    for name in ("world_from_right", "right_from_left"):
        shipped, again = getattr(rig, name), getattr(fresh, name)
        assert np.allclose(shipped.R, again.R, atol=1e-7)
        assert np.allclose(shipped.T, again.T, atol=1e-4)
    assert rig.thermal.lens is not None
    assert fresh.thermal.lens is not None
    assert np.allclose(rig.thermal.lens.fc, fresh.thermal.lens.fc, atol=1e-3)
    for side in ("left", "right"):
        one, other = mapped(rig, side), mapped(fresh, side)
        assert np.abs(one - other).max() < 1e-3


def test_the_world_is_rigid_and_shows_the_teats_as_printed(rig: Calibration) -> None:
    assert np.linalg.det(rig.world_from_right.R) == pytest.approx(1.0, abs=1e-12)
    teats = np.array(made.TEAT_ENDS_MM)
    A, t = np.array(made.WORLD_MATRIX), np.array(made.WORLD_T_MM)
    in_right = (np.linalg.inv(A) @ (teats - t).T).T
    left_px, right_px = rig.project(teats)
    assert np.linalg.norm(right_px - rig.right.project(in_right), axis=1).max() < 0.7
    printed_left_px = rig.left.project(rig.right_from_left.inverse().apply(in_right))
    assert np.linalg.norm(left_px - printed_left_px, axis=1).max() < 0.7


def test_the_thermal_camera_meets_the_printed_homographies_as_derived() -> None:
    fit = made.fit_thermal()
    assert fit.plane_depth_mm == pytest.approx(1168.0, abs=1.0)  # [derived] homography_plane_mm
    assert fit.lens.fc == pytest.approx((2088.0, 2088.0), abs=5.0)
    assert fit.rms_px == pytest.approx(3.2, abs=0.1)
    vertical = fit.residual_px[:, :, 1].mean(axis=1)
    # homography_stereo_vertical_disagreement_px
    assert vertical[0] - vertical[1] == pytest.approx(6.3, abs=0.1)
    assert max(fit.rms_without_constant_px) < 0.9
    centre = fit.thermal_from_right.inverse().T
    to_left = np.linalg.norm(centre - made.right_from_left().T)
    assert np.linalg.norm(centre) == pytest.approx(to_left)


def test_homographies_are_right_on_their_plane_and_wrong_off_it(rig: Calibration) -> None:
    assert rig.thermal.lens is not None
    assert rig.thermal_from_right is not None
    assert rig.homographies.plane_depth_mm is not None
    rng = np.random.default_rng(5)
    for off_mm, least, most in ((0.0, 0.0, 0.8), (60.0, 2.0, 6.0)):
        depth_mm = np.full(900, rig.homographies.plane_depth_mm + off_mm)
        x, y = rng.uniform(-300, 150, 900), rng.uniform(-200, 150, 900)
        points = np.column_stack([x, y, depth_mm])
        thermal_px = rig.thermal.lens.project(rig.thermal_from_right.apply(points))
        shown = np.all((thermal_px >= 0) & (thermal_px <= [639, 479]), axis=1)
        thermal_px, points = thermal_px[shown], points[shown]
        assert len(points) > 100
        off_px = apply_homography(rig.homographies.right, thermal_px) - rig.right.project(points)
        assert least <= np.linalg.norm(off_px, axis=1).max() <= most


def test_the_plane_of_the_homographies_is_that_of_the_teats(rig: Calibration) -> None:
    depths = rig.world_from_right.inverse().apply(made.TEAT_ENDS_MM)[:, 2]
    assert rig.homographies.plane_depth_mm == pytest.approx(depths.mean(), abs=1e-3)
    # f B / Z^2 over the teats' depths; the derived 7.6 to 9.3 hold in the printed world, which is 8
    # % short along this axis
    assert rig.depth_per_disparity_px_mm(made.TEAT_ENDS_MM).min() > 7.6 / 0.92 - 0.2
    assert rig.depth_per_disparity_px_mm(made.TEAT_ENDS_MM).max() < 9.3 / 0.92


def test_an_independent_fit_agrees_to_a_few_pixels(rig: Calibration, shared: Path) -> None:
    other = load_calibration(shared / "data" / "path_traced" / "calibration.toml")
    ours, theirs = (np.array(c.project(made.TEAT_ENDS_MM)) for c in (rig, other))
    assert np.abs(ours - theirs).max() < 1.5
    for side in ("left", "right"):
        assert np.abs(mapped(rig, side) - mapped(other, side)).max() < 3.0
