"""How long 100 000 trials take to score and to pool: printed, not asserted. Run with `pytest
tests/benchmarks --benchmark-only -s`.
"""

from __future__ import annotations

from time import process_time

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from bench.scoring.decisions import Decision, decide_count, decide_error, decide_rate, decide_time
from bench.scoring.errors import ErrorSummary, Floats
from bench.scoring.scene import SceneScore, pool, score_scene
from bench.scoring.spread import Trend, pose_means, prediction_ellipsoid, trend
from tests.benchmarks.figures import beside_fixed, figure, taken_s

TRIALS = 100_000
TEATS = np.array(
    [[-260.0, 267.0, 136.0], [-110.0, 284.0, 136.0], [-205.0, 200.0, 137.0], [-140.0, 205.0, 136.0]]
)
VISIBLE = np.ones(4, dtype=bool)


@pytest.fixture(scope="module")
def drawn() -> tuple[Floats, Floats]:
    """Truth and findings (n, 4, 3): now and then one is far off, a miss and a false finding."""
    rng = np.random.default_rng(1)
    truth = TEATS + rng.uniform(-40, 40, (TRIALS, 1, 3))
    far = np.where(rng.random((TRIALS, 4, 1)) < 0.01, 60.0, 0.0)
    return truth, truth + rng.normal(0, 1.2, truth.shape) + far


def scored(truth: Floats, found: Floats) -> list[SceneScore]:
    return [
        score_scene(
            seen,
            ends,
            VISIBLE,
            u_mm=0.3,
            seconds=0.2,
            limit_mm=5.0,
            time_limit_s=2.0,
            hidden_claimed=0,
        )
        for ends, seen in zip(truth, found, strict=True)
    ]


def whole(truth: Floats, found: Floats) -> tuple[ErrorSummary, list[Decision], Trend]:
    """All that a report says of trials: matches, rates, summaries, decisions, map, trend."""
    poses = [f"pose-{k // 3}" for k in range(len(truth))]
    together = pool(scored(truth, found), poses)
    errors, of = together.errors_mm, together.error_poses
    distances = np.linalg.norm(errors, axis=1)
    sure, perhaps = together.surely_succeeded(0.99, 0.95), together.perhaps_succeeded
    decisions = [
        decide_error(
            "error", distances, limit_mm=5.0, u_mm=0.3, rate=0.99, confidence=0.95, poses=of
        ),
        decide_rate(
            "success",
            together.success,
            required=0.99,
            confidence=0.95,
            shown=sure,
            possible=perhaps,
        ),
        decide_count(
            "false",
            together.counts.false,
            scenes=len(together.scores),
            per_pose=together.worst_false,
        ),
        decide_time(
            "time",
            [s.seconds for s in together.scores],
            limit_s=1.0,
            statistic="p95",
            poses=together.poses,
        ),
    ]
    assert together.hidden_right.trials == together.in_time.trials == -(-len(truth) // 3)
    places = np.concatenate(
        [
            ends[[j for _, j in s.match.pairs]]
            for ends, s in zip(truth, together.scores, strict=True)
        ]
    )
    prediction_ellipsoid(pose_means(errors, of))
    return together.summary(), decisions, trend(places[:, 0], distances, of)


def test_scoring_of_100_000_trials(
    benchmark: BenchmarkFixture, drawn: tuple[Floats, Floats]
) -> None:
    before = process_time()
    summary, decisions, line = benchmark.pedantic(whole, args=drawn, rounds=1, iterations=1)
    spent = process_time() - before
    assert summary.n > 3.9 * TRIALS
    assert line.groups == -(-TRIALS // 3)
    assert [decision.n for decision in decisions[:2]] == [line.groups, line.groups]
    figure(benchmark, "scoring of 100 000 trials, s", taken_s(benchmark, "max"), "at most 5")
    beside_fixed(benchmark, "scoring of 100 000 trials", spent, "2")
