"""Guard bands: what is accepted, and what refused, when the truth itself is uncertain (JCGM
106:2012, section 8), with 5 % false acceptance. u is the truth's standard uncertainty along any
axis.
"""

from __future__ import annotations

from functools import lru_cache
from math import isfinite, sqrt

import scipy

from bench.scoring.rates import crossing

ACCEPTED = 0.95  # of errors just within the limit; 5 % beyond it are accepted falsely
# below this share of T the sphere of radius T is flat on the scale of u: along an axis and in space
# the limits are the same within 1e-8 T
FLAT = 1e-4


def guard_band_mm(u_mm: float) -> float:
    """w = 1.645 u."""
    if not (isfinite(u_mm) and u_mm >= 0.0):
        raise ValueError(f"uncertainty of the truth: {u_mm} mm must be finite and not negative")
    return float(scipy.special.ndtri(ACCEPTED)) * u_mm


def axis_acceptance_limit_mm(limit_mm: float, u_mm: float) -> float | None:
    """`acceptance_limit_mm` for the error along one axis: T - w."""
    band = guard_band_mm(u_mm)
    return limit_mm - band if limit_mm > band else None


@lru_cache(maxsize=256)
def acceptance_limit_mm(limit_mm: float, u_mm: float) -> float | None:
    """The largest seen distance that is accepted under a limit T; None where the truth is too
    uncertain.

    The A at which a true error of three normal components about the seen one exceeds T with 5 %:
    (T/u)^2 is the 95 % quantile of a noncentral chi-square with 3 degrees of freedom and
    noncentrality (A/u)^2. T = 5 mm, u = 0.23 mm: 4.611 (along one axis 4.622).
    """
    band = guard_band_mm(u_mm)
    if not 0.0 < limit_mm < float("inf"):
        raise ValueError(f"limit: {limit_mm} mm is not above 0 and finite")
    if u_mm < FLAT * limit_mm:
        return limit_mm - band
    squared = (limit_mm / u_mm) ** 2
    if scipy.special.chndtr(squared, 3, 0.0) <= ACCEPTED:
        return None
    return u_mm * sqrt(float(scipy.special.chndtrinc(squared, 3, ACCEPTED)))


@lru_cache(maxsize=256)
def refusal_limit_mm(limit_mm: float, u_mm: float) -> float:
    """T + w: a seen error of at least this is too large whatever the truth's uncertainty."""
    return limit_mm + guard_band_mm(u_mm)


@lru_cache(maxsize=4096)
def leak(seen_mm: float, limit_mm: float, u_mm: float) -> float:
    """The chance that a true error just beyond the limit T is seen at no more than `seen_mm`.

    Noncentral chi-square with 3 degrees of freedom and noncentrality (T/u)^2 at (seen/u)^2; an
    error further out leaks less. T = 5 mm, u = 0.23 mm: 4.1 % at the acceptance limit of 4.611, 0.1
    % at 4.28 mm. 0 for an exact truth.
    """
    guard_band_mm(u_mm)
    if u_mm == 0.0:
        return 0.0 if seen_mm <= limit_mm else 1.0
    if u_mm < FLAT * limit_mm:
        return float(
            scipy.special.ndtr((seen_mm - limit_mm) / u_mm)
            - scipy.special.ndtr((-seen_mm - limit_mm) / u_mm)
        )
    return float(scipy.special.chndtr((seen_mm / u_mm) ** 2, 3, (limit_mm / u_mm) ** 2))


@lru_cache(maxsize=256)
def farthest_mm(limit_mm: float, u_mm: float, most: float) -> float | None:
    """The farthest seen distance at which no more than ``most`` `leak`; None where none is."""
    accept = acceptance_limit_mm(limit_mm, u_mm)
    if accept is None or leak(0.0, limit_mm, u_mm) > most:
        return None
    if u_mm == 0.0 or leak(accept, limit_mm, u_mm) <= most:
        return accept
    return crossing(lambda seen_mm: leak(seen_mm, limit_mm, u_mm) - most, 0.0, accept)
