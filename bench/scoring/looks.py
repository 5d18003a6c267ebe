"""Looking again costs something: what is left of the chance of a false verdict after earlier looks
at the same poses, and the bounds that hold for all looks together.

A run is decided once, at the number of poses that its script planned, by the exact test of a fixed
number: its first look. Poses are added afterwards because of what the first look showed, and a
fixed-n test asked again accepts falsely in 8.4 % after two looks and in 22 % after ten. So what
follows takes only what the first look left of the chance 1 - confidence,

    left = (1 - confidence) - P(the first look decides | the rate is the limit)

and spends it on a bound that holds at every number of poses at once (`sequential`, bets), as many
further looks as there may be. By the union of both no more than 1 - confidence of all series of
looks decide falsely, whatever they were continued for. The first look's part is exact: at 95/95 59
poses leave 0.15 %, 92 leave 4.1 %, fewer than 59 the whole, since they can't decide. A script that
plans for ``looks = k`` gives its first look the k-th part.

A largest error is another matter: looks that need every pose to lie within one distance hold each
other, so they decide falsely no more often than the one with the fewest poses does, at the
farthest distance that any of them accepts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import scipy

from bench.scoring.rates import Rate, exact_percent, fewest, zero_failure_n
from bench.scoring.sample_size import failures_allowed
from bench.scoring.sequential import least_rate, shows_mean

NOTHING = 1e-9  # a chance so small is none
LEAKED = 0.1  # share of the bad poses that the truth's error may show as good
LEAKED_SHARE = 0.5  # of the chance that is left, for more of them to be shown so
MOST_POSES = 10_000_000


@dataclass(frozen=True, slots=True)
class Looks:
    """Earlier looks at what is judged now. ``own``: the poses of each run's own look; ``pooled``:
    the poses of each look at several of the runs; ``left_out``: runs of such a look that aren't
    judged now; ``planned``: the looks that the script plans for. By default there was none.
    """

    planned: int = 1
    own: tuple[int, ...] = ()
    pooled: tuple[int, ...] = ()
    left_out: tuple[str, ...] = ()
    apart: int = 1  # series of pooled looks that have no run in common, but for this one

    @property
    def again(self) -> bool:
        """Whether this is a further look."""
        return bool(self.own or self.pooled)

    def first_confidence(self, confidence: float) -> float:
        """That of the first look."""
        return 1.0 - (1.0 - confidence) / self.planned if self.planned > 1 else confidence

    def after(self, poses: int) -> Looks:
        """Those of the look that follows one at so many poses."""
        if self.again:
            return Looks(self.planned, self.own, (*self.pooled, poses), apart=self.apart)
        return Looks(self.planned, (poses,))

    def fewest_poses(self, poses: int, rate: float, confidence: float) -> int:
        """The fewest poses of a look that could have shown ``rate`` by having no failure."""
        first, later = (
            zero_failure_n(rate, sure) for sure in (self.first_confidence(confidence), confidence)
        )
        could = [n for n in self.own if n >= first] + [n for n in self.pooled if n >= later]
        return min([poses, *could])


FIRST = Looks()


@dataclass(frozen=True, slots=True)
class RateTest:
    """How a rate is held against `required` at a look, and in which words."""

    required: float
    confidence: float
    looks: Looks = FIRST

    @property
    def _first(self) -> float:
        return self.looks.first_confidence(self.confidence)

    def _left(self, side: int) -> float:
        """Of the chance to accept (0) or to refuse (1) falsely."""
        spent = (spent_on(n, self.required, self._first)[side] for n in self.looks.own)
        left = (1.0 - self.confidence) - max(spent, default=0.0)
        return max(left, 0.0) / self.looks.apart

    @property
    def level(self) -> float:
        """The chance of a false acceptance that this look, and those after it, have."""
        return self._left(0) if self.looks.again else 1.0 - self._first

    @property
    def words(self) -> str:
        if not self.looks.again:
            exact = "exact (Clopper-Pearson) one-sided bound of the rate over poses"
            return f"{exact}, {exact_percent(self._first)} confidence"
        return (
            "one-sided bound of the rate over poses that holds at every look (confidence sequence),"
            f" at the {100 * self.level:.2g} % that earlier looks left of"
            f" {exact_percent(1.0 - self.confidence)}"
        )

    def lower(self, sure: Rate, *, leaks: bool = False) -> float | None:
        """The rate is at least this; ``leaks``: the truth's error may show bad poses as good."""
        if not self.looks.again:
            return sure.lower_bound(self._first)
        if not sure.trials:
            return None
        level = self._left(0) * (1.0 - LEAKED_SHARE if leaks else 1.0)
        if level < NOTHING:
            return 0.0
        seen = least_rate(sure.successes, sure.trials, level)
        return max((seen - LEAKED) / (1.0 - LEAKED), 0.0) if leaks else seen

    def upper(self, possible: Rate) -> float | None:
        """The rate is at most this."""
        if not self.looks.again:
            return possible.upper_bound(self._first)
        if not possible.trials:
            return None
        level = self._left(1)
        return (
            1.0 if level < NOTHING else 1.0 - least_rate(possible.failures, possible.trials, level)
        )

    def more(self, rate: Rate, *, leaks: bool = False) -> int | None:
        """The fewest further poses, none of which fails, after which a look would show `required`;
        None where no number does.
        """
        after = RateTest(self.required, self.confidence, self.looks.after(rate.trials))
        level = after.level * (1.0 - LEAKED_SHARE if leaks else 1.0)
        seen = self.required + (1.0 - self.required) * (LEAKED if leaks else 0.0)

        def shows(poses: int) -> bool:
            counts = (rate.successes + poses, rate.failures)
            return shows_mean((1.0, 0.0), counts, seen, level)

        if level < NOTHING or not shows(MOST_POSES):
            return None
        return fewest(shows, 0)


@lru_cache(maxsize=4096)
def spent_on(poses: int, required: float, confidence: float) -> tuple[float, float]:
    """The chance that a first look accepts, and that it refuses, at the rate `required`."""
    bad = 1.0 - required
    allowed = failures_allowed(poses, required, confidence)
    accepts = 0.0 if allowed is None else float(scipy.special.bdtr(allowed, poses, bad))

    def refuses(failures: int) -> bool:
        bound = Rate(max(poses - failures, 0), poses).upper_bound(confidence)
        return bound is not None and bound < required

    if not poses or not refuses(poses):
        return accepts, 0.0
    return accepts, float(scipy.special.bdtrc(fewest(refuses, 0) - 1, poses, bad))


def allowed_leak(test: RateTest) -> float:
    """How likely a bad pose may be seen as good at a further look, so that `RateTest.lower` holds:
    by Markov's inequality more than `LEAKED` of them leak with no more than the chance that is
    kept for it, whatever part of the truth's error all poses have in common.
    """
    return LEAKED * LEAKED_SHARE * test.level
