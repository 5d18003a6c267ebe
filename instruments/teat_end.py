"""The teat end: the one definition of what is measured, and its geometry."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

DEFINITION = (
    "Apex of the teat's rounded end on the teat's own axis, in the world frame (the table, set with"
    " the arm)."
)


def apex_mm(bases_mm: ArrayLike, axes: ArrayLike, lengths_mm: ArrayLike) -> Floats:
    """Teat ends (n, 3) of bases (n, 3), unit axes (n, 3) from base to end, lengths (n,)."""
    lengths = np.asarray(lengths_mm, dtype=np.float64).reshape(-1, 1)
    return np.asarray(
        np.asarray(bases_mm, dtype=np.float64) + lengths * np.asarray(axes, dtype=np.float64)
    )


def ball_centre_mm(end_mm: ArrayLike, axis: ArrayLike, radius_mm: float) -> Floats:
    """Centre (3,) of a ball tip on the end (3,) of a teat with unit axis (3,) from its base."""
    return np.asarray(
        np.asarray(end_mm, dtype=np.float64) + radius_mm * np.asarray(axis, dtype=np.float64)
    )


def end_under_ball_mm(centres_mm: ArrayLike, axis: ArrayLike, radius_mm: float) -> Floats:
    """Teat ends (n, 3) or (3,) under ball tips of that radius, 0 for a point tip."""
    return ball_centre_mm(centres_mm, axis, -radius_mm)
