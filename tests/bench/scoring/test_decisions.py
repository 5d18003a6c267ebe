"""Verdicts on rates, times, counts and conditions: the three outcomes of each rule, and what the
sentences say.
"""

from __future__ import annotations

from functools import cache, partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.report.wording import measured
from bench.scoring.decisions import (
    Decision,
    Verdict,
    decide_condition,
    decide_count,
    decide_error,
    decide_rate,
    decide_time,
    overall,
)
from bench.scoring.rates import Rate

MET, NOT_MET, INCONCLUSIVE, NOT_MEASURED = Verdict
rate95 = partial(decide_rate, "success", required=0.95, confidence=0.95)
error95 = partial(decide_error, "error", limit_mm=5.0, u_mm=0.23, rate=0.95, confidence=0.95)


@pytest.mark.parametrize(
    ("decision", "told"),
    [
        (rate95(Rate(6, 6)), "100.0 % (at least 60.7 %)"),
        (rate95(Rate(58, 58)), "100.0 % (at least 94.97 %)"),
        (rate95(Rate(9, 18)), "50.0 % (at most 70.9 %)"),
        (rate95(Rate(0, 0)), "not measured"),
        (error95([3.0] * 59), "3.00 mm (at most 3.39 mm)"),
        (error95([6.0] * 59), "6.00 mm (at least 5.62 mm)"),
        (error95([3.0] * 59, u_mm=0.0), "3.00 mm"),
        (decide_count("false", 0, scenes=3), "0"),
    ],
)
def test_a_bound_is_told_on_its_side(decision: Decision, told: str) -> None:
    assert measured(decision) == told


class TestRate:
    @pytest.mark.parametrize(
        ("successes", "trials", "verdict"),
        [
            (59, 59, MET),
            (58, 58, INCONCLUSIVE),
            (92, 93, MET),
            (91, 92, INCONCLUSIVE),
            (20, 24, NOT_MET),
            (21, 24, INCONCLUSIVE),
            (0, 0, NOT_MEASURED),
        ],
    )
    def test_three_outcomes(self, successes: int, trials: int, verdict: Verdict) -> None:
        assert rate95(Rate(successes, trials)).verdict is verdict

    def test_24_of_24_shows_88_percent_and_says_what_is_missing(self) -> None:
        d = rate95(Rate(24, 24))
        assert (d.verdict, d.measured, d.margin) == (INCONCLUSIVE, 100.0, 5.0)
        assert "24 of 24 poses succeeded (100 %): only 88.3 % is shown; 35 more poses" in d.sentence

    @pytest.mark.parametrize(
        ("rate", "says"),
        [
            (Rate(59, 59), "a rate of at least 95.0 % is shown, with 95 % confidence"),
            (Rate(0, 24), "a rate of at most 11.7 % is shown"),
            (Rate(), "59 without a failure would show 95 %"),
            (Rate(58, 58), "only 94.97 % is shown; 1 more pose without a further failure"),
        ],
    )
    def test_a_verdict_names_the_rate_that_was_shown_and_never_rounds_it_up(
        self, rate: Rate, says: str
    ) -> None:
        assert says in rate95(rate).sentence
        assert "95.0 %" not in rate95(Rate(58, 58)).sentence

    @given(st.integers(1, 300).flatmap(lambda n: st.builds(Rate, st.integers(0, n), st.just(n))))
    def test_it_is_shown_exactly_where_the_margin_reaches_the_uncertainty(self, rate: Rate) -> None:
        d = rate95(rate)
        assert d.margin is not None
        assert d.uncertainty is not None
        assert (d.verdict is MET) == (d.margin >= d.uncertainty)

    def test_successes_that_the_truth_could_turn_show_nothing(self) -> None:
        d = rate95(Rate(62, 62), shown=Rate(60, 62))
        assert (d.verdict, d.measured) == (INCONCLUSIVE, 100.0)
        assert "within the truth's uncertainty 2 of them could be failures" in d.sentence
        assert rate95(Rate(62, 62), shown=Rate(62, 62)).verdict is MET

    def test_failures_that_the_truth_could_turn_refuse_nothing(self) -> None:
        d = rate95(Rate(20, 24), possible=Rate(22, 24))
        assert d.verdict is INCONCLUSIVE
        assert "2 of the failures could be successes" in d.sentence
        assert rate95(Rate(20, 24), possible=Rate(20, 24)).verdict is NOT_MET

    def test_100_percent_cannot_be_required(self) -> None:
        with pytest.raises(ValueError, match="no number of trials shows 100 %"):
            decide_rate("success", Rate(9, 9), required=1.0, confidence=0.95)


