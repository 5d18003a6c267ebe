"""The error map of the plane, as data: what was found at each place, and how far off. Knows no plot.

A cell is a place of its own, or a square of the plane where a step is named. What was missed is counted in its cell: a map of the found
alone would look best where the detector finds least.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bench.scoring.points import Bools, Floats, as_points, as_values


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell: its centre, teats there and how many were found; of these the mean error (signed, world axes) and the distances, mm.

    Errors are None where nothing was found.
    """

    x_mm: float
    y_mm: float
    teats: int
    found: int
    bias_mm: tuple[float, float, float] | None = None
    mean_mm: float | None = None
    rms_mm: float | None = None
    max_mm: float | None = None


def error_map(
    places_mm: npt.ArrayLike, errors_mm: npt.ArrayLike, found: npt.ArrayLike | None = None, *, step_mm: float | None = None
) -> tuple[Cell, ...]:
    """Cells in order of y, then x. `places_mm` (n, 2) are the true ends on the plane; `errors_mm` (k, 3) found - truth of those found.

    `found` (n,) says which were (none given: all). `step_mm` is a square's side, with a square's centre on (0, 0); without it each
    place, rounded to 0.01 mm, is a cell. Raises ValueError where the numbers of rows don't fit.
    """
    places = np.asarray(places_mm, dtype=np.float64).reshape(-1, 2)
    errors = as_points(errors_mm, "errors")
    was_found: Bools = np.ones(len(places), dtype=np.bool_) if found is None else np.asarray(found, dtype=np.bool_)
    if was_found.shape != (len(places),) or int(was_found.sum()) != len(errors):
        raise ValueError(f"error map: {len(places)} places, {int(was_found.sum())} of them found, but {len(errors)} errors")
    if step_mm is not None and not step_mm > 0.0:
        raise ValueError(f"error map: a step of {step_mm} mm is not above 0")
    as_values(places.ravel(), "places")
    side = 0.01 if step_mm is None else step_mm
    at = np.rint(places / side).astype(np.int64)
    first = at.min(axis=0, initial=0)
    width = int((at - first).max(initial=0)) + 1
    key, cell = np.unique((at - first) @ np.array([1, width]), return_inverse=True)  # one number a cell: y above x
    centres = np.column_stack([key % width, key // width]) + first
    return _cells(centres * side, cell.ravel(), errors, was_found)


def _cells(centres: Floats, cell: npt.NDArray[np.intp], errors: Floats, found: Bools) -> tuple[Cell, ...]:
    count, at = len(centres), cell[found]
    teats, n = np.bincount(cell, minlength=count), np.bincount(at, minlength=count)
    distance = np.linalg.norm(errors, axis=1)
    worst = np.zeros(count)
    np.maximum.at(worst, at, distance)
    sums = np.column_stack([np.bincount(at, column, minlength=count) for column in (*errors.T, distance, distance**2)])
    some = np.maximum(n, 1)
    means = sums / some[:, None]
    rows = zip(centres.tolist(), teats.tolist(), n.tolist(), means.tolist(), worst.tolist(), strict=True)
    return tuple(
        Cell(x, y, all_teats, k, (m[0], m[1], m[2]), m[3], m[4] ** 0.5, largest) if k else Cell(x, y, all_teats, 0)
        for (x, y), all_teats, k, m, largest in rows
    )
