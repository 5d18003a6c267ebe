"""Shewhart's chart of single values over time: limits from the first ones, the rules of Western
Electric (Statistical Quality Control Handbook, 1956), and a trend of the last month.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

BASE = 20  # values that the limits are made of
D2 = 1.128  # expected range of two normal values, in standard deviations
MONTH_DAYS, LEAST_DAYS, LEAST_VALUES = 31.0, 7.0, 5  # of a trend
CONFIDENCE = 0.999  # of a trend: each chart looks for one at each run

# so many of the last ones lie beyond so many standard deviations on one side: of, at least, beyond
FAR = "beyond 3 standard deviations"
RULES = ((1, 1, 3.0), (3, 2, 2.0), (5, 4, 1.0), (8, 8, 0.0))


@dataclass(frozen=True, slots=True)
class ControlLimits:
    """Mean and sd of the first `BASE` values; nearer than ``least`` to the mean is on it."""

    centre: float
    sigma: float
    least: float


@dataclass(frozen=True, slots=True)
class ChartTrend:
    """Change a week with its confidence interval, over so many days and values."""

    a_week: float
    low: float
    high: float
    days: float
    values: int


def limits_of(values: ArrayLike, least: float) -> ControlLimits | None:
    """From the first `BASE` values and their moving ranges; None where there are fewer. ``least``:
    the resolution of what was measured.
    """
    first = np.asarray(values, dtype=np.float64)[:BASE]
    if len(first) < BASE:
        return None
    sigma = float(np.abs(np.diff(first)).mean()) / D2
    return ControlLimits(float(first.mean()), max(sigma, least), least)


def broken(values: ArrayLike, limits: ControlLimits) -> list[str]:
    """For each value the rule that it breaks with those before it, "" for none."""
    off = np.asarray(values, dtype=np.float64) - limits.centre
    off = np.where(np.abs(off) < limits.least, 0.0, off / limits.sigma)
    return [_rule(off[: at + 1]) for at in range(len(off))]


def _rule(off: NDArray[np.float64]) -> str:
    for of, least, beyond in RULES:
        side = np.sign(off[-1])
        count = int((off[-of:] * side > beyond).sum())
        if off[-1] * side > beyond and count >= least:
            if of == 1:
                return FAR
            where = f"beyond {beyond:g} standard deviations" if beyond else "of the mean"
            return f"{least} of the last {of} on one side {where}"
    return ""


def trend(days: Sequence[float], values: ArrayLike) -> ChartTrend | None:
    """The straight line through the last month's values; None where there are too few, or where
    chance makes such a line too.
    """
    t, y = np.asarray(days, dtype=np.float64), np.asarray(values, dtype=np.float64)
    late = t >= t[-1] - MONTH_DAYS if len(t) else np.zeros(0, dtype=bool)
    t, y = t[late], y[late]
    n = len(t)
    if n < LEAST_VALUES or (spanned := float(t[-1] - t[0])) < LEAST_DAYS:
        return None
    about = t - t.mean()
    slope = float(about @ y / (about @ about))
    rest = y - y.mean() - slope * about
    sd = float(np.sqrt(rest @ rest / (n - 2) / (about @ about)))
    half = float(stdtrit(n - 2, 0.5 + CONFIDENCE / 2.0)) * sd
    if abs(slope) <= half or slope == 0.0:
        return None
    return ChartTrend(7.0 * slope, 7.0 * (slope - half), 7.0 * (slope + half), spanned, n)
