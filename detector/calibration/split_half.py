"""Split-half comparison: the calibration made twice, from every other view each, and how far the
two disagree where it matters.

Strategy: what the stated standard deviations promise is held against what two independent halves
do. Reprojection error can't show this: a fit to few views reprojects better, and is worse. Source:
the bench's metrology sheet, "Calibration quality". May not know files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from detector.calibration.bundle import LENS, POSE
from detector.calibration.cameras import Calibrated, View, calibrate_camera, join_cameras
from detector.calibration.uncertainty import Pair
from detector.geometry import Array, Motion, triangulate


@dataclass(frozen=True, slots=True, eq=False)
class Halves:
    """Two calibrations of one pair, each from half of the views; ``differences`` of parameters in
    combined standard deviations.
    """

    pairs: tuple[Pair, Pair]
    differences: Mapping[tuple[str, str], float]

    def disagree_mm(self, left_px: ArrayLike, right_px: ArrayLike) -> Array:
        """Distance (n,) mm between the points that both halves triangulate from the same pixels (n,
        2), in the right camera's frame.
        """
        first, second = (
            triangulate(
                np.asarray(left_px),
                np.asarray(right_px),
                pair.left,
                pair.right,
                pair.right_from_left,
            )[0]
            for pair in self.pairs
        )
        return np.asarray(np.linalg.norm(first - second, axis=1))


def split_half(
    views: Mapping[str, Sequence[View]],
    image_size: tuple[int, int],
    *,
    model: str,
    square_pixels: bool = False,
) -> Halves:
    """Both halves of the views that left and right share, alone and jointly. Raises
    TooFewViewsError where a half is too small.
    """
    shared = [
        view.name for view in views["left"] if view.name in {other.name for other in views["right"]}
    ]
    fits = []
    for start in (0, 1):
        half = set(shared[start::2])
        alone = {
            name: calibrate_camera(
                name,
                [v for v in views[name] if v.name in half],
                image_size,
                model=model,
                square_pixels=square_pixels,
            )
            for name in ("left", "right")
        }
        fits.append(
            join_cameras(
                alone, joint_lenses=("left", "right"), model=model, square_pixels=square_pixels
            )
        )
    return Halves((pair_of(fits[0]), pair_of(fits[1])), _differences(fits[0], fits[1]))


def pair_of(joined: Calibrated, world_from_right: Motion | None = None) -> Pair:
    """The pair of an adjustment of the cameras left and right; the world is the right camera's
    frame where there is none.
    """
    rig = joined.fit.rig
    right_from_left = rig.from_reference["right"] @ rig.from_reference["left"].inverse()
    return Pair(
        rig.cameras["left"],
        rig.cameras["right"],
        right_from_left,
        world_from_right or Motion.identity(),
    )


def _differences(first: Calibrated, second: Calibrated) -> dict[tuple[str, str], float]:
    values = [_values(fit) for fit in (first, second)]
    variances = [
        dict(zip(fit.fit.names, np.diag(fit.fit.covariance).tolist(), strict=True))
        for fit in (first, second)
    ]
    return {
        key: (
            (values[0][key] - values[1][key])
            / float(np.sqrt(variances[0][key] + variances[1][key]))
        )
        for key in first.fit.names
    }


def _values(joined: Calibrated) -> dict[tuple[str, str], float]:
    rig = joined.fit.rig
    found: dict[tuple[str, str], float] = {}
    for name, camera in rig.cameras.items():
        found |= {
            (name, p): v for p, v in zip(LENS, (*camera.fc, *camera.cc, *camera.kc), strict=True)
        }
        motion = rig.from_reference[name]
        found |= {(name, p): float(v) for p, v in zip(POSE, (*motion.om, *motion.T), strict=True)}
    return found
