"""The teat end: the one definition of what is measured, and the geometry that follows from it.

The scene draws it, the truth states it, the report prints it; all of them come here. Pure: vectors
in, vectors out. May not know of phantoms, arms or pictures.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

DEFINITION = (
    "Apex of the teat's rounded end on the teat's own axis, in the world frame (the table, set with"
    " the arm)."
)


def apex_mm(bases_mm: ArrayLike, axes: ArrayLike, lengths_mm: ArrayLike) -> Floats:
    """Teat ends (n, 3): from each base (n, 3) along the unit axis (n, 3), base to end, by the
    teat's length (n,).
    """
    lengths = np.asarray(lengths_mm, dtype=np.float64).reshape(-1, 1)
    return np.asarray(
        np.asarray(bases_mm, dtype=np.float64) + lengths * np.asarray(axes, dtype=np.float64)
    )


def ball_centre_mm(end_mm: ArrayLike, axis: ArrayLike, radius_mm: float) -> Floats:
    """Where the centre (3,) of a ball tip is that rests on the end (3,) of a teat whose unit axis
    (3,) points from base to end.
    """
    return np.asarray(
        np.asarray(end_mm, dtype=np.float64) + radius_mm * np.asarray(axis, dtype=np.float64)
    )


def end_under_ball_mm(centres_mm: ArrayLike, axis: ArrayLike, radius_mm: float) -> Floats:
    """Teat ends (n, 3) or (3,) under a ball tip whose centres were read: the inverse of
    `ball_centre_mm`; radius 0 is a point tip.
    """
    return np.asarray(
        np.asarray(centres_mm, dtype=np.float64) - radius_mm * np.asarray(axis, dtype=np.float64)
    )
