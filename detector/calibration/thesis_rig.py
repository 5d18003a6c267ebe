"""The thesis's rig as a consistent calibration: published figures in, rigid motions and a pinhole
thermal camera out.

The printed world matrix isn't rigid (singular values 1.000, 0.990, 0.920): the rigid motion that
shows the four teat ends of table 5.2 at the same pixels is taken. The printed homographies fix the
thermal camera's focal lengths, direction and plane; it stands midway between the optical cameras
(section 3.2.2). The result's homographies hold at the teat ends' depth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from detector.calibration.bundle import LENS, POSE
from detector.calibration.homographies import derive_homographies, thermal_grid, through_plane
from detector.calibration.values import (
    Calibration,
    Homographies,
    ParameterCovariance,
    ThermalCamera,
)
from detector.geometry import (
    Array,
    Camera,
    Motion,
    apply_homography,
    rigid_fit,
    rotation_from_vector,
)

IMAGE_SIZE = (1360, 1024)  # section 3.1.1
# table 3.1
LEFT = Camera(IMAGE_SIZE, (1291.0, 1295.2), (727.4, 528.1), 0.0, (-0.186, 0.230, 0.0, 0.0, 0.0))
# table 3.2
RIGHT = Camera(IMAGE_SIZE, (1288.3, 1290.6), (701.4, 558.7), 0.0, (-0.212, 0.301, -0.003, 0.0, 0.0))
# section 3.2.1.2
STEREO_OM_RAD, STEREO_T_MM = (-0.0011, -0.0008, 0.0085), (-100.317, 0.242, -0.401)
# section 3.2.2
HOMOGRAPHY_LEFT = ((0.615, 0.007, 672.822), (-0.004, 0.616, 363.601), (0.0, 0.0, 1.0))
HOMOGRAPHY_RIGHT = ((0.618, 0.002, 536.133), (-0.002, 0.619, 401.948), (0.0, 0.0, 1.0))
WORLD_MATRIX = ((0.99, 0.0, 0.02), (-0.02, -0.01, 0.92), (0.0, -1.0, -0.01))  # section 3.3.2
WORLD_T_MM = (-161.80, -760.40, 64.52)
# table 5.2
TEAT_ENDS_MM = (
    (-109.8, 285.7, 135.5),
    (-161.3, 191.7, 137.8),
    (-224.2, 197.4, 137.4),
    (-260.5, 269.9, 137.4),
)
PRINTED_UNCERTAINTY = {  # tables 3.1 and 3.2: fc, cc, k1, k2
    "left": ((2.7, 2.8), (1.2, 1.3), 0.003, 0.008),
    "right": ((2.4, 2.4), (1.0, 1.2), 0.004, 0.012),
}
# section 3.2.1.2
STEREO_OM_UNCERTAINTY_RAD, STEREO_T_UNCERTAINTY_MM = (0.0023, 0.0030, 0.0003), (0.195, 0.218, 0.959)
THERMAL_IMAGE_SIZE, THERMAL_SENSOR_SIZE = (640, 480), (160, 120)  # sections 3.1.1, 4.1.1
THERMAL = ThermalCamera(THERMAL_IMAGE_SIZE, THERMAL_SENSOR_SIZE, True, "hot_is_black", None)


@dataclass(frozen=True, slots=True, eq=False)
class ThermalFit:
    """A pinhole thermal camera midway between the optical ones; residual_px (2, n, 2): left and
    right.
    """

    lens: Camera
    thermal_from_right: Motion
    plane_depth_mm: float
    residual_px: Array

    @property
    def rms_px(self) -> float:
        """Root mean square distance between fitted and printed mapping."""
        return float(np.sqrt(np.mean(np.sum(self.residual_px**2, axis=2))))

    @property
    def rms_without_constant_px(self) -> tuple[float, float]:
        """The same, left and right, once each camera's mean difference is taken off."""
        rest = self.residual_px - self.residual_px.mean(axis=1, keepdims=True)
        left, right = np.sqrt(np.mean(np.sum(rest**2, axis=2), axis=1))
        return float(left), float(right)


def right_from_left() -> Motion:
    """The stereo pose as printed."""
    return Motion.from_vectors(STEREO_OM_RAD, STEREO_T_MM)


def printed_teats_in_right_mm() -> Array:
    """Table 5.2 (4, 3) carried into the right camera's frame by the printed, non-rigid matrix."""
    turned = np.array(TEAT_ENDS_MM) - np.array(WORLD_T_MM)
    return np.asarray(np.linalg.solve(np.array(WORLD_MATRIX), turned.T).T)


