"""The pictures as the fit looks at them: linear intensities, a camera, and profiles of edges."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.geometry import Array, Camera
from detector.outline import pictures
from detector.outline.edges import Profile
from detector.outline.fit import CameraView
from detector.outline.prior import right_from_teats, thermal_camera
from detector.protocol import Frames

OPTICAL_ROUGH = Profile(7.0, 1.0, 5.0, 0.5, 1.2, limb=False, pull_px=4.0)
OPTICAL_FINE = Profile(5.0, 0.5, 2.0, 0.25, 0.8, limb=True, pull_px=1.5)
THERMAL = Profile(4.0, 0.5, 2.0, 0.25, 1.0, limb=False, pull_px=2.0)
OPTICAL_FLOOR_PX, THERMAL_FLOOR_PX = 0.05, 0.4
ROOM_PX = 60  # about the nominations: half a teat's width, and as far down as the fit looks


def optical_views(
    left: NDArray[Any],
    right: NDArray[Any],
    calibration: Calibration,
    guesses: Array,
    noise: float | None = None,
) -> list[CameraView]:
    """The parts of both pictures that the guesses (n, 8) reach; ``noise`` where it isn't asked."""
    points = guesses[:, :3]
    points = np.concatenate([points, points + np.array([0.0, 60.0, 0.0])])
    profiles = OPTICAL_ROUGH, OPTICAL_FINE, OPTICAL_FLOOR_PX
    made = []
    turned = right_from_teats(calibration)
    for picture, camera, motion in (
        (left, calibration.left, calibration.right_from_left.inverse() @ turned),
        (right, calibration.right, turned),
    ):
        near, corner = pictures.region(picture, camera.project(motion.apply(points)), ROOM_PX)
        found = pictures.noise_of(near) if noise is None else noise
        made.append(CameraView(near, corner, found, camera, motion, *profiles))
    return made


def thermal_view(frames: Frames, calibration: Calibration) -> CameraView:
    """The thermal picture on its sensor's grid, whole. Raises UnusableError, OutOfDomainError."""
    warm = pictures.thermal(frames, calibration.thermal)
    camera, (lens, motion) = calibration.thermal, thermal_camera(calibration)
    size, down = (
        delivered / sensor
        for delivered, sensor in zip(camera.image_size, camera.sensor_size, strict=True)
    )
    if abs(size - down) > 0.01 * size:
        raise pictures.UnusableError(
            f"the thermal picture is stretched: {size:g} pixels a sensor pixel across, {down:g}"
            " down"
        )
    fx, fy, cx, cy = (*lens.fc, *lens.cc)
    sensor = Camera(
        (warm.shape[1], warm.shape[0]),
        (fx / size, fy / size),
        ((cx + 0.5) / size - 0.5, (cy + 0.5) / size - 0.5),
        lens.alpha_c,
        lens.kc,
    )
    # it can't take a shadow for a teat
    return CameraView(
        warm, np.zeros(2), pictures.noise_of(warm), sensor,
        motion @ right_from_teats(calibration), THERMAL, THERMAL, THERMAL_FLOOR_PX,
    )  # fmt: skip
