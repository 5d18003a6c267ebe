"""One scene's score, its way through JSON, and scenes pooled by their counts."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.scoring.matching import Counts
from bench.scoring.rates import Rate
from bench.scoring.scene import Pool, SceneScore, pool, scene_from_dict, score_scene

# table 5.1
TRUTH = np.array(
    [[-110.2, 284.2, 134.2], [-161.9, 192.6, 137.6], [-224.9, 199.4, 136.7], [-260.6, 267.1, 136.3]]
)
ALL = (True, True, True, True)
THREE = (True, True, True, False)


def score(found: Any, visible: tuple[bool, ...] = ALL, **changes: Any) -> SceneScore:
    settings = {"u_mm": 0.23, "seconds": 0.4, "limit_mm": 5.0, "time_limit_s": 2.0, **changes}
    return score_scene(found, TRUTH, visible, **settings)


def moved(teat: int, by_mm: float) -> Any:
    found = TRUTH.copy()
    found[teat, 2] += by_mm
    return found


def test_a_perfect_scene() -> None:
    s = score(TRUTH[::-1], hidden_claimed=0)
    assert s.success
    assert s.in_time
    assert s.hidden_right
    assert s.counts == Counts(visible=4, matched=4)
    assert s.gospa_mm == 0.0
    assert not s.errors_mm.any()


@pytest.mark.parametrize(
    ("found", "changes"),
    [
        (TRUTH[:3], {}),  # one is missing
        (moved(1, 5.01), {}),  # one is too far off
        (np.vstack([TRUTH, [[0, 0, 0]]]), {}),  # one is false
        (TRUTH, {"seconds": 2.01}),  # too late
        ([], {}),
    ],
)
def test_what_makes_a_scene_fail(found: Any, changes: dict[str, Any]) -> None:
    assert not score(found, **changes).success


def test_the_limits_themselves_succeed() -> None:
    assert score(TRUTH, seconds=2.0).success
    assert score(moved(1, 1.0), limit_mm=1.0 + 1e-9).success


def test_a_hidden_teat_fails_nothing_found_or_not() -> None:
    assert score(TRUTH[:3], THREE).success
    both = score(TRUTH, THREE)
    assert both.success
    assert both.counts == Counts(visible=3, hidden=1, matched=3, on_hidden=1)
    assert both.errors_mm.shape == (3, 3)


def test_the_hidden_count_is_scored_beside_the_success() -> None:
    assert score(TRUTH[:3], THREE, hidden_claimed=1).hidden_right is True
    wrong = score(TRUTH[:3], THREE, hidden_claimed=0)
    assert wrong.hidden_right is False
    assert wrong.success
    assert score(TRUTH[:3], THREE).hidden_right is None


def test_errors_are_found_minus_truth_in_the_order_of_the_teats() -> None:
    s = score(moved(2, -3.0)[::-1])
    assert s.errors_mm == pytest.approx(np.outer([0, 0, 1, 0], [0, 0, -3.0]))
    assert s.radial_mm == pytest.approx((0, 0, 3, 0))
    with pytest.raises(ValueError, match="read-only"):
        s.errors_mm[0, 0] = 1.0


@given(
    st.lists(st.tuples(st.integers(0, 3), st.floats(0, 30)), max_size=6),
    st.tuples(*[st.booleans()] * 4),
)
def test_errors_and_distances_are_those_of_the_pairs(offs: Any, visible: Any) -> None:
    found = [TRUTH[teat] + (0.0, off_mm, 0.0) for teat, off_mm in offs]
    s = score(found, visible)
    apart = np.array([found[i] - TRUTH[j] for i, j in s.match.pairs]).reshape(-1, 3)
    assert (s.errors_mm == apart).all()
    assert s.radial_mm == pytest.approx(np.linalg.norm(apart, axis=1))


@given(
    st.lists(st.tuples(*[st.floats(-300, 300)] * 3), max_size=6),
    st.tuples(*[st.booleans()] * 4),
    st.sampled_from([None, 0, 1]),
)
def test_a_score_survives_json_exactly(
    found: list[tuple[float, ...]], visible: tuple[bool, ...], claimed: int | None
) -> None:
    s = score(found, visible, hidden_claimed=claimed)
    back = scene_from_dict(json.loads(json.dumps(s.as_dict())))
    assert back.as_dict() == s.as_dict()
    assert back.match == s.match
    assert (back.errors_mm == s.errors_mm).all()


def test_a_stored_score_that_lacks_a_key_is_named() -> None:
    stored = score(TRUTH).as_dict()
    del stored["missed"]
    with pytest.raises(ValueError, match="key 'missed' is missing"):
        scene_from_dict(stored)


def test_impossible_input() -> None:
    with pytest.raises(ValueError, match="seconds"):
        score(TRUTH, seconds=float("inf"))
    with pytest.raises(ValueError, match="hidden_claimed"):
        score(TRUTH, hidden_claimed=-1)


@pytest.mark.parametrize(
    ("found", "changes", "surely"),
    [
        (TRUTH, {}, "succeeded"),
        (moved(1, 4.60), {}, "succeeded"),
        (moved(1, 4.62), {}, ""),  # in the guard band: A = 4.611, T + w = 5.378
        (moved(1, 5.37), {}, ""),
        (moved(1, 5.38), {}, "failed"),
        (moved(1, 5.2)[:3], {}, "failed"),  # a miss is no matter of the truth
        (np.vstack([moved(1, 5.2), [[0, 0, 0]]]), {}, "failed"),
        (moved(1, 5.2), {"seconds": 3.0}, "failed"),
        ([], {}, "failed"),
        (moved(1, 4.99), {"u_mm": 0.0}, "succeeded"),
        (moved(1, 5.01), {"u_mm": 0.0}, "failed"),
        (TRUTH, {"u_mm": 1.8}, ""),  # a truth too uncertain to accept anything
    ],
)
def test_what_the_truths_uncertainty_could_turn_is_neither(
    found: Any, changes: dict[str, Any], surely: str
) -> None:
    s = score(found, **changes)
    assert (s.surely_succeeded, s.surely_failed) == (surely == "succeeded", surely == "failed")


class TestPool:
    GOOD = score(TRUTH, hidden_claimed=0)
    BAD = score(moved(0, 7.0)[:3], hidden_claimed=1, seconds=3.0)

    def test_rates_count_poses_and_a_pose_needs_all_its_repeats(self) -> None:
        p = pool([self.GOOD, self.GOOD, self.GOOD, self.BAD], ["a", "a", "b", "b"])
        assert p.frames == Rate(3, 4)
        assert p.success == p.in_time == p.hidden_right == Rate(1, 2)
        assert p.counts == Counts(visible=16, matched=15, missed=1)
        assert p.counts.recall == Rate(15, 16)

    def test_errors_keep_their_pose_and_their_teat(self) -> None:
        p = pool([self.GOOD, self.BAD], ["a", "b"])
        assert p.errors_mm.shape == (7, 3)
        assert p.error_poses == ("a",) * 4 + ("b",) * 3
        assert p.summary().radial.max_mm == pytest.approx(7.0)

    def test_rates_that_the_truth_cannot_turn_count_poses(self) -> None:
        near, over = score(moved(0, 4.9)), score(moved(0, 5.1))
        p = pool([self.GOOD, near, over, self.BAD, self.GOOD, self.GOOD], list("aabcdd"))
        assert p.surely_succeeded(0.95, 0.95) == Rate(1, 4)
        assert (p.success, p.perhaps_succeeded) == (Rate(2, 4), Rate(3, 4))

    @pytest.mark.parametrize(
        ("near_mm", "poses", "sure"),
        [
            (4.6, 20, 20),
            (4.3, 59, 59),
            (4.4, 59, 58),
            (4.6, 91, 91),
            (4.6, 93, 92),
            (3.9, 93, 93),
            (4.7, 93, 92),
        ],
    )
    def test_how_near_a_success_may_be_follows_from_the_number_of_poses(
        self, near_mm: float, poses: int, sure: int
    ) -> None:
        p = pool([score(moved(0, near_mm)), *[self.GOOD] * (poses - 1)])
        assert p.surely_succeeded(0.95, 0.95) == Rate(sure, poses)

    def test_false_teats_count_by_the_worst_repeat_of_a_pose(self) -> None:
        false = score(np.vstack([TRUTH, [[0, 0, 0]]]))
        p = pool([self.GOOD, self.BAD, false, false, self.GOOD], ["a", "b", "c", "c", "d"])
        assert p.worst_false == (0, 0, 1, 0)

    def test_errors_of_two_runs_are_pooled_and_not_averaged(self) -> None:
        few, many = score(moved(0, 5.0)[:1]), score(TRUTH)  # one teat 5 mm off; 24, none off
        both = pool([few, *[many] * 6])
        rms = both.summary().radial.rms_mm
        # sqrt(25 / 25); the mean of the two runs' rms would say 2.5
        assert rms == pytest.approx(1.0)
        assert both.counts.recall == Rate(25, 28)

    def test_no_claim_on_hidden_teats_is_not_measured(self) -> None:
        assert pool([score(TRUTH)]).hidden_right.value is None

    def test_an_empty_pool_measured_nothing(self) -> None:
        p = Pool()
        assert (p.success.value, p.counts, p.summary().radial.mean_mm) == (None, Counts(), None)