def stereo_pixels(in_right_mm: Array) -> Array:
    """Left and right pixels (2, n, 2) of points (n, 3) in the right camera's frame."""
    in_left_mm = right_from_left().inverse().apply(in_right_mm)
    return np.stack([LEFT.project(in_left_mm), RIGHT.project(in_right_mm)])


def fit_world() -> Motion:
    """`world_from_right` whose teat ends lie closest to the printed matrix's, in px."""
    teats, wanted = np.array(TEAT_ENDS_MM), stereo_pixels(printed_teats_in_right_mm())
    start = rigid_fit(printed_teats_in_right_mm(), teats)

    def residual(p: Array) -> Array:
        return stereo_pixels(Motion.from_vectors(p[:3], p[3:]).apply(teats)) - wanted

    found = _fitted(residual, [*start.om, *start.T], [1e-3] * 3 + [1.0] * 3)
    return Motion.from_vectors(found[:3], found[3:]).inverse()


def fit_thermal() -> ThermalFit:
    """The thermal camera closest to both printed homographies over an even grid."""
    # the left camera's centre, in the right camera's frame, is T
    midway = 0.5 * right_from_left().T
    grid = thermal_grid(THERMAL_IMAGE_SIZE)
    printed = HOMOGRAPHY_LEFT, HOMOGRAPHY_RIGHT
    wanted = np.stack([apply_homography(printed_map, grid) for printed_map in printed])
    centre = ((THERMAL_IMAGE_SIZE[0] - 1) / 2, (THERMAL_IMAGE_SIZE[1] - 1) / 2)

    def camera(p: Array) -> tuple[Camera, Motion]:
        R = rotation_from_vector(p[2:5])
        lens = Camera(THERMAL_IMAGE_SIZE, (float(p[0]), float(p[1])), centre)
        return lens, Motion(R, -R @ midway)

    def residual(p: Array) -> Array:
        return stereo_pixels(through_plane(grid, *camera(p), float(p[5]))) - wanted

    start, scale = [2000.0, 2000.0, 0.0, 0.0, 0.0, 1200.0], [10.0, 10.0, 1e-3, 1e-3, 1e-3, 10.0]
    found = _fitted(residual, start, scale)
    return ThermalFit(*camera(found), float(found[5]), residual(found))


def _fitted(residual: Callable[[Array], Array], start: list[float], scale: list[float]) -> Array:
    to_the_end = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14}
    return np.asarray(
        least_squares(lambda p: residual(p).ravel(), start, x_scale=scale, **to_the_end).x
    )


def thesis_rig() -> Calibration:
    """The emulated rig's calibration; its homographies hold at table 5.2's mean depth."""
    world_from_right, fit, stereo = fit_world(), fit_thermal(), right_from_left()
    thermal_from_left = fit.thermal_from_right @ stereo
    depth_mm = float(world_from_right.inverse().apply(TEAT_ENDS_MM)[:, 2].mean())
    maps = derive_homographies(fit.lens, LEFT, RIGHT, thermal_from_left, stereo, depth_mm)
    thermal = replace(THERMAL, lens=fit.lens)
    return Calibration(LEFT, RIGHT, stereo, world_from_right, thermal, thermal_from_left, maps)


def thesis_published() -> Calibration:
    """What the thesis printed, with a third of the toolbox's uncertainties; no correlations. The
    world is `fit_world`; the thermal camera has homographies only.
    """
    sds: dict[tuple[str, str], float] = {}
    for name, (fc, cc, k1, k2) in PRINTED_UNCERTAINTY.items():
        sds |= {(name, p): sd for p, sd in zip(LENS, (*fc, *cc, k1, k2), strict=False)}
    pose = (*STEREO_OM_UNCERTAINTY_RAD, *STEREO_T_UNCERTAINTY_MM)
    sds |= {("stereo", p): sd for p, sd in zip(POSE, pose, strict=True)}
    variances = np.diag([(sd / 3.0) ** 2 for sd in sds.values()])
    maps = Homographies(np.array(HOMOGRAPHY_LEFT), np.array(HOMOGRAPHY_RIGHT), None)
    return Calibration(
        LEFT, RIGHT, right_from_left(), fit_world(), THERMAL, None, maps,
        ParameterCovariance(tuple(sds), variances),
    )  # fmt: skip
