"""A rare failure's rate from scenes drawn where failures are, against drawing evenly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from bench.scoring.errors import Floats
from bench.scoring.sequential import confidence_sequence
from bench.scoring.weighted import Proposal, weighted_rate


def can_be_set_up(points: Floats) -> Floats:
    return np.asarray(points[..., 2] + points[..., 0] < 1.6)


def fails(points: Floats) -> Floats:
    return np.asarray((points[..., 0] > 0.95) & (points[..., 1] < 0.05))


@pytest.fixture(scope="module")
def evenly() -> Floats:
    """By brute force: two million points, those that can be set up."""
    points = np.random.default_rng(1).random((2_000_000, 4))
    return np.asarray(points[can_be_set_up(points)])


def drawn(
    proposal: Proposal, scenes: int, seed: int, fails: Callable[[Floats], Floats]
) -> tuple[list[bool], list[float]]:
    chance = np.random.default_rng(seed)
    failed: list[bool] = []
    weights: list[float] = []
    while len(weights) < scenes:
        point = proposal.draw(chance)
        if can_be_set_up(point):
            failed.append(bool(fails(point)))
            weights.append(proposal.weight(point))
    return failed, weights


def fails_beyond_a_slope(points: Floats) -> Floats:
    """On no parameter's own range: a corner of three of them, cut off by a plane, in part of which
    nothing can be set up.
    """
    return np.asarray(points[..., 0] + points[..., 1] + points[..., 3] > 2.72)


@pytest.mark.slow
@pytest.mark.parametrize("fails", [fails, fails_beyond_a_slope])
def test_it_agrees_with_brute_force_and_is_nearer_than_as_many_even_scenes(
    evenly: Floats, fails: Callable[[Floats], Floats]
) -> None:
    true = float(fails(evenly).mean())  # 0.0017 and 0.0027
    proposal = Proposal.around(evenly[fails(evenly)][:20])
    found = [
        weighted_rate(*drawn(proposal, 400, seed, fails), proposal.largest) for seed in range(60)
    ]
    off = np.array([one.value - true for one in found])
    assert abs(off.mean()) < 0.4 * off.std()
    assert all(one.low <= true <= one.high for one in found)
    even = np.sqrt(true * (1.0 - true) / 400)
    assert off.std() < 0.5 * even
    # the share of hits says nothing about the rate
    assert min(one.failures / one.scenes for one in found) > 20 * true


def test_even_scenes_give_the_confidence_sequence() -> None:
    found = weighted_rate([True] * 3 + [False] * 197, np.ones(200), 1.0)
    assert (found.low, found.high) == pytest.approx(confidence_sequence(3, 200), abs=1e-8)
    assert (found.value, found.effective) == (0.015, 200)


@pytest.mark.slow
def test_a_proposal_is_a_density_of_bounded_weights(evenly: Floats) -> None:
    proposal = Proposal.around(evenly[fails(evenly)][:5])
    weights = np.array([proposal.weight(point) for point in evenly[:4000]])
    assert weights.max() <= proposal.largest
    # over the whole cube: the mean of 1 / w is that of q, 1
    cube = np.random.default_rng(2).random((20_000, 4))
    assert np.mean([1.0 / proposal.weight(point) for point in cube]) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    ("failed", "weights", "why"),
    [
        ([], [], "give one each"),
        ([True], [1.0, 1.0], "give one each"),
        ([True], [3.0], "at most 2"),
    ],
)
def test_what_is_no_sample_is_refused(failed: list[bool], weights: list[float], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        weighted_rate(failed, weights, 2.0)
