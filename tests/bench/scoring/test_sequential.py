"""Intervals that hold while scenes are added: simulated campaigns, and what they cost."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Callable

import numpy as np
import pytest

from bench.scoring.rates import Rate
from bench.scoring.sequential import confidence_sequence, tight_enough
from tests.examples import few

CAMPAIGNS, CHUNK, LOOKS = 1000, 40, 50


def missed(rate: float, interval: Callable[[int, int], tuple[float, float]]) -> float:
    """The share of campaigns whose interval misses the true rate at any look."""
    chance = np.random.default_rng([17, round(1e6 * rate)])
    failures = chance.binomial(CHUNK, rate, (CAMPAIGNS, LOOKS)).cumsum(axis=1)
    outside = np.zeros(CAMPAIGNS, dtype=bool)
    for look in range(LOOKS):
        scenes, counts = CHUNK * (look + 1), range(failures[:, look].max() + 1)
        # both ends rise with the count
        below = bisect(counts, False, key=lambda k: interval(k, scenes)[1] >= rate)
        above = bisect(counts, False, key=lambda k: interval(k, scenes)[0] > rate)
        outside |= (failures[:, look] < below) | (failures[:, look] >= above)
    return float(outside.mean())


def exact(failures: int, scenes: int) -> tuple[float, float]:
    return Rate(failures, scenes).interval() or (0.0, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("rate", few([0.02, 0.001, 0.9, 0.3], 2))
def test_a_thousand_campaigns_looked_at_after_each_chunk(rate: float) -> None:
    assert missed(rate, confidence_sequence) <= 0.05


def test_an_exact_interval_looked_at_so_often_does_not_hold() -> None:
    assert missed(0.3, exact) > 0.10


@pytest.mark.parametrize("scenes", [100, 10_000, 1_000_000])
@pytest.mark.parametrize(
    ("share", "least", "most"),
    [(0.0, 1.25, 1.35), (0.02, 1.6, 2.1), (0.3, 1.6, 2.1), (1.0, 1.25, 1.35)],
)
def test_it_is_as_much_wider_than_an_interval_for_one_look_as_it_says(
    scenes: int, share: float, least: float, most: float
) -> None:
    failures = round(share * scenes)
    low, high = confidence_sequence(failures, scenes)
    one = exact(failures, scenes)
    assert low <= one[0] <= share <= one[1] <= high
    assert least <= (high - low) / (one[1] - one[0]) <= most


@pytest.mark.parametrize(("share", "half_width"), [(0.02, 0.01), (0.3, 0.01), (0.3, 0.005)])
def test_a_campaign_stops_once_half_its_interval_is_as_small_as_asked(
    share: float, half_width: float
) -> None:
    wide = [1000 * 2**k for k in range(10)]
    stops = [tight_enough(round(share * n), n, half_width) for n in wide]
    assert stops == sorted(stops)
    assert stops[0] is False
    assert stops[-1] is True
    for n, stop in zip(wide, stops, strict=True):
        low, high = confidence_sequence(round(share * n), n)
        assert stop == (high - low <= 2.0 * half_width)


def test_no_scene_says_nothing_and_impossible_counts_are_refused() -> None:
    assert confidence_sequence(0, 0) == (0.0, 1.0)
    with pytest.raises(ValueError, match="3 failures of 2 scenes is impossible"):
        confidence_sequence(3, 2)
    with pytest.raises(ValueError, match="half-width: 0"):
        tight_enough(0, 10, 0.0)
