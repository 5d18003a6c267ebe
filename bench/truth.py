"""Ground truth by touch: several readings of the arm at one teat end become one point with a standard uncertainty.

The measurand is the apex of the teat's rounded end on its own axis, in the world frame. Pure: readings in, a
`TruthPoint` out; who touched, and with what, is the engine's business.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.scoring.uncertainty import Component, TruthUncertainty

ROUNDING_MM = 0.105 / 3**0.5  # 0.105 mm rms in space over random poses (the arm's fact sheet), along one axis
REGISTRATION = "the table frame's three touches, each with the arm's accuracy, propagated to this teat end"
DEFINITION = "Apex of the teat's rounded end on the teat's own axis, in the world frame (the table, set with the arm)."


@dataclass(frozen=True, slots=True)
class TruthPoint:
    """A teat end: ``point_mm`` (3,) in the world frame, and its uncertainty budget (standard uncertainties along one axis)."""

    point_mm: tuple[float, float, float]
    uncertainty: TruthUncertainty


def touched(tips_mm: NDArray[np.float64], *, accuracy_mm: float, definition_mm: float, registration_mm: float | None = None) -> TruthPoint:
    """The mean of the touches (n, 3) at one teat end.

    ``accuracy_mm`` is the arm's own (the maker's figure), ``definition_mm`` how well a hand finds the apex; the
    scatter of the touches enters as the uncertainty of their mean. ``registration_mm`` is what the table frame adds at this
    place, None where the world is the arm's own frame. Raises ValueError without a touch.
    """
    tips = np.asarray(tips_mm, dtype=np.float64)
    if tips.ndim != 2 or tips.shape[1] != 3 or not len(tips):
        raise ValueError(f"touches must be (n, 3) with n at least 1, not {tips.shape}")
    x, y, z = tips.mean(axis=0)
    scatter = float(np.sqrt(np.mean(np.var(tips, axis=0, ddof=1)) / len(tips))) if len(tips) > 1 else 0.0
    frame = () if registration_mm is None else (Component("registration", registration_mm, REGISTRATION),)
    budget = TruthUncertainty(
        (
            Component("arm", accuracy_mm, "the arm's stated accuracy, taken along each axis (rig file)"),
            *frame,
            Component("definition", definition_mm, "how well a hand finds the apex of the rounded end (rig file)"),
            Component("resolution", ROUNDING_MM, "rounding of the arm's encoder counts, rms over its reach"),
            Component("scatter", scatter, f"standard deviation of the mean of {len(tips)} touches"),
        )
    )
    return TruthPoint((float(x), float(y), float(z)), budget)
