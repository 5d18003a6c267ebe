"""Repeatability and reproducibility of the bench itself: gage R&R of the ground truth, a crossed analysis of variance.

AIAG, Measurement Systems Analysis, 4th edition, chapter III (ANOVA method), and ISO 22514-7: parts are teat ends at poses, appraisers are
set-ups (repeats of the pose, or runs), repeats are touches. A component below zero is zero. An interaction that isn't significant at
25 % is pooled into the repeatability, as the manual does. Knows only numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, sqrt

import numpy as np
import numpy.typing as npt
from scipy.special import fdtrc

POOL_ABOVE = 0.25
STUDY_SDS = 6.0  # a study variation is 6 standard deviations: 99.73 % of a normal process


@dataclass(frozen=True, slots=True)
class GageStudy:
    """Standard deviations along one axis, in the values' unit, and the analysis of variance that they come from.

    `repeatability`: touch after touch. `reproducibility`: set-up after set-up, the interaction with the part included. `gage`: both.
    `part`: between teat ends. `interaction_p` is None where it can't be tested.
    """

    parts: int
    appraisers: int
    repeats: int
    repeatability: float
    reproducibility: float
    appraiser: float
    interaction: float
    part: float
    sums_of_squares: tuple[float, float, float, float]  # parts, appraisers, interaction, within
    interaction_p: float | None
    pooled: bool

    @property
    def gage(self) -> float:
        """sqrt(repeatability^2 + reproducibility^2): the measuring system's standard deviation."""
        return sqrt(self.repeatability**2 + self.reproducibility**2)

    @property
    def total(self) -> float:
        """With the parts."""
        return sqrt(self.gage**2 + self.part**2)

    @property
    def distinct_categories(self) -> int:
        """ndc = floor(1.41 part / gage), at least 1: how many sizes of part it can tell apart."""
        return max(1, floor(1.41 * self.part / self.gage)) if self.gage > 0.0 else 1

    def share_of_tolerance(self, tolerance: float) -> float:
        """6 gage / tolerance; `tolerance` is the whole width (10 mm for +-5 mm). Below 0.1 is good, above 0.3 is not acceptable (AIAG)."""
        if not tolerance > 0.0:
            raise ValueError(f"tolerance: {tolerance} is not above 0")
        return STUDY_SDS * self.gage / tolerance


def gage_study(values: npt.ArrayLike) -> GageStudy:
    """The study of `values` (parts, appraisers, repeats), every cell full; at least 2 of each. Raises ValueError on anything else."""
    table = np.asarray(values, dtype=np.float64)
    if table.ndim != 3 or min(table.shape) < 2 or not np.isfinite(table).all():
        raise ValueError(
            f"gage study: expected finite values (parts, appraisers, repeats) with at least 2 of each, got shape {table.shape}"
        )
    p, a, r = table.shape
    mean, cell = table.mean(), table.mean(axis=2)
    of_part, of_appraiser = cell.mean(axis=1), cell.mean(axis=0)
    ss_part = a * r * float(np.square(of_part - mean).sum())
    ss_appraiser = p * r * float(np.square(of_appraiser - mean).sum())
    ss_cross = r * float(np.square(cell - of_part[:, None] - of_appraiser[None, :] + mean).sum())
    ss_within = float(np.square(table - cell[:, :, None]).sum())
    free_cross, free_within = (p - 1) * (a - 1), p * a * (r - 1)
    ms_cross, ms_within = ss_cross / free_cross, ss_within / free_within
    p_value = float(fdtrc(free_cross, free_within, ms_cross / ms_within)) if ms_within > 0.0 else None
    pooled = p_value is not None and p_value > POOL_ABOVE
    if pooled:
        ms_within = ms_cross = (ss_cross + ss_within) / (free_cross + free_within)
    interaction = max(0.0, (ms_cross - ms_within) / r)
    appraiser = max(0.0, (ss_appraiser / (a - 1) - ms_cross) / (p * r))
    part = max(0.0, (ss_part / (p - 1) - ms_cross) / (a * r))
    return GageStudy(
        parts=p,
        appraisers=a,
        repeats=r,
        repeatability=sqrt(ms_within),
        reproducibility=sqrt(appraiser + interaction),
        appraiser=sqrt(appraiser),
        interaction=sqrt(interaction),
        part=sqrt(part),
        sums_of_squares=(ss_part, ss_appraiser, ss_cross, ss_within),
        interaction_p=p_value,
        pooled=pooled,
    )
