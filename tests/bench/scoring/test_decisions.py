"""Verdicts on rates, errors, times, counts and conditions: the three outcomes of each rule, what the
sentences say, and how often a rule accepts what it must not; guard bands and tolerance limits.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from bench.report.wording import measured
from bench.rig.model import Arm
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
from bench.scoring.errors import Floats, normal_k, quantile_bounds
from bench.scoring.guard_band import (
    acceptance_limit_mm,
    axis_acceptance_limit_mm,
    error_without_noise_mm,
    guard_band_mm,
    leak,
    refusal_limit_mm,
)
from bench.scoring.rates import Rate, guarded_n, shown_falsely
from bench.truth.touching import end_u_mm, reading_u_mm
from instruments.microscribe.emulator import KinematicError, workspace
from instruments.microscribe.unit import shipped_unit

MET, NOT_MET, INCONCLUSIVE, NOT_MEASURED = Verdict
rate95 = partial(decide_rate, "success", required=0.95, confidence=0.95)
error95 = partial(decide_error, "error", limit_mm=5.0, u_mm=0.23, rate=0.95, confidence=0.95)


@pytest.mark.parametrize(
    ("decision", "text"),
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
def test_a_bound_is_reported_its_side(decision: Decision, text: str) -> None:
    assert measured(decision) == text


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


U = 0.23
error = partial(decide_error, "error", limit_mm=5.0, u_mm=U, rate=0.95, confidence=0.95)


@pytest.mark.parametrize(
    ("largest", "n", "verdict"),
    [
        (4.30, 59, MET),
        (4.30, 58, INCONCLUSIVE),  # too few poses for the claim
        (4.610, 91, MET),
        (4.610, 90, INCONCLUSIVE),  # too few for a claim so near to the limit
        (4.610, 59, INCONCLUSIVE),
        (4.612, 500, INCONCLUSIVE),  # in the guard band
        (5.377, 59, INCONCLUSIVE),
        (5.379, 59, NOT_MET),
        (5.379, 1, NOT_MET),  # one is enough to refuse
        (0.0, 0, NOT_MEASURED),
    ],
)
def test_three_outcomes(largest: float, n: int, verdict: Verdict) -> None:
    assert error([1.0] * (n - 1) + [largest] * (n > 0)).verdict is verdict


@pytest.mark.parametrize(("rate", "n"), [(0.95, 59), (0.99, 299), (0.999, 2995)])
def test_far_from_the_limit_the_usual_numbers_are_enough(rate: float, n: int) -> None:
    assert error([3.0] * n, rate=rate).verdict is MET
    assert error([3.0] * (n - 1), rate=rate).verdict is INCONCLUSIVE


def test_a_truth_without_uncertainty_asks_for_the_usual_number_up_to_the_limit() -> None:
    assert error([4.999] * 59, u_mm=0.0).verdict is MET


def test_teats_and_repeats_of_a_pose_count_once() -> None:
    poses = [k // 4 for k in range(232)]  # 58 poses of four teats
    decision = error([1.0] * 232, poses=poses)
    assert (decision.n, decision.verdict) == (58, INCONCLUSIVE)
    assert "1 more" in decision.sentence


def test_the_decision_carries_what_a_report_prints() -> None:
    d = error([1.0] * 58 + [3.0])
    assert (d.n, d.measured, d.unit, d.limit, d.margin) == (59, 3.0, "mm", 5.0, 2.0)
    assert d.accept == pytest.approx(4.611, abs=0.0005)
    assert d.uncertainty == pytest.approx(0.389, abs=0.0005)
    within = "within the acceptance limit of 4.611 mm; shown for 95 % of poses"
    shows = "59 of 59 poses within 3.00 mm show 95.0 %"
    assert d.sentence == f"The largest distance over 59 poses is 3.00 mm, {within}; {shows}."
    figures = "4.611, 5.378, T = 5 mm, u = 0.23 mm, 59 poses, 95 %, more near the acceptance limit"
    assert all(figure in d.rule for figure in figures.split(", "))
    assert d.as_dict()["verdict"] == "met"


def test_near_the_limit_it_says_how_many_more() -> None:
    sentence = error([1.0] * 58 + [4.6]).sentence
    assert "needs 25 more (59 do where the largest lies further from it)" in sentence
    assert error([1.0] * 83 + [4.6]).verdict is MET


def test_what_was_missed_is_reported_beside_the_errors_of_the_rest() -> None:
    assert error([1.0] * 59, missed=7).sentence.endswith("Of the found teats only: 7 were missed.")


def test_a_truth_too_uncertain_decides_nothing_but_the_worst() -> None:
    assert error([0.1] * 59, u_mm=1.8).verdict is INCONCLUSIVE
    assert "too uncertain" in error([0.1] * 59, u_mm=1.8).sentence
    assert error([9.0] * 59, u_mm=1.8).verdict is NOT_MET


def test_a_truth_of_unknown_uncertainty_accepts_nothing() -> None:
    d = error([0.1] * 59, u_mm=None)
    assert (d.verdict, d.accept) == (INCONCLUSIVE, None)
    assert "states no uncertainty" in d.sentence
    assert "accepted up to nothing" in d.rule
    assert error([9.0], u_mm=None).verdict is NOT_MET


def test_a_confidence_beyond_the_guard_band_needs_more_room() -> None:
    near = error([4.6] * 400, confidence=0.99)
    assert near.verdict is INCONCLUSIVE
    assert "however many poses" in near.sentence
    assert error([4.0] * 90, confidence=0.99).verdict is MET


def test_the_largest_decides_however_many_are_near() -> None:
    assert error([1.0] * 298 + [7.0, 8.0]).verdict is NOT_MET
    assert error([1.0] * 58).verdict is INCONCLUSIVE


def test_nothing_measured_has_no_figures() -> None:
    d = error([])
    assert (d.n, d.verdict) == (0, NOT_MEASURED)
    assert d.measured is d.margin is d.uncertainty is None


def test_bad_rows() -> None:
    with pytest.raises(ValueError, match="2 names for 3 rows"):
        error([1, 2, 3], poses=["a", "b"])
    with pytest.raises(ValueError, match="not finite"):
        error([1.0, float("nan")])
    assert worst_per_pose(np.array([1.0, 5.0, 2.0]), ["a", "b", "a"]).tolist() == [2.0, 5.0]


# How often the rule says "met" of a detector that fails the requirement. Seen = true + the truth's
# own error, as in an emulated run: in one run a touching arm is off by much the same everywhere, so
# the truth's errors are drawn afresh, alike, and by the emulated arm.

EXPERIMENTS = 10_000
Drawn = Callable[[np.random.Generator, int], Floats]


def afresh(rng: np.random.Generator, n: int) -> Floats:
    return rng.normal(0, U, (EXPERIMENTS, n, 3))


def alike(rng: np.random.Generator, n: int) -> Floats:
    return np.repeat(rng.normal(0, U, (EXPERIMENTS, 1, 3)), n, axis=1)


def half_alike(rng: np.random.Generator, n: int) -> Floats:
    both: Floats = np.sqrt(0.5) * (afresh(rng, n) + alike(rng, n))
    return both


def of_emulated_arms(rng: np.random.Generator, n: int, arms: int = 80) -> Floats:
    """An arm of its own an experiment (of so many), each at n poses near one another, with the
    hand's and the counts' scatter.
    """
    unit = shipped_unit("40937")
    geometry = unit.geometry()
    home = geometry.angles(unit.home)[0]
    off = np.empty((arms, n, 3))
    for seed in range(arms):
        at = workspace(geometry, home, rng)[0] + rng.uniform(-0.15, 0.15, (n, 6))
        off[seed] = KinematicError(geometry, home, seed=seed, accuracy_mm=ARM.accuracy_mm).at(at)
    return off[rng.integers(arms, size=EXPERIMENTS)] + rng.normal(
        0, reading_u_mm(ARM) / np.sqrt(ARM.touches), (EXPERIMENTS, n, 3)
    )


ARM = Arm(url="socket://127.0.0.1:1")
TRUTHS: dict[str, tuple[Drawn, float]] = {
    "afresh": (afresh, U),
    "alike": (alike, U),
    "half alike": (half_alike, U),
    "emulated arms": (of_emulated_arms, end_u_mm(ARM, ARM.touches)),
}


def spread(rng: np.random.Generator, n: int) -> Floats:
    """|e| of three normal components of sd s: its 95 % quantile is 2.7955 s (chi distribution, 3
    degrees of freedom).
    """
    return rng.normal(0, 5.01 / 2.7955, (EXPERIMENTS, n, 3))


def astray(rng: np.random.Generator, n: int) -> Floats:
    true = rng.normal(0, 0.6, (EXPERIMENTS, n, 3))
    true[..., 1] += np.where(rng.random((EXPERIMENTS, n)) < 0.055, 12.0, 0.0)
    return true


def biased(rng: np.random.Generator, n: int) -> Floats:
    return rng.normal([0.0, 4.21, 0.0], 0.5, (EXPERIMENTS, n, 3))


def just_over(rng: np.random.Generator, n: int) -> Floats:
    """The worst there can be for the rule: every bad pose hardly over the limit and the same way,
    every good one far below it.
    """
    true = np.zeros((EXPERIMENTS, n, 3))
    true[..., 0] = np.where(rng.random((EXPERIMENTS, n)) < 0.055, 5.0001, 0.0)
    return true


def largest_met_mm(n: int, u: float) -> float:
    """The largest error that n poses show for 95/95, by scipy's own distribution."""
    good = 0.95**n
    accept = acceptance_limit_mm(5.0, u)
    assert accept is not None

    def risk(at: float) -> float:
        return (
            good
            + (1.0 - good) * float(scipy.stats.ncx2.cdf((at / u) ** 2, 3, (5.0 / u) ** 2))
            - 0.05
        )

    return accept if risk(accept) <= 0.0 else float(brentq(risk, 1.0, accept))


