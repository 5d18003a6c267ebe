"""Rates that are looked at again and again while scenes are added.

An interval for a fixed number of trials, looked at after every chunk, misses the true rate more
often than it says. A confidence sequence holds at all numbers of scenes at once, so a campaign may
stop whenever it is tight enough.

The sequence is the beta-binomial mixture (Robbins, Annals of Mathematical Statistics 41, 1970;
Lai, Annals of Statistics 4, 1976): with k failures in n scenes and the mixing density
Beta(1/2, 1/2),

    M_n(p) = B(k + 1/2, n - k + 1/2) / B(1/2, 1/2) / (p^k (1 - p)^(n - k))

is a martingale of mean 1 at the true rate p. It reaches 1 / (1 - level) at any n with at most the
chance 1 - level (Ville's inequality). The interval is all p with M_n(p) < 1 / (1 - level).
"""

from __future__ import annotations

from collections.abc import Callable
from math import log

from scipy.optimize import brentq
from scipy.special import betaln, expit, log_expit

from bench.scoring.rates import check_open, fewest

MIXING = 0.5  # both parameters of the mixing density
MOST_SCENES = 10**12


def confidence_sequence(failures: int, scenes: int, level: float = 0.95) -> tuple[float, float]:
    """Interval (low, high) of the true failure rate that holds at all looks simultaneously.

    It is wider than the exact interval for a number of scenes fixed beforehand (Clopper and
    Pearson): at 95 % 1.5 to 1.6 times at 100 scenes, 1.9 to 2.2 at 10 000, 2.2 to 2.9 at
    a million; most where nothing failed. No scene gives (0, 1).
    """
    if not 0 <= failures <= scenes:
        raise ValueError(f"rate: {failures} failures of {scenes} scenes is impossible")
    return _interval(failures, scenes, level)


def tight_enough(failures: int, scenes: int, half_width: float, level: float = 0.95) -> bool:
    """The stopping rule: half the width of the confidence sequence is at most `half_width`."""
    _check_half_width(half_width)
    low, high = confidence_sequence(failures, scenes, level)
    return (high - low) / 2.0 <= half_width


def expected_scenes(rate: float, half_width: float, level: float = 0.95) -> int:
    """Scenes until `tight_enough`, where failures come at just this rate (0 to 1)."""
    _check_half_width(half_width)
    if not 0.0 <= rate <= 1.0:
        raise ValueError(f"failure rate: {rate} must lie between 0 and 1")

    def enough(scenes: int) -> bool:
        low, high = _interval(rate * scenes, scenes, level)
        return (high - low) / 2.0 <= half_width or scenes >= MOST_SCENES

    return fewest(enough, 0)


def _interval(failures: float, scenes: int, level: float) -> tuple[float, float]:
    check_open("level", level)
    rest = scenes - failures
    mixture = betaln(failures + MIXING, rest + MIXING) - betaln(MIXING, MIXING)
    limit = -log(1.0 - level)

    def above(logit: float) -> float:
        """ln M_n - ln(1 / (1 - level)); convex in the logit of the rate."""
        return float(mixture - failures * log_expit(logit) - rest * log_expit(-logit) - limit)

    best = 0.0 if scenes == 0 else log((failures + 1e-9) / (rest + 1e-9))
    low = float(expit(_crossing(above, best, -1.0))) if failures else 0.0
    high = float(expit(_crossing(above, best, 1.0))) if rest else 1.0
    return low, high


def _crossing(above: Callable[[float], float], inside: float, step: float) -> float:
    """Where `above` turns positive, going from `inside`; the step is doubled until it does."""
    outside = inside + step
    while above(outside) < 0.0:
        step *= 2.0
        outside = inside + step
    return float(brentq(above, inside, outside))


def _check_half_width(half_width: float) -> None:
    if not 0.0 < half_width < 0.5:
        raise ValueError(
            f"half-width: {half_width} must lie between 0 and 0.5, both excluded; 0.01 asks for"
            " a rate within 1 %"
        )
