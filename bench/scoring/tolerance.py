"""Tolerance limits: what covers a share of all errors with a stated confidence (ISO 16269-6). Knows only sorted numbers.

`rate` is the share that is covered, `confidence` how sure that is; "99/95" is a rate of 0.99 with a confidence of 0.95.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import bdtr, nctdtrit, ndtri

from bench.scoring.points import as_values
from bench.scoring.rates import zero_failure_n


def normal_k(n: int, rate: float, confidence: float = 0.95) -> float:
    """One-sided factor: mean + k sd (sd divides by n - 1) covers `rate` of a normal population. k(30; 95/95) = 2.220."""
    if n < 2:
        raise ValueError(f"tolerance factor: n = {n}; a spread needs at least 2 values")
    zero_failure_n(rate, confidence)  # refuses a rate or a confidence outside 0 to 1
    root = float(np.sqrt(n))
    return float(nctdtrit(n - 1, ndtri(rate) * root, confidence)) / root


def distribution_free_n(rate: float, confidence: float = 0.95) -> int:
    """The n at which the largest of n values covers `rate` whatever the distribution: 59 for 95/95, 299 for 99/95."""
    return zero_failure_n(rate, confidence)


def quantile_bounds(values: npt.ArrayLike, rate: float, confidence: float = 0.95) -> tuple[float | None, float | None]:
    """One-sided lower and upper bound, each with `confidence`, of the population's quantile `rate`: two of the values, or None where n is
    too small.

    Any distribution (David and Nagaraja, Order Statistics, section 7.1). The upper bound is the distribution-free tolerance limit.
    """
    ordered = np.sort(as_values(values, "values"))
    n = len(ordered)
    zero_failure_n(rate, confidence)
    at_most = bdtr(np.arange(n + 1), n, rate)  # P(at most k of n values lie below the quantile), k = 0 to n
    upper = int(np.searchsorted(at_most, confidence))  # 0-based: P(at most `upper` values lie below the quantile) >= confidence
    lower = int(np.searchsorted(at_most, 1.0 - confidence)) - 1  # P(at least `lower` + 1 values lie below it) >= confidence
    return (float(ordered[lower]) if lower >= 0 else None, float(ordered[upper]) if upper < n else None)