class TestTime:
    def test_p95_and_largest_are_two_requirements(self) -> None:
        seconds = [0.5] * 95 + [1.5] * 5
        assert decide_time("aim", seconds, limit_s=1.0, statistic="p95").verdict is MET
        assert decide_time("most", seconds, limit_s=2.0, statistic="max").verdict is MET
        assert decide_time("most", seconds, limit_s=1.4, statistic="max").verdict is NOT_MET
        seconds = [0.5] * 94 + [1.5] * 6
        assert decide_time("aim", seconds, limit_s=1.0, statistic="p95").verdict is NOT_MET

    def test_the_limit_itself_is_in_time(self) -> None:
        d = decide_time("aim", [1.0], limit_s=1.0, statistic="max")
        assert (d.verdict, d.measured, d.margin, d.unit) == (MET, 1.0, 0.0, "s")

    def test_a_claim_for_a_share_needs_its_trials(self) -> None:
        claim = partial(decide_time, "most", limit_s=2.0, statistic="max", rate=0.95)
        assert claim([1.0] * 58).verdict is INCONCLUSIVE
        assert claim([1.0] * 59).verdict is MET
        assert claim([2.1]).verdict is NOT_MET
        with pytest.raises(ValueError, match="a p95 says it of 95 %"):
            decide_time("aim", [1.0], limit_s=1.0, statistic="p95", rate=0.99)

    def test_a_p95_is_claimed_on_its_exact_bound(self) -> None:
        claim = partial(decide_time, "aim", limit_s=1.0, statistic="p95", rate=0.95)
        assert claim([0.5] * 92 + [1.5]).verdict is MET  # 92 of 93
        assert claim([0.5] * 91 + [1.5]).verdict is INCONCLUSIVE
        assert "needs 1 more pose" in claim([0.5] * 91 + [1.5]).sentence

    def test_repeats_of_a_pose_are_one_trial(self) -> None:
        claim = partial(decide_time, "most", limit_s=2.0, statistic="max", rate=0.95)
        d = claim([1.0] * 177, poses=[k // 3 for k in range(177)])
        assert (d.n, d.verdict) == (59, MET)
        d = claim([1.0] * 174, poses=[k // 3 for k in range(174)])
        assert d.verdict is INCONCLUSIVE
        assert "over 174 detections is 1 s, limit 2 s; 58 of 58 poses in time" in d.sentence

    def test_without_a_rate_it_says_what_is_shown(self) -> None:
        d = decide_time("most", [1.0] * 6, limit_s=2.0, statistic="max")
        assert "6 of 6 poses in time, which shows 60.7 %" in d.sentence

    def test_nothing_timed(self) -> None:
        assert decide_time("aim", [], limit_s=1.0, statistic="p95").verdict is NOT_MEASURED


class TestCountAndCondition:
    def test_no_false_teat(self) -> None:
        d = decide_count("false teats", 0, scenes=59)
        assert (d.verdict, d.measured, d.n) == (MET, 0.0, 59)
        assert "at most 0.051 a scene" in d.sentence  # 2.996 / 59, the rule of three
        assert decide_count("false teats", 1, scenes=59).verdict is NOT_MET
        assert decide_count("false teats", 0, scenes=0).verdict is NOT_MEASURED

    def test_repeats_of_a_pose_do_not_narrow_the_bound(self) -> None:
        d = decide_count("false teats", 0, scenes=18, per_pose=[0] * 6)
        assert (d.n, d.measured) == (6, 0.0)
        assert "0 in 18 scenes of 6 poses: at most 0.5 a scene" in d.sentence  # 2.996 / 6
        assert (
            "3 in 18 scenes of 6 poses: at most 0.79"
            in decide_count("false teats", 3, scenes=18, per_pose=[1, 0, 0, 0, 0, 0]).sentence
        )

    @pytest.mark.parametrize(
        ("held", "of", "verdict"), [(18, 18, MET), (17, 18, NOT_MET), (0, 0, NOT_MEASURED)]
    )
    def test_a_condition_has_to_hold_every_time(self, held: int, of: int, verdict: Verdict) -> None:
        assert decide_condition("bath", "in band", held=held, of=of).verdict is verdict

    def test_impossible_counts(self) -> None:
        with pytest.raises(ValueError, match="1 in 0 scenes"):
            decide_count("false teats", 1, scenes=0)
        with pytest.raises(ValueError, match="3 successes of 2"):
            decide_condition("bath", "in band", held=3, of=2)


@given(st.lists(st.sampled_from(Verdict)))
def test_the_overall_verdict_is_the_worst(verdicts: list[Verdict]) -> None:
    worst = overall(verdicts)
    assert (worst is NOT_MET) == (NOT_MET in verdicts)
    assert (worst is MET) == (len(verdicts) > 0 and set(verdicts) == {MET})
    assert worst is not NOT_MEASURED


@pytest.mark.parametrize("n", [59, 93, 150, 400])
def test_a_rate_just_under_the_required_is_accepted_in_fewer_than_5_percent(n: int) -> None:
    verdict = cache(lambda k: rate95(Rate(k, n)).verdict)
    draws = np.random.default_rng(37).binomial(n, 0.9499, 20_000)
    met = float(np.mean([verdict(int(k)) is MET for k in draws]))
    refused = np.random.default_rng(38).binomial(n, 0.95, 20_000)
    slack = 3 * np.sqrt(0.05 * 0.95 / 20_000)
    assert met < 0.05 + slack
    assert float(np.mean([verdict(int(k)) is NOT_MET for k in refused])) < 0.05 + slack
