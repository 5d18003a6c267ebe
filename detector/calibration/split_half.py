"""Split-half comparison: two calibrations, each from every other view, and how far they disagree.

It tests the stated standard deviations. Reprojection error can't: few views reproject better, and
are worse.
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
    """Two calibrations of one pair; ``differences`` of parameters in combined sd."""

    pairs: tuple[Pair, Pair]
    differences: Mapping[tuple[str, str], float]

    def disagree_mm(self, left_px: ArrayLike, right_px: ArrayLike) -> Array:
        """Distance (n,) mm of points that both triangulate from pixels (n, 2), right's frame."""
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
    """Both halves of the shared views, alone and jointly. Raises TooFewViewsError."""
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
    """The pair of an adjustment of left and right; without a world, the right camera's frame."""
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
