"""The checks that every array passes on its way into a score, and names as numbers. Knows nothing but shapes."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from math import isfinite

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


def as_points(value: npt.ArrayLike, name: str) -> Floats:
    """`value` as float64 (n, 3); anything empty becomes (0, 3). Raises ValueError on another shape or on a value that is not finite."""
    points = np.asarray(value, dtype=np.float64)
    if points.size == 0:
        return np.zeros((0, 3))
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name}: expected points of shape (n, 3) in mm, got shape {points.shape}; a single point is [[x, y, z]]")
    if not isfinite(np.add.reduce(points, axis=None)) and not np.isfinite(points).all():  # the sum first: one look where all is well
        row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise ValueError(f"{name}: point {row} is {points[row].tolist()}, which is not finite; leave out a teat that was not found")
    return points


def as_values(value: npt.ArrayLike, name: str) -> Floats:
    """`value` as float64 (n,). Raises ValueError on another shape or on a value that is not finite."""
    values = np.asarray(value, dtype=np.float64)
    if values.size == 0:
        return np.zeros(0)
    if values.ndim != 1:
        raise ValueError(f"{name}: expected a list of numbers, got shape {values.shape}")
    if not np.isfinite(values).all():
        place = int(np.flatnonzero(~np.isfinite(values))[0])
        raise ValueError(f"{name}: value {place} is {values[place]}, which is not finite; leave out what was not measured")
    return values


def numbered(names: Sequence[Hashable]) -> npt.NDArray[np.intp]:
    """Names (n,) as numbers from 0, in order of their first appearance."""
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return np.fromiter(map(numbers.__getitem__, names), dtype=np.intp, count=len(names))