@pytest.mark.slow
@pytest.mark.parametrize("truth", TRUTHS)
@pytest.mark.parametrize(
    ("detector", "n"), [(spread, 59), (astray, 59), (biased, 59), (just_over, 59), (just_over, 91)]
)
def test_10_000_experiments_accept_fewer_than_5_percent_of_what_fails(
    truth: str, detector: Drawn, n: int
) -> None:
    draw, u = TRUTHS[truth]
    rng = np.random.default_rng([n, *truth.encode(), *detector.__name__.encode()])
    true = detector(rng, n)
    assert float(np.mean(np.linalg.norm(true, axis=2) > 5.0)) > 0.05
    seen = np.linalg.norm(true + draw(rng, n), axis=2)
    met = seen.max(axis=1) <= largest_met_mm(n, u)
    for row, expected in zip(
        [*seen[:100], *seen[met][:25]], [*met[:100], *met[met][:25]], strict=True
    ):
        assert (error(row, u_mm=u).verdict is MET) == expected
    assert float(met.mean()) < 0.05


@pytest.mark.parametrize("u", [0.05, 0.23, 0.5, 1.0])
@pytest.mark.parametrize("rate", [0.95, 0.99])
def test_no_number_of_poses_makes_the_risk_more_than_5_percent(u: float, rate: float) -> None:
    accept = acceptance_limit_mm(5.0, u)
    assert accept is not None
    for share in (0.7, 0.9, 0.95, 0.99, 0.9999):
        passed = leak(share * accept, 5.0, u)
        assert passed == pytest.approx(
            float(scipy.stats.ncx2.cdf((share * accept / u) ** 2, 3, (5.0 / u) ** 2)),
            rel=1e-6,
            abs=1e-12,
        )
        n = guarded_n(0, rate, 0.95, passed)
        assert n is not None
        assert shown_falsely(0, n, rate, passed) <= 0.05 < shown_falsely(0, n - 1, rate, passed)


