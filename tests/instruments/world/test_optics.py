"""The scene's own camera model against `cv2.projectPoints`, and its inverse against itself."""

from __future__ import annotations

from functools import reduce
from operator import getitem
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.world.optics import CameraModel, cameras_from_calibration, rotation_from_vector
from instruments.world.phantom import TABLE_5_1_MM as TABLE_5_1
from tests.instruments.world.scenes import by_opencv, calibration_table

TABLE_5_1_MM = np.array(TABLE_5_1)


def model(kc: list[float], alpha_c: float = 0.0) -> CameraModel:
    R = rotation_from_vector(np.array([-1.5, 0.1, -0.05]))
    fc, cc = np.array([1291.0, 1295.2]), np.array([727.4, 528.1])
    t_mm = np.array([150.0, 80.0, 900.0])
    return CameraModel("test", 1360, 1024, fc, cc, alpha_c, np.array(kc), R, t_mm)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_shipped_cameras_project_as_opencv_does(which: int) -> None:
    camera = cameras_from_calibration(calibration_table())[which]
    rng = np.random.default_rng(1)
    points = np.concatenate([TABLE_5_1_MM, rng.uniform([-700, 0, -100], [300, 900, 500], (300, 3))])
    pixels = camera.project(points)
    assert np.abs(pixels - by_opencv(camera, points)).max() < 1e-9
    assert np.all((pixels[:4] > 0) & (pixels[:4] < [camera.width_px, camera.height_px]))
    behind = camera.centre_mm - 100.0 * camera.R[2]  # has no picture
    assert np.isnan(camera.project(behind[None, :])).all()


def test_motions_chain_as_published() -> None:
    """X_right = R X_left + T, X_world = R X_right + T: the cameras' centres by hand."""
    table = calibration_table()
    left, right, thermal = cameras_from_calibration(table)
    world_R = cv2.Rodrigues(np.array(table["world"]["om"]))[0]
    assert right.centre_mm == pytest.approx(table["world"]["T"], abs=1e-9)
    stereo_T = np.array(table["stereo"]["T"])
    assert left.centre_mm == pytest.approx(world_R @ stereo_T + table["world"]["T"], abs=1e-9)
    left_point = left.camera_from_world(TABLE_5_1_MM)
    R = cv2.Rodrigues(np.array(table["thermal"]["om"]))[0]
    assert thermal.camera_from_world(TABLE_5_1_MM) == pytest.approx(
        left_point @ R.T + np.array(table["thermal"]["T"]), abs=1e-9
    )


@given(
    kc=st.tuples(
        st.floats(-0.3, 0.1),
        st.floats(0.0, 0.35),
        st.floats(-0.004, 0.004),
        st.floats(-0.004, 0.004),
        st.floats(0.0, 0.05),
    ),
    alpha_c=st.floats(-0.01, 0.01),
)
def test_distortion_as_opencv_and_back(kc: tuple[float, ...], alpha_c: float) -> None:
    camera = model(list(kc), alpha_c)
    rng = np.random.default_rng(2)
    # As far out as the image's corners, where no lens of this range folds over.
    plane = rng.uniform([-0.55, -0.4], [0.55, 0.4], (60, 2))
    seen = np.column_stack([plane, np.ones(60)]) * rng.uniform(500.0, 2000.0, (60, 1))
    points = (seen - camera.t_mm) @ camera.R
    pixels = camera.project(points)
    assert np.abs(pixels - by_opencv(camera, points)).max() < 1e-9
    assert np.abs(camera.plane_from_pixels(pixels) - plane).max() < 1e-12


def test_another_grid_over_the_same_sensor() -> None:
    camera = cameras_from_calibration(calibration_table())[2]
    small = camera.resized(160, 120)
    # Four by four delivered pixels share a sensor pixel: its centre lies at 1.5 of them.
    assert camera.project(TABLE_5_1_MM) == pytest.approx(4.0 * small.project(TABLE_5_1_MM) + 1.5)


def test_a_lens_that_folds_over_is_refused() -> None:
    with pytest.raises(ValueError, match=r"camera test: the distortion kc .* can't be undone"):
        model([-0.9, 0.0, 0.0, 0.0, 0.0]).rays()


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("stereo.om", None, r"stereo\.om is missing"),
        ("world.T", [1.0, 2.0], r"world\.T must be 3"),
        ("thermal.om", ["a", 0, 0], r"thermal\.om must be 3"),
        ("stereo.T", [1.0, 2.0, float("nan")], r"stereo\.T must be 3 finite"),
        ("cameras.left.fc", [1291.0, -1.0], r"cameras\.left\.fc must be above zero"),
    ],
)
def test_a_wrong_calibration_names_the_key(path: str, value: Any, message: str) -> None:
    table = calibration_table()
    *blocks, key = path.split(".")
    block = reduce(getitem, blocks, table)
    del block[key]
    if value is not None:
        block[key] = value
    with pytest.raises(ValueError, match=message):
        cameras_from_calibration(table)
