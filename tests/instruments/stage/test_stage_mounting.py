"""The plate's pose for a place of the carriage: scale, squareness and yaw, each against figures
worked out by hand.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.stage.emulator import Mounting

TRUE = Mounting("XYZA", (-150.0, -137.5, -50.0, -180.0))


def test_at_its_reference_the_pose_is_zero_whatever_the_errors() -> None:
    crooked = replace(
        TRUE, scale_errors=(0.01, -0.01, 0.02, 0.03), squareness_rad=0.01, yaw_rad=-0.02
    )
    for mounting in (TRUE, crooked):
        pose = mounting.pose((-150.0, -137.5, -50.0, -180.0))
        assert (pose.x_mm, pose.y_mm, pose.z_mm, pose.yaw_rad) == pytest.approx((0, 0, 0, 0))


def test_a_true_stage_carries_what_it_counts() -> None:
    pose = TRUE.pose((-140.0, -150.0, -30.0, -90.0))
    assert (pose.x_mm, pose.y_mm, pose.z_mm, pose.yaw_rad) == pytest.approx(
        (10, -12.5, 20, math.pi / 2)
    )


def test_axes_that_are_not_declared_carry_nothing() -> None:
    pose = replace(TRUE, axes="XY").pose((-140.0, -137.5, -1.0))
    assert (pose.x_mm, pose.y_mm, pose.z_mm, pose.yaw_rad) == pytest.approx((10, 0, 0, 0))
    pose = replace(TRUE, axes="XYA").pose((-140.0, -137.5, -1.0, -181.0))
    assert (pose.z_mm, pose.yaw_rad) == pytest.approx((0, -math.radians(1)))


def test_below_its_reference_the_plate_rests_on_the_table() -> None:
    assert TRUE.pose((-150.0, -137.5, -50.1, -180.0)).z_mm == 0.0


def test_scale_squareness_and_yaw_by_hand() -> None:
    scaled = replace(TRUE, scale_errors=(0.01, -0.02, 0.1, 0.001))
    pose = scaled.pose((-50.0, -37.5, -40.0, -80.0))
    assert (pose.x_mm, pose.y_mm, pose.z_mm, pose.yaw_rad) == pytest.approx(
        (101, 98, 11, math.radians(100.1))
    )
    pose = replace(TRUE, squareness_rad=0.01).pose((-50.0, -37.5, -50.0, -180.0))
    assert (pose.x_mm, pose.y_mm) == pytest.approx(
        (100 - 100 * math.sin(0.01), 100 * math.cos(0.01))
    )
    pose = replace(TRUE, yaw_rad=0.1).pose((-50.0, -137.5, -50.0, -180.0))
    assert (pose.x_mm, pose.y_mm, pose.yaw_rad) == pytest.approx(
        (100 * math.cos(0.1), 100 * math.sin(0.1), 0.0)
    )


@given(
    st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02)
)
def test_the_errors_put_in_can_be_read_off_three_places(
    squareness: float, yaw: float, scale_x: float, scale_y: float
) -> None:
    mounting = replace(
        TRUE, squareness_rad=squareness, yaw_rad=yaw, scale_errors=(scale_x, scale_y, 0.0, 0.0)
    )

    def at(x: float, y: float) -> np.ndarray:
        pose = mounting.pose((x, y, -50.0, -180.0))
        return np.array([pose.x_mm, pose.y_mm])

    along_x, along_y = at(-50, -100) - at(-150, -100), at(-150, 0) - at(-150, -100)
    assert np.linalg.norm(along_x) / 100 - 1 == pytest.approx(scale_x, abs=1e-12)
    assert np.linalg.norm(along_y) / 100 - 1 == pytest.approx(scale_y, abs=1e-12)
    assert math.atan2(along_x[1], along_x[0]) == pytest.approx(yaw, abs=1e-12)
    angle = math.atan2(along_y[1], along_y[0]) - math.atan2(along_x[1], along_x[0])
    assert angle - math.pi / 2 == pytest.approx(squareness, abs=1e-12)