def test_a_detector_always_over_the_limit_is_never_accepted() -> None:
    assert all(
        error(row).verdict is not MET
        for row in 5.0001 + np.random.default_rng(34).normal(0, U, (300, 59))
    )


def test_a_good_detector_is_accepted_mostly() -> None:
    rng = np.random.default_rng(35)
    seen = np.linalg.norm(rng.normal(0, 0.5, (300, 59, 3)) + rng.normal(0, U, (300, 59, 3)), axis=2)
    assert float(np.mean([error(row).verdict is MET for row in seen])) > 0.99


T = 5.0


def test_frozen_acceptance_limits() -> None:
    assert guard_band_mm(U) == pytest.approx(1.645 * U, abs=1e-4)
    assert axis_acceptance_limit_mm(T, U) == pytest.approx(4.622, abs=0.0005)
    assert axis_acceptance_limit_mm(T, T / 1.64) is None
    assert acceptance_limit_mm(T, U) == pytest.approx(4.611, abs=0.0005)
    assert refusal_limit_mm(T, U) == pytest.approx(5.378, abs=0.0005)


def test_a_truth_without_uncertainty_has_no_guard_band() -> None:
    assert acceptance_limit_mm(T, 0.0) == refusal_limit_mm(T, 0.0) == T


@pytest.mark.slow
@given(st.floats(1, 20), st.floats(1e-4, 0.55))
def test_the_radial_limit_solves_the_noncentral_chi_square(limit: float, relative: float) -> None:
    u = limit * relative
    accept = acceptance_limit_mm(limit, u)
    if accept is None:
        assert scipy.stats.ncx2.cdf((limit / u) ** 2, 3, 1e-12) <= 0.95
    else:
        assert scipy.stats.ncx2.cdf((limit / u) ** 2, 3, (accept / u) ** 2) == pytest.approx(
            0.95, abs=1e-6
        )


