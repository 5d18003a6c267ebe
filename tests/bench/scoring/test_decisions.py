"""Verdicts: the three outcomes of each rule, what the sentences say, and how often a rule accepts what it must not."""

from __future__ import annotations

from functools import cache, partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.scoring.decisions import (
    Decision,
    Verdict,
    decide_condition,
    decide_count,
    decide_error,
    decide_rate,
    decide_time,
    overall,
    worst_per_pose,
)
from bench.scoring.limits import acceptance_limit_mm
from bench.scoring.points import Floats
from bench.scoring.rates import Rate
from bench.scoring.tolerance import worst_false_acceptance

MET, NOT_MET, INCONCLUSIVE, NOT_MEASURED = Verdict.MET, Verdict.NOT_MET, Verdict.INCONCLUSIVE, Verdict.NOT_MEASURED
U = 0.23
error = partial(decide_error, "error", limit_mm=5.0, u_mm=U, rate=0.95, confidence=0.95)
rate95 = partial(decide_rate, "success", required=0.95, confidence=0.95)


class TestError:
    @pytest.mark.parametrize(
        ("largest", "n", "verdict"),
        [
            (4.610, 59, MET),
            (4.612, 59, INCONCLUSIVE),  # in the guard band
            (5.377, 59, INCONCLUSIVE),
            (5.379, 59, NOT_MET),
            (4.610, 58, INCONCLUSIVE),  # too few poses for the claim
            (5.379, 1, NOT_MET),  # one is enough to refuse
            (0.0, 0, NOT_MEASURED),
        ],
    )
    def test_three_outcomes(self, largest: float, n: int, verdict: Verdict) -> None:
        assert error([1.0] * (n - 1) + [largest] * (n > 0)).verdict is verdict

    def test_along_an_axis_the_limit_is_wider_and_the_sign_is_dropped(self) -> None:
        assert error([-4.620] * 59, along="axis").verdict is MET
        assert error([-4.620] * 59).verdict is INCONCLUSIVE
        assert error([-5.4] * 59, along="axis").verdict is NOT_MET

    def test_teats_and_repeats_of_a_pose_count_once(self) -> None:
        poses = [k // 4 for k in range(232)]  # 58 poses of four teats
        decision = error([1.0] * 232, poses=poses)
        assert (decision.n, decision.verdict) == (58, INCONCLUSIVE)
        assert "1 more" in decision.sentence

    def test_the_decision_carries_what_a_report_prints(self) -> None:
        d = error([1.0] * 58 + [3.0])
        assert (d.n, d.measured, d.unit, d.limit, d.margin) == (59, 3.0, "mm", 5.0, 2.0)
        assert d.accept == pytest.approx(4.611, abs=0.0005)
        assert d.uncertainty == pytest.approx(0.389, abs=0.0005)
        assert (
            d.sentence == "The largest distance over 59 poses is 3.00 mm, within the acceptance limit of 4.611 mm; shown for 95 % of poses."
        )
        for figure in ("4.611", "5.378", "T = 5 mm", "u = 0.23 mm", "59 poses", "95 %"):
            assert figure in d.rule
        assert d.as_dict()["verdict"] == "met"

    def test_a_truth_too_uncertain_decides_nothing_but_the_worst(self) -> None:
        assert error([0.1] * 59, u_mm=1.8).verdict is INCONCLUSIVE
        assert "too uncertain" in error([0.1] * 59, u_mm=1.8).sentence
        assert error([9.0] * 59, u_mm=1.8).verdict is NOT_MET

    def test_the_quantile_forgives_what_the_largest_does_not(self) -> None:
        errors = [1.0] * 298 + [7.0, 8.0]
        assert error(errors).verdict is NOT_MET
        assert error(errors, statistic="quantile").verdict is MET
        assert error([7.0] * 60, statistic="quantile").verdict is NOT_MET
        assert error([1.0] * 58, statistic="quantile").verdict is INCONCLUSIVE

    def test_nothing_measured_has_no_figures(self) -> None:
        d = error([])
        assert (d.n, d.measured, d.margin, d.uncertainty, d.verdict) == (0, None, None, None, NOT_MEASURED)

    def test_poses_have_to_fit(self) -> None:
        with pytest.raises(ValueError, match="2 names for 3 values"):
            error([1, 2, 3], poses=["a", "b"])
        assert worst_per_pose(np.array([1.0, 5.0, 2.0]), ["a", "b", "a"]).tolist() == [2.0, 5.0]


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

    def test_a_verdict_names_the_rate_that_was_shown(self) -> None:
        assert "a rate of at least 95.0 % is shown, with 95 % confidence" in rate95(Rate(59, 59)).sentence
        assert "a rate of at most 11.7 % is shown" in rate95(Rate(0, 24)).sentence
        assert "59 without a failure would show 95 %" in rate95(Rate()).sentence

    @given(st.integers(1, 300).flatmap(lambda n: st.builds(Rate, st.integers(0, n), st.just(n))))
    def test_it_is_shown_exactly_where_the_margin_reaches_the_uncertainty(self, rate: Rate) -> None:
        d = rate95(rate)
        assert d.margin is not None
        assert d.uncertainty is not None
        assert (d.verdict is MET) == (d.margin >= d.uncertainty)

    def test_100_percent_cannot_be_required(self) -> None:
        with pytest.raises(ValueError, match="no number of trials shows 100 %"):
            decide_rate("success", Rate(9, 9), required=1.0, confidence=0.95)


class TestTime:
    def test_p95_and_largest_are_two_requirements(self) -> None:
        seconds = [0.5] * 95 + [1.5] * 5
        assert decide_time("aim", seconds, limit_s=1.0, statistic="p95").verdict is MET
        assert decide_time("most", seconds, limit_s=2.0, statistic="max").verdict is MET
        assert decide_time("most", seconds, limit_s=1.4, statistic="max").verdict is NOT_MET
        assert decide_time("aim", [0.5] * 94 + [1.5] * 6, limit_s=1.0, statistic="p95").verdict is NOT_MET

    def test_the_limit_itself_is_in_time(self) -> None:
        d = decide_time("aim", [1.0], limit_s=1.0, statistic="max")
        assert (d.verdict, d.measured, d.margin, d.unit) == (MET, 1.0, 0.0, "s")

    def test_a_claim_for_a_share_needs_its_trials(self) -> None:
        claim = partial(decide_time, "most", limit_s=2.0, statistic="max", rate=0.95)
        assert claim([1.0] * 58).verdict is INCONCLUSIVE
        assert claim([1.0] * 59).verdict is MET
        assert claim([2.1]).verdict is NOT_MET
        with pytest.raises(ValueError, match="largest time"):
            decide_time("aim", [1.0], limit_s=1.0, statistic="p95", rate=0.95)

    def test_nothing_timed(self) -> None:
        assert decide_time("aim", [], limit_s=1.0, statistic="p95").verdict is NOT_MEASURED


class TestCountAndCondition:
    def test_no_false_teat(self) -> None:
        d = decide_count("false teats", 0, scenes=59)
        assert (d.verdict, d.measured, d.n) == (MET, 0.0, 59)
        assert "at most 0.051 a scene" in d.sentence  # 2.996 / 59, the rule of three
        assert decide_count("false teats", 1, scenes=59).verdict is NOT_MET
        assert decide_count("false teats", 0, scenes=0).verdict is NOT_MEASURED

    def test_a_condition_has_to_hold_every_time(self) -> None:
        assert decide_condition("bath", "in band at every capture", held=18, of=18).verdict is MET
        assert decide_condition("bath", "in band at every capture", held=17, of=18).verdict is NOT_MET
        assert decide_condition("bath", "in band at every capture", held=0, of=0).verdict is NOT_MEASURED

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


def test_the_words_of_the_verdicts() -> None:
    assert [str(v) for v in Verdict] == ["met", "not met", "inconclusive", "not measured"]


# How often a rule says "met" of a detector that fails the requirement. Seen = true + the truth's own noise, as in an emulated run.

EXPERIMENTS = 10_000
LIMIT_MM = acceptance_limit_mm(5.0, U)


def accepted(true_mm: Floats, seed: int) -> float:
    """Share of experiments (e, n, 3) accepted, noise of the truth added: all by the rule's own limit, some by the rule itself."""
    assert LIMIT_MM is not None
    seen = np.linalg.norm(true_mm + np.random.default_rng(seed).normal(0, U, true_mm.shape), axis=2)
    met = seen.max(axis=1) <= LIMIT_MM
    for row, expected in zip([*seen[:200], *seen[met][:50]], [*met[:200], *met[met][:50]], strict=True):
        assert (error(row).verdict is MET) == expected
    return float(met.mean())


def test_a_normal_detector_that_just_fails_is_accepted_in_fewer_than_5_percent() -> None:
    # |e| of three normal components of sd s: its 95 % quantile is 2.7955 s (chi distribution, 3 degrees of freedom)
    rng = np.random.default_rng(30)
    assert accepted(rng.normal(0, 5.0 / 2.7955, (EXPERIMENTS, 59, 3)), 31) < 0.05


def test_one_pose_in_twenty_gone_astray_is_accepted_in_fewer_than_5_percent() -> None:
    rng = np.random.default_rng(39)
    true = rng.normal(0, 0.6, (EXPERIMENTS, 59, 3))
    true[..., 1] += np.where(rng.random((EXPERIMENTS, 59)) < 0.0501, 12.0, 0.0)
    share = accepted(true, 40)
    assert share < 0.05
    assert share > 0.04  # the rule gives away no more than it must: 0.9499^59 is 4.8 %


def test_a_bias_that_takes_one_teat_in_twenty_over_is_accepted_in_fewer_than_5_percent() -> None:
    rng = np.random.default_rng(41)
    true = rng.normal([0.0, 4.21, 0.0], 0.5, (EXPERIMENTS, 59, 3))
    over = float(np.mean(np.linalg.norm(true, axis=2) > 5.0))
    assert 0.05 < over < 0.08
    assert accepted(true, 42) < 0.05


def test_one_teat_in_twenty_just_over_the_limit_is_accepted_no_more_often_than_the_bound() -> None:
    rng = np.random.default_rng(32)
    for n in (59, 62):
        bad = rng.random((EXPERIMENTS, n)) < 0.05
        true = np.zeros((EXPERIMENTS, n, 3))
        true[..., 0] = np.where(bad, 5.0001, 0.0)
        bound = worst_false_acceptance(n, 0.95)
        assert accepted(true, 33) <= bound + 3 * np.sqrt(bound / EXPERIMENTS)


def test_a_detector_always_over_the_limit_is_never_accepted() -> None:
    true = np.zeros((EXPERIMENTS, 59, 3))
    true[..., 2] = 5.0001
    assert accepted(true, 34) == 0.0


def test_a_good_detector_is_accepted_mostly() -> None:
    assert accepted(np.random.default_rng(35).normal(0, 0.5, (300, 59, 3)), 36) > 0.99


@pytest.mark.parametrize("n", [59, 93, 150, 400])
def test_a_rate_just_under_the_required_is_accepted_in_fewer_than_5_percent(n: int) -> None:
    verdict = cache(lambda k: rate95(Rate(k, n)).verdict)
    draws = np.random.default_rng(37).binomial(n, 0.9499, 20_000)
    met = float(np.mean([verdict(int(k)) is MET for k in draws]))
    refused = np.random.default_rng(38).binomial(n, 0.95, 20_000)
    slack = 3 * np.sqrt(0.05 * 0.95 / 20_000)
    assert met < 0.05 + slack
    assert float(np.mean([verdict(int(k)) is NOT_MET for k in refused])) < 0.05 + slack


def test_a_decision_is_frozen() -> None:
    with pytest.raises(AttributeError):
        error([1.0]).verdict = MET  # type: ignore[misc]
    assert isinstance(error([1.0]), Decision)
