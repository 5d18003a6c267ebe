"""What a frame set shows that isn't among the answers, each in a sentence: warm ends in the thermal
picture that no answer explains, and fits that may have been ends. And what an answer is that lies
outside of what teats are, or whose place is unsure.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.fused.decide import WORSE, Decision, Fits
from detector.geometry import Array
from detector.outline.model import RADIUS, apexes
from detector.outline.prior import Prior, world_from_teats

_NO_FIT = "the optical pictures show no outline there"
_PLACE_MM, _NEAR_SENSOR_PX = 15.0, 6.0  # fits and thermal ends so near are of one thing
_SDS = 2.576  # in which 99 % of errors along an axis lie
_IN_DEPTH = 0.9  # of a unit vector: within 26 degrees of the camera's axis


def left_out(
    teats: Array,
    decision: Decision,
    doubtful: NDArray[np.bool_],
    thermal_px: Array,
    warm_px: Array,
    px_a_sensor_px: float,
    calibration: Calibration,
) -> list[str]:
    """Of fits (m, 8), ``thermal_px`` (m, 2) their ends in the delivered picture, the ``doubtful``
    ones that aren't accepted, one a place; and of unexplained thermal ends ``warm_px`` (w, 2).
    """
    world = world_from_teats(calibration).apply(apexes(teats))
    left_px, _ = calibration.project(world)
    near = np.linalg.norm(world[:, None] - world, axis=2) < _PLACE_MM
    named, found = list(decision.accepted), list[str]()
    order = np.argsort(-decision.odds, kind="stable").tolist()
    for i in order:
        # what passes through an accepted teat is that teat
        if doubtful[i] and decision.reasons[i] not in (None, WORSE) and not near[i, named].any():
            named.append(i)
            x, y = left_px[i].tolist()
            found.append(f"left out at left ({x:.0f}, {y:.0f}): {decision.reasons[i]}")
    for place in warm_px:
        off = np.linalg.norm(thermal_px - place, axis=1) / px_a_sensor_px
        if (off[named] < _NEAR_SENSOR_PX).any():
            continue
        why = next((decision.reasons[i] for i in order if off[i] < _NEAR_SENSOR_PX), None)
        x, y = place.tolist()
        found.append(f"left out at thermal ({x:.0f}, {y:.0f}): {why or _NO_FIT}")
    return found


def outside(fits: Fits) -> list[str]:
    """Of given ends, what they lack to be as teats are."""
    lean, size = fits.too_steep > 0, fits.off_size > 0
    degrees, wide = np.degrees(np.arctan(fits.lean)), 2 * fits.teats[:, RADIUS]
    return [
        *(f"an end as of a teat, leaning {angle:.0f} degrees" for angle in degrees[lean]),
        *(f"an end as of a teat, {mm:.0f} mm wide" for mm in wide[size]),
    ]


def unsure_ends(left_px: Array, covariances: Array, prior: Prior) -> list[str]:
    """Of given ends (m, 2) of the left picture, each that may be farther off than an end may be
    where a cup is put on, by covariances (m, 3, 3) mm^2, right camera's frame, without what the
    ends of a frame have in common.
    """
    variances, ways = np.linalg.eigh(covariances)
    off, in_depth = _SDS * np.sqrt(variances[:, -1]), np.abs(ways[:, 2, -1]) > _IN_DEPTH
    return [
        f"unsure at left ({x:.0f}, {y:.0f}): an end that may be more than {prior.within_mm:.0f} mm"
        f" off{' in depth' if deep else ''}"
        for (x, y), mm, deep in zip(left_px.tolist(), off, in_depth, strict=True)
        if mm > prior.within_mm
    ]
