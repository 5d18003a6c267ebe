"""What is assumed of teats and of where cameras stand, in the world's frame: which way teats point,
how far they lean, their size, and how far away they are. Nothing else says it again.

Teats are fitted in a frame of their own: at the right camera's centre, y from a teat's end to its
base as the calibration's world says, z level and into the scene. However a rig is tilted, rolled or
turned over, a teat leans little in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.geometry import Array, Camera, Motion


class OutOfDomainError(ValueError):
    """A rig that teats can't be fitted on; the message is one sentence."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Teats point along the world's z, or against it where the calibration says that they hang.
    Radius: mean and sd; sd of lean (slope), of taper about 0, of the end's height (radii) about 1.
    Outside of the last lines' ranges a fit says so, and is the less sure.
    """

    radius_mm: float = 11.0
    radius_sd_mm: float = 1.7
    lean_sd: float = 0.2
    taper_sd: float = 0.006
    height_sd: float = 0.1
    length_mm: float = 72.0  # as far as a side is looked at
    udder: int = 4  # teats; no more are given
    within_mm: float = 5.0  # of its place a cup finds an end; one that may be farther off is named
    radii_mm: tuple[float, float] = (7.5, 15.0)
    most_lean_deg: float = 27.0
    depths_mm: tuple[float, float] = (450.0, 2000.0)  # and where the fields of view overlap
    steepest_deg: float = 55.0  # of the right camera's axis to the level
    least_radius_px: tuple[float, float] = (2.0, 1.2)  # optical and thermal, of the mean radius
    most_mm_a_px: float = 100.0  # of depth, a pixel of disparity


@lru_cache(maxsize=16)
def right_from_teats(calibration: Calibration) -> Motion:
    """The fits' frame in the right camera's."""
    base = np.array([0.0, 0.0, 1.0 if calibration.hanging else -1.0])
    y = calibration.world_from_right.R.T @ base
    # of a camera that looks along the teats, its rows are as good as level
    z = np.array([0.0, 0.0, 1.0]) - y[2] * y
    z = z if np.linalg.norm(z) > 1e-3 else np.cross([1.0, 0.0, 0.0], y)
    z /= np.linalg.norm(z)
    return Motion(np.column_stack([np.cross(y, z), y, z]), np.zeros(3))


def world_from_teats(calibration: Calibration) -> Motion:
    """The fits' frame in the world."""
    return calibration.world_from_right @ right_from_teats(calibration)


def eyes_mm(calibration: Calibration) -> Array:
    """The left and the right camera's centre (2, 3), the fits' frame."""
    left = right_from_teats(calibration).R.T @ calibration.right_from_left.T
    return np.array([left, np.zeros(3)])


def disparities_px(points_mm: Array, calibration: Calibration) -> Array:
    """Focal length times baseline by depth (k,), of points (k, 3), the fits' frame."""
    depth = right_from_teats(calibration).apply(points_mm)[:, 2]
    return np.asarray(calibration.right.fc[0] * calibration.baseline_mm / depth)


def thermal_camera(calibration: Calibration) -> tuple[Camera, Motion]:
    """Its lens, and the right camera's frame in its own. Raises OutOfDomainError."""
    lens, pose = calibration.thermal.lens, calibration.thermal_from_right
    if lens is None or pose is None:
        raise OutOfDomainError(
            "the calibration has no lens and pose of the thermal camera, by which a place in"
            " space has one in its picture"
        )
    return lens, pose


@lru_cache(maxsize=16)
def depths_seen_mm(calibration: Calibration, prior: Prior) -> tuple[float, float]:
    """From where to where along the thermal camera's axis all three cameras see one place. Raises
    OutOfDomainError for a rig on which teats can't be fitted.
    """
    lens, pose = thermal_camera(calibration)
    steep = np.degrees(np.arcsin(abs(right_from_teats(calibration).R[2, 1])))
    if steep > prior.steepest_deg:
        raise OutOfDomainError(
            f"the right camera looks up or down by {steep:.0f} degrees; {prior.steepest_deg:.0f}"
            " are the most at which a teat's sides are seen beside its end"
        )
    depths = np.geomspace(*prior.depths_mm, 32)
    places = np.linspace(0.0, 1.0, 5)
    size = np.array(lens.image_size) - 1.0
    rays = lens.normalize(np.stack(np.meshgrid(places, places), axis=2).reshape(-1, 2) * size)
    rays = np.column_stack([rays, np.ones(len(rays))])
    in_right = pose.inverse().apply((depths[:, None, None] * rays).reshape(-1, 3))
    in_left = calibration.right_from_left.inverse().apply(in_right)
    both = _inside(calibration.right, in_right) & _inside(calibration.left, in_left)
    seen = both.reshape(len(depths), -1).any(axis=1)
    low, high = prior.depths_mm
    if not seen.any():
        raise OutOfDomainError(
            f"the three cameras see no place in common from {low:.0f} to {high:.0f} mm away"
        )
    near, far = float(depths[seen][0]), float(depths[seen][-1])
    mm_a_px = near**2 / (calibration.right.fc[0] * calibration.baseline_mm)
    if mm_a_px > prior.most_mm_a_px:
        raise OutOfDomainError(
            f"a pixel of disparity is {mm_a_px:.0f} mm of depth at {near:.0f} mm: the baseline of"
            f" {calibration.baseline_mm:.0f} mm is too short for these lenses"
        )
    sensor = lens.fc[0] * calibration.thermal.sensor_size[0] / calibration.thermal.image_size[0]
    focals = min(calibration.left.fc[0], calibration.right.fc[0]), sensor
    for name, focal, least in zip(
        ("optical", "thermal"), focals, prior.least_radius_px, strict=True
    ):
        if focal * prior.radius_mm / near < least:
            raise OutOfDomainError(
                f"a teat is {2 * focal * prior.radius_mm / near:.1f} pixels wide in the {name}"
                f" pictures at {near:.0f} mm, where the cameras' views begin to overlap;"
                f" {2 * least:.1f} are needed"
            )
    return near, far


def _inside(camera: Camera, points_mm: Array) -> NDArray[np.bool_]:
    pixels = camera.project(points_mm)
    return np.asarray(((pixels >= 0) & (pixels <= np.array(camera.image_size) - 1)).all(axis=1))
