"""Other rigs made of a rig's calibration: cameras tilted, rolled, nearer, with another baseline,
other pixels or another lens. All look at the place where the phantom stands.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import radians

import numpy as np

from detector.calibration import Calibration
from detector.geometry import Array, Camera, Motion
from instruments.world.phantom import PIVOT_MM

LOOKED_AT_MM = np.array([*PIVOT_MM, 130.0])  # the middle of the phantom's ends


def aimed(calibration: Calibration) -> Calibration:
    """The rig turned so that the thermal camera's axis meets the place that all look at."""
    eye = _thermal_mm(calibration)
    axis = (calibration.world_from_right @ _thermal_from_right(calibration).inverse()).R[:, 2]
    sight = (LOOKED_AT_MM - eye) / np.linalg.norm(LOOKED_AT_MM - eye)
    across = np.cross(axis, sight)
    sine = np.linalg.norm(across)
    om = across / max(sine, 1e-12) * np.arctan2(sine, axis @ sight)
    return _turned(calibration, om, eye)


def tilted(calibration: Calibration, deg: float) -> Calibration:
    """The rig turned about what it looks at, so that it looks up by so much more."""
    across = calibration.world_from_right.R[:, 0] * [1.0, 1.0, 0.0]
    return _turned(calibration, radians(deg) * across / np.linalg.norm(across))


def rolled(calibration: Calibration, deg: float) -> Calibration:
    """The rig, aimed, turned about its line of sight; by 180 degrees teats hang in its pictures."""
    calibration = aimed(calibration)
    sight = LOOKED_AT_MM - _thermal_mm(calibration)
    return _turned(calibration, radians(deg) * sight / np.linalg.norm(sight))


def away(calibration: Calibration, mm: float) -> Calibration:
    """The rig so far from what it looks at; a thermal lens that sees as much of it."""
    sight = LOOKED_AT_MM - _thermal_mm(calibration)
    was = float(np.linalg.norm(sight))
    pose = calibration.world_from_right
    moved = replace(calibration, world_from_right=Motion(pose.R, pose.T + (1 - mm / was) * sight))
    share = min(mm / was, 1.0)
    lens = calibration.thermal.lens
    if lens is None:
        raise ValueError("the calibration has no lens of the thermal camera")
    wider = replace(lens, fc=(share * lens.fc[0], share * lens.fc[1]))
    return replace(moved, thermal=replace(calibration.thermal, lens=wider))


def with_baseline(calibration: Calibration, mm: float) -> Calibration:
    """The left and the right camera so far apart, the thermal camera where it was."""
    pose, share = calibration.right_from_left, mm / calibration.baseline_mm
    middle = 0.5 * (1.0 - share) * pose.T  # how far each comes nearer, right camera's frame
    right_from_left = Motion(pose.R, share * pose.T)
    moved_from_right = Motion(np.eye(3), -middle)
    thermal_from_moved = _thermal_from_right(calibration) @ moved_from_right.inverse()
    return replace(
        calibration,
        right_from_left=right_from_left,
        thermal_from_left=thermal_from_moved @ right_from_left,
        world_from_right=calibration.world_from_right @ moved_from_right.inverse(),
    )


def with_pixels(calibration: Calibration, share: float) -> Calibration:
    """Optical pictures of so many times the columns and rows, of the same view."""
    left, right = (_scaled(lens, share) for lens in (calibration.left, calibration.right))
    return replace(calibration, left=left, right=right)


def with_thermal_pixels(calibration: Calibration, share: float) -> Calibration:
    """A thermal sensor of so many times the columns and rows, of the same view."""
    columns, rows = (round(share * n) for n in calibration.thermal.sensor_size)
    return replace(calibration, thermal=replace(calibration.thermal, sensor_size=(columns, rows)))


def distorted(calibration: Calibration, more: float) -> Calibration:
    """Optical lenses whose first radial coefficient is so much more."""
    left, right = (
        replace(lens, kc=(lens.kc[0] + more, *lens.kc[1:]))
        for lens in (calibration.left, calibration.right)
    )
    return replace(calibration, left=left, right=right)


# what is drawn evenly of a rig, in this order
DRAWN: Mapping[str, tuple[Callable[[Calibration, float], Calibration], tuple[float, float]]] = {
    "baseline": (with_baseline, (60.0, 240.0)),
    "away": (away, (600.0, 1600.0)),
    "tilt": (tilted, (-35.0, 35.0)),
    "roll": (rolled, (-180.0, 180.0)),
    "pixels": (with_pixels, (0.45, 1.0)),
    "thermal-pixels": (with_thermal_pixels, (0.6, 1.0)),
    "distortion": (distorted, (-0.1, 0.2)),
}


def drawn(calibration: Calibration, rng: np.random.Generator) -> Calibration:
    """A rig drawn from all of these."""
    calibration = aimed(calibration)
    for change, (low, high) in DRAWN.values():
        calibration = change(calibration, float(rng.uniform(low, high)))
    return calibration


def _turned(calibration: Calibration, om_rad: Array, about_mm: Array = LOOKED_AT_MM) -> Calibration:
    turn = Motion.from_vectors(om_rad, np.zeros(3))
    about = Motion(turn.R, about_mm - turn.R @ about_mm)
    return replace(calibration, world_from_right=about @ calibration.world_from_right)


def _thermal_mm(calibration: Calibration) -> Array:
    """The thermal camera's centre in the world."""
    return calibration.world_from_right.apply(_thermal_from_right(calibration).inverse().T)


def _thermal_from_right(calibration: Calibration) -> Motion:
    if (pose := calibration.thermal_from_right) is None:
        raise ValueError("the calibration has no pose of the thermal camera")
    return pose


def _scaled(lens: Camera, share: float) -> Camera:
    columns, rows = (round(share * n) for n in lens.image_size)
    across, down = columns / lens.image_size[0], rows / lens.image_size[1]
    cx, cy = (lens.cc[0] + 0.5) * across - 0.5, (lens.cc[1] + 0.5) * down - 0.5
    return replace(
        lens, image_size=(columns, rows), fc=(across * lens.fc[0], down * lens.fc[1]), cc=(cx, cy)
    )
