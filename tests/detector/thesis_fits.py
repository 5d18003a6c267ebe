"""The thesis's rig as a consistent calibration: published figures in, rigid motions and a pinhole
thermal camera out. The files that ship are made by it.

The rigid motion shows the four teat ends of table 5.2 at the same pixels as the printed matrix. The
printed homographies fix the thermal camera's focal lengths, direction and plane; it stands midway
between the optical cameras (section 3.2.2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from detector.calibration import Calibration, Homographies, ParameterCovariance, derive_homographies
from detector.calibration import thesis_rig as printed
from detector.calibration.bundle import LENS, POSE
from detector.calibration.homographies import thermal_grid, through_plane
from detector.geometry import (
    Array,
    Camera,
    Motion,
    apply_homography,
    rigid_fit,
    rotation_from_vector,
)

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


@dataclass(frozen=True, slots=True, eq=False)
class ThermalFit:
    """A pinhole thermal camera midway between the optical ones; residual_px (2, n, 2) of both."""

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
    return Motion.from_vectors(printed.STEREO_OM_RAD, printed.STEREO_T_MM)


def printed_teats_in_right_mm() -> Array:
    """Table 5.2 (4, 3) carried into the right camera's frame by the printed, non-rigid matrix."""
    turned = np.array(TEAT_ENDS_MM) - np.array(WORLD_T_MM)
    return np.asarray(np.linalg.solve(np.array(WORLD_MATRIX), turned.T).T)


def stereo_pixels(in_right_mm: Array) -> Array:
    """Left and right pixels (2, n, 2) of points (n, 3) in the right camera's frame."""
    in_left_mm = right_from_left().inverse().apply(in_right_mm)
    return np.stack([printed.LEFT.project(in_left_mm), printed.RIGHT.project(in_right_mm)])


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
    grid = thermal_grid(printed.THERMAL_IMAGE_SIZE)
    maps = printed.HOMOGRAPHY_LEFT, printed.HOMOGRAPHY_RIGHT
    wanted = np.stack([apply_homography(one, grid) for one in maps])
    centre = ((printed.THERMAL_IMAGE_SIZE[0] - 1) / 2, (printed.THERMAL_IMAGE_SIZE[1] - 1) / 2)

    def camera(p: Array) -> tuple[Camera, Motion]:
        R = rotation_from_vector(p[2:5])
        lens = Camera(printed.THERMAL_IMAGE_SIZE, (float(p[0]), float(p[1])), centre)
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
    maps = derive_homographies(
        fit.lens, printed.LEFT, printed.RIGHT, thermal_from_left, stereo, depth_mm
    )
    thermal = replace(printed.THERMAL, lens=fit.lens)
    return Calibration(
        printed.LEFT, printed.RIGHT, stereo, world_from_right, thermal, thermal_from_left, maps
    )


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
    maps = Homographies(np.array(printed.HOMOGRAPHY_LEFT), np.array(printed.HOMOGRAPHY_RIGHT), None)
    return Calibration(
        printed.LEFT, printed.RIGHT, right_from_left(), fit_world(), printed.THERMAL, None, maps,
        ParameterCovariance(tuple(sds), variances),
    )  # fmt: skip
