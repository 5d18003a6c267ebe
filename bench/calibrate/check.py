"""An existing calibration against a board seen, or points touched, today: does it still hold?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from bench.calibrate.views import BoardViews
from bench.calibrate.world import TouchedPoints
from bench.config import ConfigError
from detector.calibration import Part
from detector.calibration.diagnosis import Finding, Remeasured, measured_again, remeasure
from detector.calibration.values import Pair, covariance_of_points
from detector.geometry import Array, Motion

SIGNIFICANT = 1e-4  # of a chance to accuse a calibration that holds
MOVED_MATTERS_MM = 1.0
SCATTER_MATTERS = 2.0  # times what is expected


@dataclass(frozen=True, slots=True, eq=False)
class PointsAgain:
    """Points that the arm touched, measured again: measured less touched (n, 3) mm, and what to
    expect of each distance (n,) mm.
    """

    missed_mm: Array
    expected_mm: Array


def check_pair(part: Part, views: BoardViews) -> tuple[Remeasured, tuple[Finding, ...]]:
    """The board measured with the pair, and what that tells. Raises ConfigError without a pair, or
    without a view of both.
    """
    if part.left is None or part.right is None or part.right_from_left is None:
        raise ConfigError.plain(
            "the file holds no stereo pair ([cameras.left], [cameras.right], [stereo])"
        )
    for camera, lens in (("left", part.left), ("right", part.right)):
        if views.image_size[camera] != lens.image_size:
            seen, known = (
                "{} x {}".format(*size) for size in (views.image_size[camera], lens.image_size)
            )
            raise ConfigError.plain(
                f"the {camera} pictures are {seen} px, the calibration is for {known}: made for"
                " other cameras"
            )
    pairs = views.pairs()
    if not pairs:
        raise ConfigError.plain("the board was found in no view of both cameras")
    pair = Pair(part.left, part.right, part.right_from_left, Motion.identity())
    again = remeasure(pair, views.board, pairs)
    return again, tuple(measured_again(again, pair))


def check_points(
    part: Part, points: TouchedPoints, *, pixel_sd_px: float, touch_sd_mm: float
) -> tuple[PointsAgain, tuple[Finding, ...]]:
    """One or more touched points measured with a whole calibration, and what that tells. Raises
    ConfigError for a part of one.
    """
    if (
        part.left is None
        or part.right is None
        or part.right_from_left is None
        or part.world_from_right is None
    ):
        raise ConfigError.plain(
            "touched points need a whole calibration, with [cameras.left], [cameras.right],"
            " [stereo] and [world]"
        )
    if not len(points.touched_mm):
        raise ConfigError.plain("the table of touched points is empty")
    pair = Pair(part.left, part.right, part.right_from_left, part.world_from_right)
    missed = pair.place(points.left_px, points.right_px) - points.touched_mm
    if not np.isfinite(missed).all():
        bad = int(np.flatnonzero(~np.isfinite(missed).all(axis=1))[0]) + 1
        raise ConfigError.plain(
            f"point {bad} can't be triangulated: its pixels are outside of what the lenses were"
            " calibrated for"
        )
    noise = covariance_of_points(
        pair, None, points.touched_mm, pixel_sd_px
    ) + touch_sd_mm**2 * np.eye(3)
    own = covariance_of_points(pair, part.covariance, points.touched_mm, 0.0)
    again = PointsAgain(missed, np.sqrt(np.trace(noise + own, axis1=1, axis2=2)))
    return again, (*_moved(missed, noise, own), *_scattered(missed, noise, own))


def _moved(missed: Array, noise: Array, own: Array) -> list[Finding]:
    """Whether all are off the same way: the calibration's own error is common to them, noise
    averages out.
    """
    mean = missed.mean(axis=0)
    covariance = own.mean(axis=0) + noise.mean(axis=0) / len(missed)
    if np.linalg.norm(mean) < MOVED_MATTERS_MM or mean @ np.linalg.solve(
        covariance, mean
    ) < chi2.ppf(1.0 - SIGNIFICANT, 3):
        return []
    x, y, z = mean
    said = (
        f"points are measured {np.linalg.norm(mean):.1f} mm off on the mean ({x:+.1f}, {y:+.1f},"
        f" {z:+.1f} mm)"
    )
    return [
        Finding(
            "moved cameras",
            f"{said}: the cameras, the arm or the table have moved against each other since",
        )
    ]


def _scattered(missed: Array, noise: Array, own: Array) -> list[Finding]:
    """Whether they are off in different ways by more than noise and calibration allow."""
    if len(missed) < 2:
        return []
    left_over = float(np.sum((missed - missed.mean(axis=0)) ** 2)) / (len(missed) - 1)
    expected = float(np.trace(noise + own, axis1=1, axis2=2).mean())
    limit = max(
        SCATTER_MATTERS**2,
        chi2.ppf(1.0 - SIGNIFICANT, 3 * (len(missed) - 1)) / (3 * (len(missed) - 1)),
    )
    if left_over < limit * expected:
        return []
    said = (
        f"points scatter by {np.sqrt(left_over):.1f} mm, where {np.sqrt(expected):.1f} mm is to be"
        " expected"
    )
    return [
        Finding(
            "scattered points",
            f"{said}: a lens or one of the cameras has moved, or points were mistaken for each"
            " other",
        )
    ]
