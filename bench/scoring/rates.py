"""Rates as counts with exact intervals (Clopper and Pearson, Biometrika 26, 1934). They count
poses: frames of one pose are not independent. An empty rate is "not measured".
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from math import ceil, isnan, log, log1p, sqrt

import numpy as np
import scipy  # whose parts load when first used: most commands need `percent` alone

FINE, EPSILON = 1e-12, float(np.finfo(np.float64).eps)  # how exact `crossing` is


@dataclass(frozen=True, slots=True)
class Rate:
    """Successes of trials; rates add by their counts."""

    successes: int = 0
    trials: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.successes <= self.trials:
            raise ValueError(
                f"rate: {self.successes} successes of {self.trials} trials is impossible"
            )

    def __add__(self, other: Rate) -> Rate:
        return Rate(self.successes + other.successes, self.trials + other.trials)

    @property
    def failures(self) -> int:
        """Trials that did not succeed."""
        return self.trials - self.successes

    @property
    def value(self) -> float | None:
        """The fraction from 0 to 1, or None where nothing was tried."""
        return self.successes / self.trials if self.trials else None

    def interval(self, confidence: float = 0.95) -> tuple[float, float] | None:
        """Two-sided exact interval (low, high) of the true rate; None where nothing was tried."""
        check_open("confidence", confidence)
        tail = (1.0 + confidence) / 2.0
        low, high = self.lower_bound(tail), self.upper_bound(tail)
        return None if low is None or high is None else (low, high)

    def lower_bound(self, confidence: float = 0.95) -> float | None:
        """The true rate is at least this (one-sided, exact); None where nothing was tried."""
        failed = Rate(self.failures, self.trials).upper_bound(confidence)
        return None if failed is None else 1.0 - failed

    def upper_bound(self, confidence: float = 0.95) -> float | None:
        """The true rate is at most this (one-sided, exact); None where nothing was tried."""
        check_open("confidence", confidence)
        if not self.trials:
            return None
        if self.failures == 0:
            return 1.0
        return float(scipy.special.betaincinv(self.successes + 1, self.failures, confidence))

    def __str__(self) -> str:
        if self.value is None:
            return "not measured"
        return f"{self.successes} of {self.trials} ({percent(self.value)})"


def percent(fraction: float) -> str:
    """A fraction as text with one decimal; "100 %" and "0 %" only where exactly true."""
    if fraction in (0.0, 1.0):
        return f"{fraction * 100:.0f} %"
    if fraction > 0.999:
        return "> 99.9 %"
    return "< 0.1 %" if fraction < 0.001 else f"{fraction * 100:.1f} %"


def percent_apart(fraction: float, *limits: float) -> str:
    """`percent` with decimals that show the side of each limit: 94.97 %, not 95.0 %."""
    for decimals in range(1, 8):
        shown = round(100.0 * fraction, decimals)
        if all((fraction >= limit) == (shown >= round(100.0 * limit, 9)) for limit in limits):
            return percent(fraction) if decimals == 1 else f"{shown:.{decimals}f} %"
    return f"{100.0 * fraction:.10g} %"


def exact_percent(fraction: float) -> str:
    """A rate or confidence as it was given: 99.9 %."""
    return f"{100 * fraction:.6g} %"


def zero_failure_n(rate: float, confidence: float = 0.95) -> int:
    """Fewest trials without a failure that show `rate`: least n with rate^n <= 1 - confidence."""
    check_open("rate", rate)
    check_open("confidence", confidence)
    return max(1, ceil(log1p(-confidence) / log(rate) - 1e-12))


def trials_needed(failures: int, rate: float, confidence: float = 0.95) -> int:
    """Fewest trials, `failures` of them failed, whose exact lower bound reaches `rate`."""
    if failures < 0:
        raise ValueError(f"failures: {failures} is negative")
    start = max(failures, zero_failure_n(rate, confidence) - 1)

    def shows(trials: int) -> bool:
        bound = Rate(trials - failures, trials).lower_bound(confidence)
        return bound is not None and bound >= rate

    return fewest(shows, start)


def guarded_n(
    failures: int, rate: float, confidence: float = 0.95, leak: float = 0.0
) -> int | None:
    """`trials_needed` where the truth takes a bad pose for a good one with the chance `leak`; None
    where none are enough. At 95/95: 59 where nothing leaks, 91 where 4.1 % do.
    """
    allowed = 1.0 - confidence
    if leak >= allowed - 1e-9:
        return None
    enough = trials_needed(failures, rate, confidence)
    if leak == 0.0:
        return enough
    return fewest(lambda trials: shown_falsely(failures, trials, rate, leak) <= allowed, enough - 1)


def leak_allowed(failures: int, trials: int, rate: float, confidence: float = 0.95) -> float | None:
    """The largest `leak` at which so many trials show `rate`; None where they are too few."""
    if trials < trials_needed(failures, rate, confidence):
        return None
    allowed = 1.0 - confidence
    return crossing(lambda leak: shown_falsely(failures, trials, rate, leak) - allowed, 0.0, 1.0)


def shown_rate(failures: int, trials: int, confidence: float = 0.95, leak: float = 0.0) -> float:
    """The rate that `trials` with `failures` seen show, as `guarded_n` counts; 0 where none."""
    allowed = 1.0 - confidence
    if failures >= trials or leak >= allowed - 1e-9:
        return 0.0
    exact = Rate(trials - failures, trials).lower_bound(confidence) or 0.0
    if leak == 0.0 or exact < 1e-6:
        return exact

    def open_by(rate: float) -> float:
        return shown_falsely(failures, trials, rate, leak) - allowed

    # a small leak leaves no more than rounding at the exact bound: `crossing` gives the nearer end
    return crossing(open_by, 1e-9, exact) if open_by(1e-9) < 0.0 else 0.0


def fewest(enough: Callable[[int], bool], below: int) -> int:
    """The least number above `below` that is `enough`, which all larger ones are too."""
    low, high = below, max(below + 1, 1)
    while not enough(high):
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def crossing(function: Callable[[float], float], low: float, high: float) -> float:
    """The zero of a monotone function between `low` and `high`, else the end nearer to zero.

    Chandrupatla's method (Advances in Engineering Software 28, 1997): inverse quadratic steps where
    the last three points allow it, else halves. `scipy.optimize` loads for a fifth of a second.
    Raises ValueError for what is not a number.
    """

    def at(place: float) -> float:
        if isnan(value := function(place)):
            raise ValueError(f"no number at {place}, between {low} and {high}")
        return value

    x, other, at_x, at_other = low, high, at(low), at(high)
    if at_x * at_other >= 0.0:
        return low if abs(at_x) <= abs(at_other) else high
    step = 0.5  # from x to the other end of what holds the zero
    while True:
        new = x + step * (other - x)
        at_new, third, at_third = at(new), x, at_x
        if (at_new < 0.0) != (at_x < 0.0):
            third, at_third, other, at_other = other, at_other, x, at_x
        x, at_x = new, at_new
        best, at_best = (x, at_x) if abs(at_x) < abs(at_other) else (other, at_other)
        least = (FINE + 2.0 * EPSILON * abs(best)) / abs(other - x)
        if least > 0.5 or at_best == 0.0:
            return best
        part = (x - other) / (third - other)
        rise = (at_x - at_other) / (at_third - at_other)
        step = 0.5
        if rise**2 < part and (1.0 - rise) ** 2 < 1.0 - part:
            by_other = at_x / (at_other - at_x) * at_third / (at_other - at_third)
            by_third = at_x / (at_third - at_x) * at_other / (at_third - at_other)
            step = by_other + (third - x) / (other - x) * by_third
        step = min(max(step, least), 1.0 - least)


def shown_falsely(failures: int, trials: int, rate: float, leak: float) -> float:
    """Bound on the chance that a rate below `rate` gives at most `failures` failures that are seen.

    P(B <= failures) + sum over b > failures of P(B = b) min(1, b leak / (b - failures)), B binomial
    over the bad poses. Of b bad poses b - failures have to leak at once: by Markov's inequality no
    likelier than that, however the truth's errors depend on each other (an arm's error is much the
    same all through a run).
    """
    bad, few = 1.0 - rate, float(scipy.special.bdtr(failures, trials, 1.0 - rate))
    # beyond are hardly any, all counted as one there
    most = min(trials, failures + 10 + int(trials * bad + 10.0 * sqrt(trials * bad)))
    b = np.arange(failures, most + 1)
    below = scipy.special.bdtr(b, trials, bad)
    passed = np.minimum(1.0, b[1:] * leak / (b[1:] - failures))
    return few + float(np.dot(np.diff(below), passed)) + float(1.0 - below[-1])


def pose_successes(poses: Sequence[Hashable], successes: Iterable[bool]) -> Rate:
    """Frames to poses (`poses` names each frame's): a pose succeeds when all its repeats do."""
    failed = {pose for pose, success in zip(poses, successes, strict=True) if not success}
    trials = len(set(poses))
    return Rate(trials - len(failed), trials)


def check_open(name: str, value: float) -> None:
    """Raise ValueError where a rate or a confidence isn't between 0 and 1."""
    if not 0.0 < value < 1.0:
        raise ValueError(
            f"{name}: {value} must lie between 0 and 1, both excluded (no number of trials shows"
            " 100 %; name a rate such as 0.95)"
        )
