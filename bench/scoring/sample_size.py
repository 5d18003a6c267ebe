"""Before a run: how many poses a claim needs, and how small a difference a comparison can show.
Exact where the claim itself is. A power is the chance to show what is there.
"""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq
from scipy.special import bdtr, bdtrc, gammaincinv, ndtr, stdtrit
from scipy.stats import binom

from bench.scoring.guard_band import acceptance_limit_mm, leak
from bench.scoring.rates import check_open, fewest, shown_falsely, trials_needed, zero_failure_n

RARE = 1e-100  # a share so small is none: scipy's distributions overflow there


def failures_allowed(trials: int, rate: float, confidence: float = 0.95) -> int | None:
    """The most failures in `trials` poses that still show `rate`; None where not even all successes
    do.
    """
    if trials < zero_failure_n(rate, confidence):
        return None
    return fewest(lambda k: trials_needed(k, rate, confidence) > trials, 0) - 1


def shown_error_mm(
    trials: int,
    rate: float,
    limit_mm: float,
    u_mm: float,
    confidence: float = 0.95,
    failures: int = 0,
) -> float | None:
    """The largest distance that so many poses, all but `failures` within it, show to be below
    `limit_mm` in a share `rate` of poses.

    At most the acceptance limit; below it where the poses leave less than that of the risk to the
    truth (`rates.shown_falsely`, solved for the distance). None for too few poses, or a truth too
    uncertain.
    """
    accept, allowed = acceptance_limit_mm(limit_mm, u_mm), 1.0 - confidence

    def risk(seen_mm: float) -> float:
        return shown_falsely(failures, trials, rate, leak(seen_mm, limit_mm, u_mm)) - allowed

    if accept is None or trials < trials_needed(failures, rate, confidence) or risk(0.0) > 1e-12:
        return None
    return (
        accept
        if u_mm == 0.0 or risk(accept) <= 0.0
        else float(brentq(risk, 0.0, accept, xtol=1e-9))
    )


def power_of_rate(trials: int, true_rate: float, rate: float, confidence: float = 0.95) -> float:
    """The chance that a detector of `true_rate` shows `rate` in so many poses."""
    allowed = failures_allowed(trials, rate, confidence)
    return 0.0 if allowed is None else float(bdtr(allowed, trials, 1.0 - true_rate))


def discordant_needed(alpha: float = 0.05) -> int:
    """Fewest scenes, all lost (or won) by one of two detectors, that exact McNemar calls
    significant: 6 for 5 %.
    """
    check_open("alpha", alpha)
    # 0.5^1100 is 0: no alpha is left
    return next(k for k in range(1, 1100) if 2.0 * 0.5**k < alpha)


def mcnemar_power(trials: int, lost: float, won: float, alpha: float = 0.05) -> float:
    """The chance that exact McNemar is significant, when a share `lost` of scenes only the old
    detector solves, and `won` only the new.

    Summed over all numbers of discordant scenes (Duffy, Biometrics 40, 1984).
    """
    if min(lost, won) < 0.0 or lost + won > 1.0:
        raise ValueError(
            f"shares of discordant scenes: {lost} and {won} must not be negative, nor more than 1"
            " together"
        )
    if lost + won < RARE:
        return 0.0
    discordant = np.arange(trials + 1)
    chance = binom.pmf(discordant, trials, lost + won)
    critical = _critical(discordant, alpha)
    share = lost / (lost + won)
    significant = np.where(
        critical >= 0,
        bdtr(critical, discordant, share) + bdtrc(discordant - critical - 1, discordant, share),
        0.0,
    )
    return float(min(1.0, np.dot(chance, significant)))


def detectable_loss(trials: int, power: float = 0.8, alpha: float = 0.05) -> float | None:
    """The smallest share of scenes lost, none won, that a comparison over so many scenes shows with
    `power`; None where none can be.
    """
    check_open("power", power)
    if trials < discordant_needed(alpha):
        return None
    return _rising_root(lambda lost: mcnemar_power(trials, lost, 0.0, alpha) - power, 1.0)


def detectable_shift(
    poses: int, sd: float, power: float = 0.8, alpha: float = 0.05
) -> float | None:
    """The smallest mean difference of two detectors' errors, in the unit of `sd`, that so many
    poses show with `power`.

    `sd` is the standard deviation of the differences between poses. None for fewer than 2 poses.
    Paired t, two-sided: noncentral t (Cohen, Statistical Power Analysis, 1988, section 2.4); the
    sign-flip test of a comparison has nearly the same power.
    """
    check_open("power", power)
    _positive_sd(sd)
    if poses < 2:
        return None
    edge, freedom = float(stdtrit(poses - 1, 1.0 - alpha / 2.0)), poses - 1
    # P(|T| > edge) is the mean of a normal chance over the sample's own standard deviation
    # (Gauss-Legendre over its quantiles)
    nodes, weights = np.polynomial.legendre.leggauss(256)
    spread = edge * np.sqrt(gammaincinv(freedom / 2.0, (nodes + 1.0) / 2.0) * 2.0 / freedom)
    noncentrality = _rising_root(
        lambda d: float(weights @ (ndtr(d - spread) + ndtr(-d - spread))) / 2.0 - power,
        20.0 + 10.0 * edge,
    )
    return None if noncentrality is None else noncentrality * sd / sqrt(poses)


def poses_for_shift(shift: float, sd: float, power: float = 0.8, alpha: float = 0.05) -> int:
    """Fewest poses that show a mean difference of `shift`: the inverse of `detectable_shift`."""
    _positive_sd(sd)
    if shift <= 0.0:
        raise ValueError(
            f"difference: {shift} must be above 0; no number of poses shows that two detectors are"
            " the same"
        )

    def shows(poses: int) -> bool:
        found = detectable_shift(poses, sd, power, alpha)
        return found is not None and found <= shift

    return fewest(shows, 1)


def _critical(discordant: npt.NDArray[np.int64], alpha: float) -> npt.NDArray[np.int64]:
    """For each number of discordant scenes the largest smaller count that is still significant; -1
    where none is.
    """
    check_open("alpha", alpha)
    at = binom.ppf(alpha / 2.0, discordant, 0.5).astype(np.int64)
    return np.asarray(np.where(2.0 * bdtr(at, discordant, 0.5) < alpha, at, at - 1), dtype=np.int64)


def _rising_root(function: Callable[[float], float], high: float) -> float | None:
    """Where a rising function reaches 0 between 0 and `high`; None where it doesn't."""
    if function(high) < 0.0:
        return None
    return 0.0 if function(0.0) >= 0.0 else float(brentq(function, 0.0, high, xtol=1e-9))


def _positive_sd(sd: float) -> None:
    if not 0.0 < sd < float("inf"):
        raise ValueError(f"standard deviation of the differences: {sd} must be above 0 and finite")
