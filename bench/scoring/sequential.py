"""Rates that are looked at again and again while scenes are added.

An interval for a fixed number of trials, looked at after every chunk, misses the true rate more
often than it says. A confidence sequence holds at all numbers of scenes at once, so a campaign may
stop whenever it is tight enough.

It is made of bets (Waudby-Smith and Ramdas, Journal of the Royal Statistical Society B 86, 2024).
With f = 1 for a failure and 0 else, the capital

    K(r) = mean over c of the product of 1 + c (f / r - 1),  0 < c < 1

has the mean 1 at every n where r is the true rate, and falls in r. It reaches 2 / (1 - level) at
any n with at most half the chance 1 - level (Ville's inequality). The rates below where it does
are ruled out, and those above by the same bets on successes.
"""

from __future__ import annotations

from math import exp, log

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from bench.scoring.rates import check_open, crossing

BETS = 1.0 / (1.0 + np.exp(np.arange(14.0, -10.0, -1.0)))
LEAST_LOGIT = -60.0
Reals = NDArray[np.float64]


def confidence_sequence(failures: int, scenes: int, level: float = 0.95) -> tuple[float, float]:
    """Interval (low, high) of the true failure rate that holds at all looks simultaneously.

    It is wider than the exact interval for a number of scenes fixed beforehand (Clopper and
    Pearson): at 95 % and from 100 to a million scenes 1.3 times where nothing failed, 1.6 to 2.1
    times elsewhere. No scene gives (0, 1).
    """
    if not 0 <= failures <= scenes:
        raise ValueError(f"rate: {failures} failures of {scenes} scenes is impossible")
    check_open("level", level)
    chance = 0.5 * (1.0 - level)
    return least_rate(failures, scenes, chance), 1.0 - least_rate(scenes - failures, scenes, chance)


def tight_enough(failures: int, scenes: int, half_width: float, level: float = 0.95) -> bool:
    """The stopping rule: half the width of the confidence sequence is at most `half_width`."""
    if not 0.0 < half_width < 0.5:
        raise ValueError(
            f"half-width: {half_width} must lie between 0 and 0.5, both excluded; 0.01 asks for"
            " a rate within 1 %"
        )
    low, high = confidence_sequence(failures, scenes, level)
    return (high - low) / 2.0 <= half_width


def least_rate(hits: int, trials: int, chance: float) -> float:
    """The rate of hits is at least this at every look, but for the ``chance``."""
    if not hits:
        return 0.0
    lost = np.log1p(-BETS) * (trials - hits) - log(len(BETS) / chance)

    def above(logit: float) -> float:
        """ln K - ln(1 / chance) where 1 / r - 1 = exp(-logit); it falls."""
        logs = lost + np.log1p(BETS * exp(-logit)) * hits
        most = float(logs.max())
        return most + log(float(np.exp(logs - most).sum()))

    high = log(hits) - log(trials - hits + 1e-9)
    step = 0.25
    while above(high) > 0.0:  # the estimate itself is never ruled out, unless by rounding
        high += step
    low = high
    while above(low) < 0.0 and low > LEAST_LOGIT:
        high, low, step = low, low - step, 2.0 * step
    return 0.0 if low <= LEAST_LOGIT else float(scipy.special.expit(crossing(above, low, high)))


def least_mean(values: ArrayLike, counts: ArrayLike, chance: float) -> float:
    """The mean of what ``values`` (n,) of 0 or more, each ``counts`` (n,) times, are independent
    draws of is at least this at every look, but for the ``chance``. The bets are as above, on
    value / mean in the place of f / r.
    """
    seen, often = _counted(values, counts)
    if not (seen * often).sum():
        return 0.0

    def above(log_mean: float) -> float:
        return _log_capital(seen, often, exp(log_mean)) + log(chance)

    high = log(float(seen @ often) / float(often.sum()))
    low, step = high, 0.01
    while above(low) < 0.0 and low > LEAST_LOGIT:
        high, low, step = low, low - step, 2.0 * step
    return 0.0 if low <= LEAST_LOGIT else exp(crossing(above, low, high))


def shows_mean(values: ArrayLike, counts: ArrayLike, mean: float, chance: float) -> bool:
    """Whether `least_mean` is at least ``mean``, without a search for it."""
    return _log_capital(*_counted(values, counts), mean) + log(chance) >= 0.0


def _counted(values: ArrayLike, counts: ArrayLike) -> tuple[Reals, Reals]:
    seen = np.atleast_1d(np.asarray(values, dtype=np.float64))
    return seen, np.broadcast_to(np.asarray(counts, dtype=np.float64), seen.shape)


def _log_capital(seen: Reals, often: Reals, mean: float) -> float:
    """ln K where ``mean`` is the true one."""
    logs = np.log1p(np.outer(BETS, seen / mean - 1.0)) @ often
    most = float(logs.max())
    return most + log(float(np.exp(logs - most).mean()))
