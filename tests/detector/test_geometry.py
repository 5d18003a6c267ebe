"""Geometry against OpenCV, against itself there and back, and against the thesis's table 5.2."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.calibration.thesis_rig import LEFT, RIGHT, STEREO_OM_RAD, STEREO_T_MM
from detector.geometry import (
    Camera,
    Motion,
    apply_homography,
    homogeneous,
    rigid_fit,
    rotation_from_vector,
    triangulate,
    vector_from_rotation,
)

Array = NDArray[np.float64]

STRONG = Camera(
    (640, 480), (500.0, 510.0), (322.0, 236.5), 0.0, (-0.31, 0.12, 0.0021, -0.0017, -0.02)
)
STEREO = Motion.from_vectors(STEREO_OM_RAD, STEREO_T_MM)
cameras = pytest.mark.parametrize("camera", [LEFT, RIGHT, STRONG])

vectors = arrays(np.float64, 3, elements=st.floats(-1.7, 1.7, allow_subnormal=False))


def pixels_over(camera: Camera) -> Array:
    columns, rows = (np.linspace(0, size - 1, 15) for size in camera.image_size)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


@given(vectors)
def test_rotation_matches_opencv_and_goes_back(om: Array) -> None:
    R = rotation_from_vector(om)
    assert np.allclose(R, cv2.Rodrigues(om)[0], atol=1e-13)
    assert np.allclose(rotation_from_vector(vector_from_rotation(R)), R, atol=1e-13)


AWKWARD = [[0, 0, 0], [1e-9, 0, 0], [np.pi, 0, 0], [0, np.pi - 1e-9, 0], [0, 0, -np.pi + 1e-7]]


@pytest.mark.parametrize("om", [*AWKWARD, [2.0, -1.0, 1.5]])
def test_rotation_vector_survives_the_awkward_angles(om: list[float]) -> None:
    R = rotation_from_vector(om)
    back = vector_from_rotation(R)
    assert np.linalg.norm(back) <= np.pi + 1e-12
    assert np.allclose(rotation_from_vector(back), R, atol=1e-14)


@pytest.mark.slow
@given(vectors, vectors, vectors)
def test_motions_compose_and_invert(om: Array, T: Array, point: Array) -> None:
    a, b = Motion.from_vectors(om, 100 * T), Motion.from_vectors(-0.5 * T, om)
    assert np.allclose((a @ b).apply(point), a.apply(b.apply(point)), atol=1e-10)
    assert np.allclose((a @ a.inverse()).apply(point), point, atol=1e-10)


def test_a_mirror_image_or_a_scale_is_no_motion() -> None:
    for R in (np.diag([1.0, 1.0, -1.0]), 0.92 * np.eye(3)):
        with pytest.raises(ValueError, match="not a rotation matrix"):
            Motion(R, np.zeros(3))


@pytest.mark.parametrize("points", [np.zeros((2, 3)), np.outer(np.arange(5.0), [1, 2, 3])])
def test_rigid_fit_refuses_what_fixes_no_rotation(points: Array) -> None:
    with pytest.raises(ValueError, match="rigid fit needs"):
        rigid_fit(points, points)


@cameras
def test_projection_is_opencvs(camera: Camera) -> None:
    points = np.random.default_rng(1).uniform([-300, -250, 700], [300, 250, 1500], (400, 3))
    still, kc = np.zeros(3), np.array(camera.kc)
    expected, _ = cv2.projectPoints(points, still, still, camera.matrix, kc)
    assert np.allclose(camera.project(points), expected.reshape(-1, 2), atol=1e-9)


@cameras
def test_normalize_undoes_the_lens_to_1e10_and_agrees_with_opencv(camera: Camera) -> None:
    pixels = pixels_over(camera)
    x = camera.normalize(pixels)
    again = camera.project(homogeneous(x))
    assert np.abs((again - pixels) / camera.fc).max() < 1e-10
    opencv = cv2.undistortPoints(pixels[:, None], camera.matrix, np.array(camera.kc))[:, 0]
    # OpenCV stops after a few fixed-point steps; a loose bound on a wrong sign or order
    assert np.abs(x - opencv).max() < 2e-3
    rays = camera.rays(pixels)
    assert np.allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    assert np.all(rays[:, 2] > 0)


def test_skew_goes_there_and_back() -> None:
    camera = replace(LEFT, alpha_c=0.01)
    pixels = pixels_over(camera)
    assert np.allclose(camera.project(camera.rays(pixels) * 900), pixels, atol=1e-8)
    shift = camera.project([[0.0, 100.0, 1000.0]]) - LEFT.project([[0.0, 100.0, 1000.0]])
    assert shift[0, 1] == 0
    assert shift[0, 0] == pytest.approx(1291.0 * 0.01 * 0.1, rel=0.01)


def test_what_is_behind_the_camera_or_beyond_the_lens_is_nan() -> None:
    assert np.isnan(LEFT.project([[0.0, 0.0, -5.0], [0.0, 0.0, 0.0]])).all()
    barrel = Camera((100, 100), (50.0, 50.0), (50.0, 50.0), 0.0, (-0.5, 0.0, 0.0, 0.0, 0.0))
    x = barrel.normalize([[50.0, 50.0], [50000.0, 50.0]])
    assert np.allclose(x[0], 0)
    # k1 = -0.5 bends back at r = 0.816: no ray inside of that reaches so far out
    assert np.isnan(x[1]).all() or np.linalg.norm(x[1]) > 0.816


def test_triangulation_gives_table_5_2_back(shared: Path) -> None:
    published = tomllib.loads((shared / "seed" / "published.toml").read_text(encoding="utf-8"))
    A = np.array(published["world"]["transformation"])
    teats = np.array(published["table_5_2"]["teat_ends_mm"])
    in_right = np.linalg.solve(A[:3, :3], (teats - A[:3, 3]).T).T
    right_px, left_px = RIGHT.project(in_right), LEFT.project(STEREO.inverse().apply(in_right))
    found, gap = triangulate(left_px, right_px, LEFT, RIGHT, STEREO)
    assert np.abs(found @ A[:3, :3].T + A[:3, 3] - teats).max() < 1e-6
    assert gap.max() < 1e-6


def test_triangulation_is_the_midpoint_of_the_shortest_bridge() -> None:
    left_px = np.array([[800.0, 500.0], [650.0, 410.0]])
    right_px = np.array([[660.0, 540.0], [520.0, 420.0]])
    found, gap = triangulate(left_px, right_px, LEFT, RIGHT, STEREO)
    left_rays, right_rays = LEFT.rays(left_px) @ STEREO.R.T, RIGHT.rays(right_px)
    for i in range(2):
        # an independent solution: least squares for both distances along the rays
        pair = np.column_stack([left_rays[i], -right_rays[i]])
        distances = np.linalg.lstsq(pair, -STEREO.T, rcond=None)[0]
        on_left, on_right = distances[0] * left_rays[i] + STEREO.T, distances[1] * right_rays[i]
        assert np.allclose(found[i], (on_left + on_right) / 2, atol=1e-7)
        assert gap[i] == pytest.approx(np.linalg.norm(on_left - on_right), abs=1e-7)


def test_parallel_rays_have_no_crossing() -> None:
    camera = Camera((100, 100), (100.0, 100.0), (50.0, 50.0))
    beside, middle = Motion(np.eye(3), np.array([-100.0, 0, 0])), [[50.0, 50.0]]
    found, gap = triangulate(middle, middle, camera, camera, beside)
    assert np.isnan(found).all()
    assert np.isnan(gap).all()


def test_one_pixel_of_disparity_costs_what_the_formula_says(rig: Calibration) -> None:
    world = np.array([[-180.0, 240.0, 137.0]])
    left_px, right_px = rig.project(world)
    near, far = (rig.place(left_px, right_px + np.array([d, 0])) for d in (-0.5, 0.5))
    by_formula = rig.depth_per_disparity_px_mm(world)[0]
    assert np.linalg.norm(far - near) == pytest.approx(by_formula, rel=0.02)


def test_homography_divides_and_refuses_the_horizon() -> None:
    H = np.array([[2.0, 0, 1], [0, 3, 0], [0.1, 0, 1]])
    assert np.allclose(apply_homography(H, [[10.0, 4.0]]), [[21 / 2, 12 / 2]])
    assert np.isnan(apply_homography(H, [[-10.0, 4.0]])).all()


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((4, 2)), np.zeros((1, 1, 3))])
def test_wrong_shapes_are_named(bad: Array) -> None:
    with pytest.raises(ValueError, match=r"shape \(n, 3\)"):
        LEFT.project(bad)
