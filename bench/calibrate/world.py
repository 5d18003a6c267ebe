"""Points that the arm touched and both cameras saw, read from comma-separated values with a first
line of names: camera to table from them, or whether an existing calibration still holds.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from bench.calibrate.merge import pair_of_part
from bench.config import ConfigError, short
from detector.calibration import Part, Record
from detector.calibration.diagnosis import Finding, against_the_arm
from detector.calibration.values import covariance_of_points
from detector.calibration.world import WorldFit, fit_world
from detector.geometry import Array


def read_table(path: Path, columns: tuple[str, ...]) -> Mapping[str, Array]:
    """Columns of numbers from a CSV file with a first line of names. Raises ConfigError with the
    line.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = csv.DictReader(file, strict=True)
            if missing := [name for name in columns if name not in (lines.fieldnames or ())]:
                raise ConfigError.plain(
                    f"{path}:1: the column(s) {', '.join(missing)} are missing; the first line must"
                    f" name {','.join(columns)}"
                )
            rows = [
                [_number(f"{path}:{lines.line_num}", name, line[name]) for name in columns]
                for line in lines
            ]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError.plain(
            f"{path}: can't be read as a table of comma-separated values in UTF-8: {error}"
        ) from error
    table = np.array(rows, dtype=np.float64).reshape(-1, len(columns))
    return dict(zip(columns, table.T, strict=True))


def _number(where: str, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        raise ConfigError.plain(
            f"{where}: {name} must be a number, is {short(repr(text))}"
        ) from None
    if not np.isfinite(value):
        raise ConfigError.plain(f"{where}: {name} must be finite, is {text!r}")
    return value


SIGNIFICANT = 1e-4  # of a chance to accuse a calibration that holds
MOVED_MATTERS_MM = 1.0
SCATTER_MATTERS = 2.0  # times what is expected
POINT_COLUMNS = ("left_x", "left_y", "right_x", "right_y", "x_mm", "y_mm", "z_mm")
LEAST_POINTS = 4  # three fix the pose and leave nothing to see by whether it is right


@dataclass(frozen=True, slots=True, eq=False)
class TouchedPoints:
    """Points (n, 2) px in each camera, and (n, 3) mm where the arm touched them, in the world
    frame.
    """

    left_px: Array
    right_px: Array
    touched_mm: Array


@dataclass(frozen=True, slots=True, eq=False)
class WorldResult:
    """The fit, and what it tells of the pair."""

    fit: WorldFit
    findings: tuple[Finding, ...]

    def part(self, record: Record) -> Part:
        """What the file of this step holds: the world, and the covariance of it with the pair's."""
        fit = self.fit
        return Part(world_from_right=fit.world_from_right, covariance=fit.covariance, record=record)


def read_points(path: Path) -> TouchedPoints:
    """Touched points from a table (`POINT_COLUMNS`). Raises ConfigError with the line."""
    table = read_table(path, POINT_COLUMNS)
    left, right, touched = (
        np.column_stack([table[name] for name in names])
        for names in (POINT_COLUMNS[:2], POINT_COLUMNS[2:4], POINT_COLUMNS[4:])
    )
    return TouchedPoints(left, right, touched)


def calibrate_world(
    points: TouchedPoints, cameras: Part, *, pixel_sd_px: float, touch_sd_mm: float
) -> WorldResult:
    """The world's pose. Raises ConfigError (a sentence) for points that don't determine it, or a
    file without the pair.
    """
    pair = pair_of_part(cameras)
    if len(points.touched_mm) < LEAST_POINTS:
        raise ConfigError.plain(
            f"{len(points.touched_mm)} touched points are too few: at least {LEAST_POINTS}, 18 at"
            " two heights are good"
        )
    try:
        fit = fit_world(
            pair.left,
            pair.right,
            pair.right_from_left,
            points.left_px,
            points.right_px,
            points.touched_mm,
            pair_covariance=cameras.covariance,
            pixel_sd_px=pixel_sd_px,
            touch_sd_mm=touch_sd_mm,
        )
    except ValueError as error:
        raise ConfigError.plain(f"the touched points determine no world: {error}") from error
    return WorldResult(fit, tuple(against_the_arm(fit)))


@dataclass(frozen=True, slots=True, eq=False)
class PointsAgain:
    """Points that the arm touched, measured again: measured less touched (n, 3) mm, and what to
    expect of each distance (n,) mm.
    """

    missed_mm: Array
    expected_mm: Array


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
