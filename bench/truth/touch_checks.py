"""When a touch is refused: a reading that doesn't belong to the others, and a tip that stands at
another teat. Pure, and robust.

**Outliers.** Readings of one end differ by hand and rounding only, whose standard deviation s0
along an axis is known beforehand. A reading is refused when its distance from the median of all (by
axis) is more than `FAR` times s, where s is the larger of s0 and the scatter that the readings show
themselves, median distance / 1.538 (the median length of a standard normal vector in space). So an
unsteady hand widens its own limit, one slip of the tip doesn't; of two readings that far apart
neither can be trusted. With normal readings one end in some 3000 loses one falsely.

**Wrong teat.** Expected places are only as good as the phantom's placement, so places are compared
with each other: those of the teats touched already give the common shift, and a touch is refused
where another teat's shifted place is nearer than the asked one's by more than `TELL_MM`, or where
it falls on an end that was touched already.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bench.scoring.matching import LEAST_SPACING_MM

FAR = 5.0
MEDIAN_LENGTH = 1.5382
TELL_MM = 2.0  # nearer to the other teat by this, or the two are taken to be equally near
# of the expected distance between two ends: nearer than that, the tip stands at one of them twice
SAME_SHARE = 0.25

Floats = NDArray[np.float64]


def touched_before(point_mm: Floats, teat: int, done_mm: Mapping[int, Floats]) -> str | None:
    """Why a touch (3,) asked of ``teat`` is another's that was touched already, also where nobody
    knows the places; None where it isn't.
    """
    point = np.asarray(point_mm, dtype=np.float64)
    for other, place in done_mm.items():
        apart = float(np.linalg.norm(point - place))
        if other != teat and apart < LEAST_SPACING_MM:
            return (
                f"That is the end of teat {other} once more ({apart:.1f} mm from where it was"
                " touched)."
            )
    return None


def outliers(points_mm: Floats, s0_mm: float) -> dict[int, str]:
    """Rows of readings (n, 3) of one end that are refused, with the reason. Of one reading none; of
    two both or none.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    if len(points) < 2:
        return {}
    if len(points) == 2:
        apart, limit = float(np.linalg.norm(points[0] - points[1])), FAR * s0_mm * 2.0**0.5
        reason = f"two readings {apart:.2f} mm apart, limit {limit:.2f} mm: neither can be trusted"
        return dict.fromkeys((0, 1), reason) if apart > limit else {}
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    limit = FAR * max(s0_mm, float(np.median(away)) / MEDIAN_LENGTH)
    return {
        int(
            row
        ): f"{away[row]:.2f} mm from the median of {len(points)} readings, limit {limit:.2f} mm"
        for row in np.flatnonzero(away > limit)
    }


def mistaken(
    point_mm: Floats, teat: int, expected_mm: Floats, done_mm: Mapping[int, Floats]
) -> str | None:
    """Why a touch (3,) that was asked of ``teat`` (from 1) isn't one of it; None where it may be.

    ``expected_mm`` (n, 3) are the places of all ends, ``done_mm`` what was touched by teat.
    """
    point, expected = (
        np.asarray(point_mm, dtype=np.float64),
        np.asarray(expected_mm, dtype=np.float64),
    )
    for other, place in done_mm.items():
        apart = float(np.linalg.norm(point - place))
        if other != teat and apart < SAME_SHARE * float(
            np.linalg.norm(expected[teat - 1] - expected[other - 1])
        ):
            return (
                f"That is the end of teat {other} once more ({apart:.1f} mm from where it was"
                " touched)."
            )
    shifts = [place - expected[other - 1] for other, place in done_mm.items()]
    away = np.linalg.norm(expected + (np.mean(shifts, axis=0) if shifts else 0.0) - point, axis=1)
    nearest = int(np.argmin(away)) + 1
    if nearest == teat or away[nearest - 1] + TELL_MM >= away[teat - 1]:
        return None
    return (
        f"That looks like teat {nearest}: it is {away[nearest - 1]:.0f} mm from that teat's place, "
        f"and {away[teat - 1]:.0f} mm from the place of teat {teat}."
    )
