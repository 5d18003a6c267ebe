"""An existing calibration against a board seen, or points touched, today: does it still hold?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from bench.calibrate.merge import pair_of_part
from bench.calibrate.views import BoardViews
from bench.calibrate.world import TouchedPoints
from bench.config import ConfigError
from detector.calibration import Part
from detector.calibration.diagnosis import Finding, Remeasured, measured_again, remeasure
from detector.calibration.values import covariance_of_points
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
    pair = pair_of_part(part)
    pair = replace(pair, world_from_right=Motion.identity())
    for camera, lens in (("left", pair.left), ("right", pair.right)):
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
    again = remeasure(pair, views.board, pairs)
    return again, tuple(measured_again(again, pair))


def check_points(
    part: Part, points: TouchedPoints, *, pixel_sd_px: float, touch_sd_mm: float
) -> tuple[PointsAgain, tuple[Finding, ...]]:
    """One or more touched points measured with a whole calibration, and what that tells. Raises
    ConfigError for a part of one.
    """
    pair = pair_of_part(part)
    if part.world_from_right is None:
        raise ConfigError.plain(
            "touched points need a whole calibration, with [cameras.left], [cameras.right],"
            " [stereo] and [world]"
        )
    if not len(points.touched_mm):
        raise ConfigError.plain("the table of touched points is empty")
    missed = pair.place(points.left_px, points.right_px) - points.touched_mm
    if not np.isfinite(missed).all():
        bad = int(np.flatnonzero(~np.isfinite(missed).all(axis=1))[0]) + 1
        raise ConfigError.plain(
            f"point {bad} can't be triangulated: its pixels are outside of what the lenses were"
            " calibrated for"
        )
    noise = covariance_of_points(pair, None, points.touched_mm, pixel_sd_px)
    noise += touch_sd_mm**2 * np.eye(3)
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
    sentence = (
        f"points are measured {np.linalg.norm(mean):.1f} mm off on the mean ({x:+.1f}, {y:+.1f},"
        f" {z:+.1f} mm): the cameras, the arm or the table have moved against each other since"
    )
    return [Finding("moved cameras", sentence)]


def _scattered(missed: Array, noise: Array, own: Array) -> list[Finding]:
    """Whether they are off in different ways by more than noise and calibration allow."""
    free = len(missed) - 1
    if not free:
        return []
    left_over = float(np.sum((missed - missed.mean(axis=0)) ** 2)) / free
    expected = float(np.trace(noise + own, axis1=1, axis2=2).mean())
    limit = max(SCATTER_MATTERS**2, chi2.ppf(1.0 - SIGNIFICANT, 3 * free) / (3 * free))
    if left_over < limit * expected:
        return []
    sentence = (
        f"points scatter by {np.sqrt(left_over):.1f} mm, where {np.sqrt(expected):.1f} mm is to be"
        " expected: a lens or one of the cameras has moved, or points were mistaken for each other"
    )
    return [Finding("scattered points", sentence)]
