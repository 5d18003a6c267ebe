"""A position out of several packets: what the arm says when it is held still, and that it was.

Pure: it may not know the wire, nor any frame of reference but the arm's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from instruments.microscribe.kinematics import ArmGeometry


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One position in the arm's frame.

    ``tip_mm`` (3,) is the median tip, ``spread_mm`` the largest distance of one packet's tip from it,
    ``axis`` (3,) the unit median direction from the tip up the stylus, ``n`` the packets, ``counts``
    the last packet's.
    """

    tip_mm: npt.NDArray[np.float64]
    spread_mm: float
    axis: npt.NDArray[np.float64]
    n: int
    counts: tuple[int, ...]


def reading_of(geometry: ArmGeometry, counts: Sequence[tuple[int, ...]]) -> Reading:
    """The reading of packets with ``counts`` (n, 6), n at least 1. One wrong packet moves no median."""
    tips, axes = geometry.forward(np.array(counts))
    tip, axis = np.median(tips, axis=0), np.median(axes, axis=0)
    spread_mm = float(np.linalg.norm(tips - tip, axis=1).max())
    return Reading(tip, spread_mm, axis / np.linalg.norm(axis), len(counts), counts[-1])
