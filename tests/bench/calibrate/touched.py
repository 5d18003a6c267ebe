"""Points that an arm touched before the drawn cameras, and what a part of a calibration holds."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import numpy as np

from detector.calibration import Part
from detector.geometry import Motion
from tests.bench.calibrate.board_pictures import LEFT, RIGHT, RIGHT_FROM_LEFT

WORLD_FROM_RIGHT = Motion.from_vectors([-1.57, 0.02, -0.02], [-160.0, -840.0, 60.0])
X_MM, Y_MM, Z_MM = (-300.0, -190.0, -80.0), (60.0, 160.0, 250.0), (40.0, 120.0)
TOUCHED = np.array([[x, y, z] for z in Z_MM for x in X_MM for y in Y_MM])


def write_touched(path: Path, noise_mm: float = 0.1) -> Path:
    rng = np.random.default_rng(4)
    in_right = WORLD_FROM_RIGHT.inverse().apply(TOUCHED)
    left, right = LEFT.project(RIGHT_FROM_LEFT.inverse().apply(in_right)), RIGHT.project(in_right)
    rows = np.column_stack([left, right, TOUCHED + rng.normal(0, noise_mm, TOUCHED.shape)])
    lines = [
        "left_x,left_y,right_x,right_y,x_mm,y_mm,z_mm",
        *(",".join(f"{v:.4f}" for v in row) for row in rows),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


T = TypeVar("T")


def there(value: T | None) -> T:
    """``value``, which must be there."""
    assert value is not None
    return value


def within(part: Part, owner: str, off: dict[str, float]) -> bool:
    """Whether these parameters are off by less than four times what ``part`` states."""
    stated = there(part.covariance)
    return all(abs(by) < 4.0 * (stated.sd(owner, name) or 0.0) for name, by in off.items())


def placed(part: Part, owner: str, found: Motion, known: Motion, axes: str = "123") -> bool:
    """Whether the place is found, along these axes."""
    off = found.T - known.T
    return within(part, owner, {f"T{axis}": float(off[int(axis) - 1]) for axis in axes})
