"""Corners of a chessboard that were found beside their places: told by their neighbours.

Strategy: along each row and column a corner lies half-way between its neighbours, or goes on from the two before it; lens and tilt bend
that by far less than the distance between corners. The median over all that is told bears one neighbour astray. May not know pictures.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from detector.geometry import Array

STRAY = 0.25  # of the distance between corners


def between_neighbours(grid_px: NDArray[Any]) -> Array:
    """Where each corner of (rows, columns, 2), three or more each way, should lie by its neighbours, same shape."""
    told: list[Array] = []
    for axis in (0, 1):
        along = np.moveaxis(np.asarray(grid_px, dtype=np.float64), axis, 0)
        padded = np.pad(along, [(2, 2), (0, 0), (0, 0)], constant_values=np.nan)
        before, last, following, after = padded[:-4], padded[1:-3], padded[3:-1], padded[4:]
        ways = (0.5 * (last + following), 2.0 * last - before, 2.0 * following - after)
        told += [np.moveaxis(way, 0, axis) for way in ways]
    return np.asarray(np.nanmedian(told, axis=0))


def strays(grid_px: NDArray[Any]) -> NDArray[np.bool_]:
    """Which corners of (rows, columns, 2) lie farther from where their neighbours tell than `STRAY` allows, (rows, columns)."""
    steps = [np.linalg.norm(np.diff(grid_px, axis=axis), axis=2) for axis in (0, 1)]
    usual = float(min(np.median(step) for step in steps))
    return np.asarray(np.linalg.norm(grid_px - between_neighbours(grid_px), axis=2) > STRAY * usual)
