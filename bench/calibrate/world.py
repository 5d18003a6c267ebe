"""Camera to table from points that the arm touched and both cameras saw, read from comma-separated
values with a first line of names.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.calibrate.merge import pair_of_part
from bench.config import ConfigError, short
from detector.calibration import Part, Record
from detector.calibration.diagnosis import Finding, against_the_arm
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
    """The fit, the points it was made of, and what they tell of the pair."""

    points: TouchedPoints
    fit: WorldFit
    findings: tuple[Finding, ...]

    def part(self, record: Record) -> Part:
        """What the file of this step holds: the world, and the covariance of it with the pair's."""
        return Part(
            world_from_right=self.fit.world_from_right,
            covariance=self.fit.covariance,
            record=record,
        )


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
    return WorldResult(points, fit, tuple(against_the_arm(fit)))
