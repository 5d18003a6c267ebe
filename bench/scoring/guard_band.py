"""Guard bands: what may still be accepted, and what must be refused, when the truth itself is
uncertain (JCGM 106:2012, section 8).

u is the standard uncertainty of the truth along one axis, the same along all three. Knows limits
and u, not what was measured.
"""

from __future__ import annotations

from functools import lru_cache
from math import isfinite, sqrt
from typing import Literal

from scipy.special import chndtr, chndtrinc, ndtr, ndtri

Along = Literal["radial", "axis"]


def guard_band_mm(u_mm: float, false_acceptance: float = 0.05) -> float:
    """w = z u, z = 1.645 for 5 %."""
    _check(u_mm, false_acceptance)
    return float(ndtri(1.0 - false_acceptance)) * u_mm


@lru_cache(maxsize=256)
def acceptance_limit_mm(
    limit_mm: float, u_mm: float, along: Along = "radial", false_acceptance: float = 0.05
) -> float | None:
    """The largest seen error that is still accepted under a limit T, or None where the truth is too
    uncertain to accept any.

    Along one axis A = T - w. Radial: the A at which a true error of three normal components about
    the seen one exceeds T with the probability `false_acceptance`, so (T/u)^2 is that quantile of a
    noncentral chi-square with 3 degrees of freedom and noncentrality (A/u)^2. T = 5 mm, u = 0.23
    mm: 4.622 along an axis, 4.611 radial.
    """
    band = guard_band_mm(u_mm, false_acceptance)
    if not 0.0 < limit_mm < float("inf"):
        raise ValueError(f"limit: {limit_mm} mm is not above 0 and finite")
    # below a ten-thousandth the sphere of radius T is flat on the scale of u: the radial limit is T
    # - w within 1e-8 T
    if along == "axis" or u_mm < 1e-4 * limit_mm:
        return limit_mm - band if limit_mm > band else None

    squared, confidence = (limit_mm / u_mm) ** 2, 1.0 - false_acceptance
    if chndtr(squared, 3, 0.0) <= confidence:
        return None
    return u_mm * sqrt(float(chndtrinc(squared, 3, confidence)))


@lru_cache(maxsize=256)
def refusal_limit_mm(limit_mm: float, u_mm: float, false_acceptance: float = 0.05) -> float:
    """T + w: a seen error of at least this is too large whatever the truth's uncertainty; between
    the two limits nothing is decided.
    """
    return limit_mm + guard_band_mm(u_mm, false_acceptance)


@lru_cache(maxsize=4096)
def leak(seen_mm: float, limit_mm: float, u_mm: float, along: Along = "radial") -> float:
    """The chance that a true error just beyond the limit T is seen at no more than `seen_mm`: what
    accepting up to there lets through.

    No error beyond T is seen so near more often. Radial: noncentral chi-square with 3 degrees of
    freedom and noncentrality (T/u)^2 at (seen/u)^2. T = 5 mm, u = 0.23 mm: 4.1 % at the acceptance
    limit of 4.611, 0.1 % at 4.28 mm. 0 for a truth without uncertainty.
    """
    _check(u_mm, 0.05)
    if u_mm == 0.0:
        return 0.0 if seen_mm <= limit_mm else 1.0
    if along == "axis" or u_mm < 1e-4 * limit_mm:  # as in `acceptance_limit_mm`
        return float(ndtr((seen_mm - limit_mm) / u_mm) - ndtr((-seen_mm - limit_mm) / u_mm))
    return float(chndtr((seen_mm / u_mm) ** 2, 3, (limit_mm / u_mm) ** 2))


def error_without_noise_mm(seen_rms_mm: float, u_mm: float) -> float | None:
    """The rms distance with the truth's own noise taken out: E|seen|^2 = |true|^2 + 3 u^2. None
    where the noise explains all that was seen.
    """
    _check(u_mm, 0.05)
    squared = seen_rms_mm**2 - 3.0 * u_mm**2
    return sqrt(squared) if squared >= 0 else None


def _check(u_mm: float, false_acceptance: float) -> None:
    if not (isfinite(u_mm) and u_mm >= 0.0):
        raise ValueError(f"uncertainty of the truth: {u_mm} mm must be finite and not negative")
    if not 0.0 < false_acceptance < 0.5:
        raise ValueError(
            f"false acceptance: {false_acceptance} must lie between 0 and 0.5, for example 0.05"
        )
