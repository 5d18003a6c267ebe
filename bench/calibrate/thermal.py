"""The thermal camera: as a third camera calibrated on a heated board that the left camera sees too,
or as homographies from point pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.calibrate.views import BoardViews
from bench.calibrate.world import read_table
from bench.config import ConfigError
from detector.calibration import (
    Homographies,
    ParameterCovariance,
    Part,
    Polarity,
    Record,
    ThermalCamera,
    derive_homographies,
)
from detector.calibration.bundle import POSE
from detector.calibration.cameras import Calibrated, calibrate_camera, join_cameras, place_board
from detector.calibration.coverage import Coverage, coverage
from detector.calibration.homographies import MappedPairs, fit_homography
from detector.geometry import Motion

PAIR_COLUMNS = ("thermal_x", "thermal_y", "left_x", "left_y", "right_x", "right_y")


@dataclass(frozen=True, slots=True)
class Delivered:
    """How the thermal camera's picture comes: what a picture alone doesn't tell."""

    sensor_size: tuple[int, int]
    mirrored: bool
    polarity: Polarity
    model: str = "k1"


@dataclass(frozen=True, slots=True, eq=False)
class ThermalResult:
    """The thermal camera with its pose, and the homographies at ``plane_depth_mm``; how well all
    holds.
    """

    views: BoardViews
    camera: ThermalCamera
    thermal_from_left: Motion
    homographies: Homographies
    alone: Calibrated
    joint: Calibrated
    coverage: Coverage

    def part(self, record: Record) -> Part:
        """What the file of this step holds."""
        fit = self.joint.fit
        names = tuple(
            ("thermal pose", name) if name in POSE else (owner, name) for owner, name in fit.names
        )
        return Part(
            thermal=self.camera,
            thermal_from_left=self.thermal_from_left,
            homographies=self.homographies,
            covariance=ParameterCovariance(names, fit.covariance),
            record=record,
        )


def calibrate_thermal(
    views: BoardViews, cameras: Part, delivered: Delivered, plane_depth_mm: float
) -> ThermalResult:
    """The third camera against a pair that is calibrated. Thermal views are of un-mirrored
    pictures. Raises BundleError (a sentence).

    The left camera's lens is held as it is; it sees the board in the same poses.
    """
    if cameras.left is None or cameras.right is None or cameras.right_from_left is None:
        raise ConfigError.plain(
            "the cameras' file lacks a part: it must hold cameras.left, cameras.right and stereo"
            " (calibrate cameras)"
        )
    size = views.image_size["thermal"]
    alone = calibrate_camera("thermal", views.views("thermal"), size, model=delivered.model)
    left = place_board("left", views.views("left"), cameras.left)
    joint = join_cameras(
        {"left": left, "thermal": alone}, joint_lenses=("thermal",), model=delivered.model
    )
    lens, pose = joint.fit.rig.cameras["thermal"], joint.fit.rig.from_reference["thermal"]
    maps = derive_homographies(
        lens, cameras.left, cameras.right, pose, cameras.right_from_left, plane_depth_mm
    )
    camera = ThermalCamera(
        size, delivered.sensor_size, delivered.mirrored, delivered.polarity, lens
    )
    shown = coverage([view.pixels_px for view in views.views("thermal")], size, alone.fit.poses)
    return ThermalResult(views, camera, pose, maps, alone, joint, shown)


@dataclass(frozen=True, slots=True, eq=False)
class PairsResult:
    """Homographies from point pairs, for a rig whose thermal camera has no pose."""

    left: MappedPairs
    right: MappedPairs

    def part(self, image_size: tuple[int, int], delivered: Delivered, record: Record) -> Part:
        """What the file of this step holds."""
        camera = ThermalCamera(
            image_size, delivered.sensor_size, delivered.mirrored, delivered.polarity, None
        )
        return Part(
            thermal=camera,
            homographies=Homographies(self.left.H, self.right.H, None),
            record=record,
        )


def map_pairs(path: Path) -> PairsResult:
    """Homographies from a table of point pairs (`PAIR_COLUMNS`, px; thermal un-mirrored). Raises
    ConfigError that says where.
    """
    pairs = read_table(path, PAIR_COLUMNS)
    thermal = np.column_stack([pairs["thermal_x"], pairs["thermal_y"]])
    try:
        left, right = (
            fit_homography(thermal, np.column_stack([pairs[f"{side}_x"], pairs[f"{side}_y"]]))
            for side in ("left", "right")
        )
    except ValueError as error:
        raise ConfigError.plain(f"{path}: {error}") from error
    return PairsResult(left, right)
