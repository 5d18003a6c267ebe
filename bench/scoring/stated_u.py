"""Is a stated standard uncertainty true? Deviations that it should explain, against it.

The sum of (deviation / u)^2 is chi-square with its degrees of freedom where u is exact; over them,
Fisher's F where u itself rests on finitely many (JCGM 100:2008, G.3). Only the upper tail accuses:
deviations that are smaller than stated harm no decision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, inf, log1p, prod, sqrt

import scipy

LEVEL = 0.05  # share of sound statements that are accused
LIMIT_LEVEL = 0.005  # the part of it by each of the three limits on a largest deviation


@dataclass(frozen=True, slots=True)
class StatedCheck:
    """``squares``: sum of (deviation / stated u)^2, with ``df`` degrees of freedom, not 0.
    ``stated_df``: those of the statement; None: it is taken as exact.
    """

    name: str
    squares: float
    df: int
    stated_df: float | None = None

    @property
    def ratio(self) -> float:
        """What u the deviations show, over what is stated."""
        return sqrt(self.squares / self.df)

    @property
    def ratio_interval(self) -> tuple[float, float]:
        """95 % confidence interval of that ratio."""
        low, high = self.limit(0.025), self.limit(0.975)
        return sqrt(self.squares / low), sqrt(self.squares / high) if high > 0 else inf

    @property
    def p_value(self) -> float:
        """The chance of such deviations or larger ones, where the statement is true."""
        if self.stated_df is None:
            return float(scipy.special.chdtrc(self.df, self.squares))
        return float(scipy.special.fdtrc(self.df, self.stated_df, self.squares / self.df))

    def limit(self, level: float) -> float:
        """The sum of squares that a true statement exceeds with the chance ``level``."""
        return squares_limit(self.df, level, self.stated_df)


def level_of_each(checks: Sequence[StatedCheck]) -> float:
    """What the limits leave of `LEVEL`, shared by the checks (Bonferroni)."""
    return (LEVEL - 3 * LIMIT_LEVEL) / max(1, len(checks))


def refuted(checks: Sequence[StatedCheck]) -> list[StatedCheck]:
    """Those that show more than is stated."""
    return [check for check in checks if check.p_value < level_of_each(checks)]


def squares_limit(df: float, level: float, stated_df: float | None = None) -> float:
    """What ``df`` squares of errors, in units of the stated u, sum to more than with the chance
    ``level``, by chi-square; by Fisher's F where u has ``stated_df`` degrees of freedom.
    """
    if stated_df is None:
        return float(scipy.special.chdtri(df, level))
    return df * float(scipy.special.fdtri(df, stated_df, 1.0 - level))


def largest_limit_mm(
    u_mm: float, sizes: Sequence[int], df: float | None = None, level: float = LIMIT_LEVEL
) -> float:
    """What the largest distance from their mean of groups of touches, ``sizes`` of them, exceeds
    with the chance ``level``, u along each axis: distances from the mean of n have the variance 1 -
    1/n along an axis, and the chance that all stay within is at least the product of each one's
    (Royen, Far East Journal of Theoretical Statistics 48, 2014).
    """
    each = -log1p(-level) / sum(sizes)  # -log of the chance that one stays within
    return u_mm * sqrt((1.0 - 1.0 / max(sizes)) * squares_limit(3, 1.0 - exp(-each), df))


def chance_of_refusal(
    limit_mm: float, u_mm: float, sizes: Sequence[int], df: float | None = None
) -> float:
    """How often a limit on the largest of those distances refuses what is exactly as stated."""

    def within(n: int) -> float:
        squared = (limit_mm / u_mm) ** 2 / (1.0 - 1.0 / n)
        if df is None:
            return float(scipy.special.chdtr(3, squared)) ** n
        return float(scipy.special.fdtr(3, df, squared / 3.0)) ** n

    return 1.0 - prod(within(n) for n in sizes if n > 1)
