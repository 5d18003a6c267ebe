"""Intervals that hold while scenes are added: simulated campaigns, and what they cost."""

from __future__ import annotations

import numpy as np
import pytest

from bench.scoring.rates import Rate
from bench.scoring.sequential import confidence_sequence, expected_scenes, tight_enough

CAMPAIGNS, CHUNK, LOOKS = 1000, 40, 50


def missed(rate: float, *, exact: bool = False) -> float:
    """The share of campaigns whose interval misses the true rate at any look."""
    chance = np.random.default_rng([17, round(1e6 * rate)])
    failures = chance.binomial(CHUNK, rate, (CAMPAIGNS, LOOKS)).cumsum(axis=1)
    outside = np.zeros(CAMPAIGNS, dtype=bool)
    for look in range(LOOKS):
        scenes = CHUNK * (look + 1)
        counts, where = np.unique(failures[:, look], return_inverse=True)
        shown = [
            Rate(int(k), scenes).interval() if exact else confidence_sequence(int(k), scenes)
            for k in counts
        ]
        wrong = np.array([one is None or not one[0] <= rate <= one[1] for one in shown])
        outside |= wrong[where]
    return float(outside.mean())


@pytest.mark.parametrize("rate", [0.001, 0.02, 0.3, 0.9])
def test_a_thousand_campaigns_looked_at_after_each_chunk(rate: float) -> None:
    assert missed(rate) <= 0.05


def test_an_exact_interval_looked_at_so_often_does_not_hold() -> None:
    assert missed(0.3, exact=True) > 0.10


@pytest.mark.parametrize(
    ("scenes", "least", "most"), [(100, 1.5, 1.6), (10_000, 1.9, 2.25), (1_000_000, 2.2, 2.9)]
)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 1.0])
def test_it_is_as_much_wider_than_an_interval_for_one_look_as_it_says(
    scenes: int, least: float, most: float, share: float
) -> None:
    failures = round(share * scenes)
    low, high = confidence_sequence(failures, scenes)
    exact = Rate(failures, scenes).interval()
    assert exact is not None
    assert low <= exact[0] <= share <= exact[1] <= high
    assert least <= (high - low) / (exact[1] - exact[0]) <= most


def test_a_campaign_stops_where_it_was_expected_to() -> None:
    n = expected_scenes(0.02, 0.01)
    assert tight_enough(round(0.02 * n), n, 0.01)
    assert not tight_enough(round(0.02 * n), n - 100, 0.01)
    assert n < expected_scenes(0.3, 0.01) < expected_scenes(0.3, 0.005)


def test_no_scene_says_nothing_and_impossible_counts_are_refused() -> None:
    assert confidence_sequence(0, 0) == (0.0, 1.0)
    with pytest.raises(ValueError, match="3 failures of 2 scenes is impossible"):
        confidence_sequence(3, 2)
    with pytest.raises(ValueError, match="half-width: 0"):
        tight_enough(0, 10, 0.0)
    with pytest.raises(ValueError, match=r"failure rate: 1\.5"):
        expected_scenes(1.5, 0.01)
