"""Gage R&R of the ground truth, a crossed analysis of variance (AIAG, Measurement Systems Analysis,
4th edition, chapter III, and ISO 22514-7); accuracy and repeatability of poses (ISO 9283:1998,
7.2), of distances (7.3), drift, and the components of spread (ISO 5725-2:1994).

Parts are teat ends at poses, appraisers set-ups (repeats of the pose, or runs), repeats touches. A
component below zero is zero; an interaction not significant at 25 % is pooled into the
repeatability. Standard deviations divide by n - 1; a spread of one value is None.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, pi, sqrt

import numpy as np
import numpy.typing as npt
from scipy.special import fdtrc

from bench.scoring.errors import Floats, as_values

POOL_ABOVE = 0.25
STUDY_SDS = 6.0  # a study variation is 6 standard deviations: 99.73 % of a normal process


@dataclass(frozen=True, slots=True)
class GageStudy:
    """Standard deviations along one axis: touch after touch, set-up after set-up (with the
    interaction), between teat ends. `interaction_p` may be None.
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
    def distinct_categories(self) -> int:
        """ndc = floor(1.41 part / gage), at least 1: how many sizes of part it distinguishes."""
        return max(1, floor(1.41 * self.part / self.gage)) if self.gage > 0.0 else 1

    def share_of_tolerance(self, tolerance: float) -> float:
        """6 gage / the whole width `tolerance`: below 0.1 good, above 0.3 not acceptable (AIAG)."""
        return STUDY_SDS * self.gage / tolerance


def gage_study(values: npt.ArrayLike) -> GageStudy:
    """The study of cells (parts, appraisers, repeats), at least 2 of each. Raises ValueError."""
    table = np.asarray(values, dtype=np.float64)
    if table.ndim != 3 or min(table.shape) < 2 or not np.isfinite(table).all():
        raise ValueError(
            "gage study: expected finite values (parts, appraisers, repeats) with at least 2 of"
            f" each, got shape {table.shape}"
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
    p_value = (
        float(fdtrc(free_cross, free_within, ms_cross / ms_within)) if ms_within > 0.0 else None
    )
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


@dataclass(frozen=True, slots=True)
class Precision:
    """s_r within a pose or set-up, s_L between, s_R = sqrt(s_r^2 + s_L^2); None where not shown."""

    n: int
    groups: int
    s_r: float | None = None
    s_between: float | None = None
    s_R: float | None = None  # noqa: N815 - the standard's own symbol


# RP of a normal error of 1 mm along each axis: mean of its length, and three sd
NORMAL_RP = 4.0 / sqrt(2.0 * pi) + 3.0 * sqrt(3.0 - 8.0 / pi)


def pose_accuracy(errors_mm: Floats) -> tuple[Floats, float]:
    """AP along each axis (3,): the mean error; RP = mean(l) + 3 sd(l), l_j = |e_j - mean|, of
    repeats (n, 3), n at least 2.
    """
    ap = errors_mm.mean(axis=0)
    spread = np.linalg.norm(errors_mm - ap, axis=1)
    return ap, float(spread.mean() + 3 * spread.std(ddof=1))


def distance_accuracy(errors_mm: Floats) -> tuple[float, float]:
    """AD = |mean error|, RD = 3 sd, of the repeats (n,) of one distance, n at least 2."""
    return abs(float(errors_mm.mean())), 3 * float(errors_mm.std(ddof=1))


def drift_mm(errors_mm: Floats, repeats: int) -> float | None:
    """The largest |AP(first block) - AP(later block)| of errors (n, 3); None below two blocks."""
    blocks = np.split(errors_mm, range(repeats, len(errors_mm) + 1, repeats))[:-1]
    first, *later = (float(np.linalg.norm(block.mean(axis=0))) for block in blocks)
    return max((abs(accuracy - first) for accuracy in later), default=None)


def precision(groups: Sequence[npt.ArrayLike]) -> Precision:
    """s_r and s_R from groups of repeats (one-way analysis of variance; empty groups are left out).

    ISO 5725-2, 7.4.5: s_L^2 = (MS_between - s_r^2) / n0, at least 0, with n0 = (N - sum n_i^2 / N)
    / (p - 1).
    """
    values = [v for v in (as_values(g, "group of repeats") for g in groups) if len(v)]
    n, p = sum(len(v) for v in values), len(values)
    if n == p:
        return Precision(n, p)
    within = sum(float(((v - v.mean()) ** 2).sum()) for v in values) / (n - p)
    if p < 2:
        return Precision(n, p, sqrt(within))
    centre = float(np.concatenate(values).mean())
    between = sum(len(v) * (float(v.mean()) - centre) ** 2 for v in values) / (p - 1)
    n0 = (n - sum(len(v) ** 2 for v in values) / n) / (p - 1)
    variance = max(0.0, (between - within) / n0)
    return Precision(n, p, sqrt(within), sqrt(variance), sqrt(within + variance))
