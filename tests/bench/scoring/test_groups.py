"""Bounds on false ends that come several at once, as a detector's do that takes a rail for teats."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import gammaincinv

from bench.scoring.decisions import decide_count
from bench.scoring.rates import Rate, percent
from bench.scoring.scene import pool, score_scene

DRAWS = 20_000


@pytest.mark.parametrize(("poses", "share"), [(20, 0.05), (59, 0.0172), (100, 0.0102)])
def test_the_bound_holds_where_four_false_ends_come_together(poses: int, share: float) -> None:
    """Of so many runs; the Poisson bound of their mean, which was there, doesn't hold."""
    with_false = np.random.default_rng(3).binomial(poses, share, DRAWS)
    kinds, counts = np.unique(with_false, return_counts=True)
    bounds = [Rate(int(k), poses).upper_bound(0.95) or 0.0 for k in kinds]
    assert counts[np.array(bounds) < share].sum() <= 0.05 * DRAWS
    poisson = gammaincinv(4 * kinds + 1, 0.95) / poses
    assert counts[poisson < 4 * share].sum() > 0.33 * DRAWS
    for k, bound in zip(kinds.tolist(), bounds, strict=True):
        said = decide_count("f", 4 * k, scenes=poses, per_pose=[4] * k + [0] * (poses - k))
        assert f"at most {percent(bound)} of poses have one" in said.sentence
        assert "(one-sided)" in said.sentence


def test_a_pose_without_an_answer_is_in_no_denominator() -> None:
    """It has no false end, whatever the detector would have said."""
    scores = [
        score_scene(
            found, [[0.0, 0.0, 0.0]], [True],
            u_mm=0.0, seconds=0.1, limit_mm=5.0, time_limit_s=2.0,
        )
        for found in ([[0.0, 0.0, 1.0]], [[0.0, 0.0, 1.0], [0.0, 90.0, 0.0]], [])
    ]  # fmt: skip
    seen = pool(scores, ["a", "b", "c"], [True, True, False])
    assert (seen.worst_false, seen.answered) == ((0, 1), 2)
    assert seen.none_false == Rate(1, 2)
    assert (seen.success, seen.all_found) == (Rate(1, 3), Rate(2, 3))