def test_the_radial_limit_by_monte_carlo() -> None:
    accept = acceptance_limit_mm(T, U)
    assert accept is not None
    rng = np.random.default_rng(20)
    true = np.array([accept, 0, 0]) + rng.normal(0, U, (400_000, 3))
    share = float((np.linalg.norm(true, axis=1) > T).mean())
    assert share == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / 400_000))


def test_a_true_error_at_the_limit_is_accepted_in_fewer_than_5_percent() -> None:
    accept = acceptance_limit_mm(T, U)
    assert accept is not None
    seen = np.array([0, T, 0]) + np.random.default_rng(21).normal(0, U, (400_000, 3))
    assert float((np.linalg.norm(seen, axis=1) <= accept).mean()) < 0.05


@given(st.floats(1.0, 10.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_more_uncertainty_never_accepts_more(limit: float, a: float, b: float) -> None:
    low, high = sorted((a, b))
    tight, loose = acceptance_limit_mm(limit, high), acceptance_limit_mm(limit, low)
    assert tight is None or (loose is not None and tight <= loose + 1e-9)


def test_a_truth_too_uncertain_accepts_nothing() -> None:
    assert acceptance_limit_mm(T, 1.8) is None


def test_noise_inflates_what_is_seen() -> None:
    rng = np.random.default_rng(22)
    seen = np.array([1.0, 2.0, 2.0]) + rng.normal(0, U, (200_000, 3))
    rms = float(np.sqrt((seen**2).sum(axis=1).mean()))
    assert rms > 3.02
    assert error_without_noise_mm(rms, U) == pytest.approx(3.0, abs=0.003)
    assert error_without_noise_mm(0.3, U) is None


def test_bad_limits_are_refused() -> None:
    for u in (-0.1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="uncertainty of the truth"):
            guard_band_mm(u)
    with pytest.raises(ValueError, match="limit: 0"):
        acceptance_limit_mm(0.0, U)


def test_frozen_tolerance_factors() -> None:
    assert normal_k(30, 0.95, 0.95) == pytest.approx(2.220, abs=0.0005)
    assert normal_k(100, 0.99, 0.95) == pytest.approx(2.684, abs=0.0005)


@given(
    st.integers(2, 500), st.sampled_from([0.9, 0.95, 0.99]), st.sampled_from([0.5, 0.9, 0.95, 0.99])
)
def test_the_normal_factor_against_scipy_stats(n: int, rate: float, confidence: float) -> None:
    referee = scipy.stats.nct.ppf(
        confidence, n - 1, scipy.stats.norm.ppf(rate) * np.sqrt(n)
    ) / np.sqrt(n)
    assert normal_k(n, rate, confidence) == pytest.approx(referee, rel=1e-6)


def test_the_largest_of_59_is_the_first_95_95_limit() -> None:
    assert quantile_bounds(np.arange(58.0), 0.95)[1] is None
    assert quantile_bounds(np.arange(59.0), 0.95)[1] == 58.0
    assert quantile_bounds(np.arange(93.0), 0.95)[1] == 91.0  # Wilks: from 93 on the second largest
    assert quantile_bounds([], 0.95) == (None, None)


def test_quantile_bounds_cover_as_often_as_they_claim() -> None:
    draws = np.random.default_rng(23).exponential(size=(4000, 120))
    quantile = -np.log(0.1)  # of 90 %, exactly
    bounds = np.array([quantile_bounds(row, 0.9) for row in draws], dtype=np.float64)
    for covered in ((bounds[:, 0] <= quantile).mean(), (bounds[:, 1] >= quantile).mean()):
        assert 0.94 < covered < 0.99


def test_what_a_guard_band_lets_through() -> None:
    rng = np.random.default_rng(24)
    seen = np.linalg.norm(rng.normal([5.0, 0.0, 0.0], 0.23, (400_000, 3)), axis=1)
    for at in (4.4, 4.611, 4.8):
        assert leak(at, 5.0, 0.23) == pytest.approx(float(np.mean(seen <= at)), rel=0.05)
    assert (leak(5.0, 5.0, 0.0), leak(5.1, 5.0, 0.0)) == (0.0, 1.0)
    for u in (4.99e-4, 5.01e-4):  # on both sides of where the sphere is taken to be flat
        assert leak(5.0 - u, 5.0, u) == pytest.approx(0.1586, abs=1e-4)


def test_a_spread_of_one_value_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        normal_k(1, 0.95)
