"""Verdicts on rates, errors, times, counts and conditions: the three outcomes of each rule, what the
sentences say, and how often a rule accepts what it must not; guard bands and tolerance limits.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from bench.report.wording import limit, measured
from bench.rig.model import ArmTable
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
from bench.scoring.errors import Floats, normal_k, quantile_bound
from bench.scoring.guard_band import (
    acceptance_limit_mm,
    axis_acceptance_limit_mm,
    guard_band_mm,
    leak,
    refusal_limit_mm,
)
from bench.scoring.rates import Rate, guarded_n, shown_falsely, shown_rate
from bench.truth.touching import end_u_mm, reading_u_mm
from instruments.microscribe.emulator import KinematicError, workspace
from instruments.microscribe.unit import shipped_unit
from tests.examples import few

MET, NOT_MET, INCONCLUSIVE, NOT_MEASURED = Verdict
rate95 = partial(decide_rate, "success", required=0.95, confidence=0.95)
error95 = partial(decide_error, "error", limit_mm=5.0, u_mm=0.23, rate=0.95, confidence=0.95)


time = partial(decide_time, "time", limit_s=2.0, statistic="max")
p95 = partial(decide_time, "time", limit_s=1.0, statistic="p95")
false = partial(decide_count, "false teats")
bath = partial(decide_condition, "bath", "in band")


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
        (false(0, scenes=3), "0"),
        (bath(held=5, of=6), "5 of 6 times"),
        (bath(held=0, of=0), "not measured"),
    ],
)
def test_a_bound_is_reported_its_side(decision: Decision, text: str) -> None:
    assert measured(decision) == text


@pytest.mark.parametrize(
    ("decision", "text"),
    [
        (error95([3.0]), "5 mm"),
        (error95([3.0], limit_mm=0.592345), "0.59 mm"),  # worked out, not stated
        (rate95(Rate(6, 6)), "95 %"),
        (decide_rate("r", Rate(6, 6), required=0.9995, confidence=0.95), "99.95 %"),
        (p95([0.5]), "1 s"),
        (false(0, scenes=3), "0"),
        (bath(held=5, of=6), "each time"),
    ],
)
def test_a_limit_has_the_digits_that_were_stated(decision: Decision, text: str) -> None:
    assert limit(decision) == text


def thirds(poses: int) -> list[int]:
    """Three repeats of each pose."""
    return [k // 3 for k in range(3 * poses)]


@pytest.mark.parametrize(
    ("decision", "verdict", "says"),
    [
        (rate95(Rate(59, 59)), MET, "a rate of at least 95.0 % is shown, with 95 % confidence"),
        # never rounded up
        (
            rate95(Rate(58, 58)),
            INCONCLUSIVE,
            "only 94.97 % is shown; 22 more poses without a further",
        ),
        (rate95(Rate(92, 93)), MET, ""),
        (rate95(Rate(91, 92)), INCONCLUSIVE, ""),
        (rate95(Rate(20, 24)), NOT_MET, ""),
        (rate95(Rate(21, 24)), INCONCLUSIVE, ""),
        (rate95(Rate(0, 24)), NOT_MET, "a rate of at most 11.7 % is shown"),
        (rate95(Rate(0, 0)), NOT_MEASURED, "59 without a failure would show 95 %"),
        (
            rate95(Rate(24, 24)),
            INCONCLUSIVE,
            "24 of 24 poses succeeded (100 %): only 88.3 % is shown; 56 more poses",
        ),
        # what the truth could turn shows, and refuses, nothing
        (
            rate95(Rate(62, 62), shown=Rate(60, 62)),
            INCONCLUSIVE,
            "within the truth's uncertainty 2 of them could be failures",
        ),
        (rate95(Rate(62, 62), shown=Rate(62, 62)), MET, ""),
        (
            rate95(Rate(20, 24), possible=Rate(22, 24)),
            INCONCLUSIVE,
            "2 of the failures could be successes",
        ),
        (rate95(Rate(20, 24), possible=Rate(20, 24)), NOT_MET, ""),
        # p95 and largest are two requirements; the limit itself is in time
        (p95([0.5] * 95 + [1.5] * 5), MET, ""),
        (p95([0.5] * 94 + [1.5] * 6), NOT_MET, ""),
        (time([0.5] * 95 + [1.5] * 5), MET, ""),
        (time([0.5] * 95 + [1.5] * 5, limit_s=1.4), NOT_MET, ""),
        (time([2.0]), MET, ""),
        # a claim for a share needs its poses, a p95 its exact bound
        (time([1.0] * 58, rate=0.95), INCONCLUSIVE, ""),
        (time([1.0] * 59, rate=0.95), MET, ""),
        (time([2.1], rate=0.95), NOT_MET, ""),
        (p95([0.5] * 92 + [1.5], rate=0.95), MET, ""),
        (
            p95([0.5] * 91 + [1.5], rate=0.95),
            INCONCLUSIVE,
            "71 more poses without a further failure would show it for 95 %",
        ),
        (time([1.0] * 177, rate=0.95, poses=thirds(59)), MET, ""),
        (
            time([1.0] * 174, rate=0.95, poses=thirds(58)),
            INCONCLUSIVE,
            "over 174 detections is 1 s, limit 2 s; 58 of 58 poses in time",
        ),
        (time([1.0] * 6), MET, "6 of 6 poses in time, which shows 60.7 %"),
        (p95([]), NOT_MEASURED, ""),
        (false(0, scenes=59), MET, "at most 5.0 % of poses have one"),
        (false(1, scenes=59), NOT_MET, ""),
        (false(0, scenes=0), NOT_MEASURED, ""),
        # repeats of a pose do not narrow the bound: 1 - 0.05^(1/6)
        (
            false(0, scenes=18, per_pose=[0] * 6),
            MET,
            "0 in 18 scenes of 6 poses: in the long run at most 39.3 % of poses have one",
        ),
        (
            false(3, scenes=18, per_pose=[3, 0, 0, 0, 0, 0]),
            NOT_MET,
            "3 in 18 scenes of 6 poses, in 1 of the poses: in the long run at most 58.2 %",
        ),
        (bath(held=18, of=18), MET, ""),
        (bath(held=17, of=18), NOT_MET, ""),
        (bath(held=0, of=0), NOT_MEASURED, ""),
    ],
)
def test_each_outcome(decision: Decision, verdict: Verdict, says: str) -> None:
    assert decision.verdict is verdict
    assert says in decision.sentence


def test_the_figures_of_a_decision() -> None:
    d = rate95(Rate(24, 24))
    assert (d.measured, d.margin) == (100.0, 5.0)
    assert "95.0 %" not in rate95(Rate(58, 58)).sentence
    d = time([2.0])
    assert (d.measured, d.margin, d.unit) == (2.0, 0.0, "s")
    assert time([1.0] * 177, rate=0.95, poses=thirds(59)).n == 59
    d = false(0, scenes=18, per_pose=[0] * 6)
    assert (d.n, d.measured) == (6, 0.0)


@given(st.integers(1, 300).flatmap(lambda n: st.builds(Rate, st.integers(0, n), st.just(n))))
def test_a_rate_is_shown_exactly_where_the_margin_reaches_the_uncertainty(rate: Rate) -> None:
    d = rate95(rate)
    assert d.margin is not None
    assert d.uncertainty is not None
    assert (d.verdict is MET) == (d.margin >= d.uncertainty)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (partial(rate95, Rate(9, 9), required=1.0), "no number of trials shows 100 %"),
        (partial(p95, [1.0], rate=0.99), "a p95 says it of 95 %"),
        (partial(bath, held=3, of=2), "3 successes of 2"),
        (partial(error95, [1, 2, 3], poses=["a", "b"]), "2 names for 3 rows"),
        (partial(error95, [1.0, float("nan")]), "not finite"),
        (partial(guard_band_mm, -0.1), "uncertainty of the truth"),
        (partial(guard_band_mm, float("nan")), "uncertainty of the truth"),
        (partial(guard_band_mm, float("inf")), "uncertainty of the truth"),
        (partial(acceptance_limit_mm, 0.0, 0.23), "limit: 0"),
        (partial(normal_k, 1, 0.95), "at least 2"),
    ],
)
def test_what_makes_no_sense_is_refused(call: Callable[[], object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        call()


@given(st.lists(st.sampled_from(Verdict)))
def test_the_overall_verdict_is_the_worst(verdicts: list[Verdict]) -> None:
    worst = overall(verdicts)
    assert (worst is NOT_MET) == (NOT_MET in verdicts)
    assert (worst is MET) == (len(verdicts) > 0 and set(verdicts) == {MET})
    assert worst is not NOT_MEASURED


U, T = 0.23, 5.0


@pytest.mark.parametrize(
    ("decision", "verdict", "says"),
    [
        (error95([1.0] * 58 + [4.30]), MET, ""),
        (error95([1.0] * 57 + [4.30]), INCONCLUSIVE, ""),  # too few poses for the claim
        (error95([1.0] * 90 + [4.610]), MET, ""),
        (error95([1.0] * 89 + [4.610]), INCONCLUSIVE, ""),  # too few so near to the limit
        (
            error95([1.0] * 58 + [4.6]),
            INCONCLUSIVE,
            "needs 84 poses in one look, and one at 59 was taken: begin anew with 84 that no look",
        ),
        (error95([1.0] * 83 + [4.6]), MET, ""),
        (error95([1.0] * 499 + [4.612]), INCONCLUSIVE, ""),  # in the guard band
        (error95([1.0] * 58 + [5.377]), INCONCLUSIVE, ""),
        (error95([1.0] * 58 + [5.379]), NOT_MET, ""),
        (error95([5.379]), NOT_MET, ""),  # one is enough to refuse
        (error95([1.0] * 298 + [7.0, 8.0]), NOT_MET, ""),
        (error95([1.0] * 58), INCONCLUSIVE, ""),
        (error95([]), NOT_MEASURED, ""),
        # far from the limit the usual numbers are enough; of an exact truth up to it
        *((error95([3.0] * n, rate=rate), MET, "") for rate, n in ((0.95, 59), (0.99, 299))),
        *(
            (error95([3.0] * n, rate=rate), INCONCLUSIVE, "")
            for rate, n in ((0.95, 58), (0.99, 298))
        ),
        (error95([3.0] * 2995, rate=0.999), MET, ""),
        (error95([3.0] * 2994, rate=0.999), INCONCLUSIVE, ""),
        (error95([4.999] * 59, u_mm=0.0), MET, ""),
        # 58 poses of four teats
        (error95([1.0] * 232, poses=[k // 4 for k in range(232)]), INCONCLUSIVE, "1 more"),
        (error95([1.0] * 59, missed=7), MET, "Only found teats count here; 7 were missed."),
        # a truth too uncertain, or of unknown uncertainty, accepts nothing
        (error95([0.1] * 59, u_mm=1.8), INCONCLUSIVE, "too uncertain"),
        (error95([9.0] * 59, u_mm=1.8), NOT_MET, ""),
        (error95([0.1] * 59, u_mm=None), INCONCLUSIVE, "states no uncertainty"),
        (error95([9.0], u_mm=None), NOT_MET, ""),
        # a confidence beyond the guard band's needs more room
        (error95([4.6] * 400, confidence=0.99), INCONCLUSIVE, "however many poses"),
        (error95([4.0] * 90, confidence=0.99), MET, ""),
    ],
)
def test_each_outcome_of_an_error(decision: Decision, verdict: Verdict, says: str) -> None:
    assert decision.verdict is verdict
    assert says in decision.sentence


def test_the_decision_carries_what_a_report_prints() -> None:
    d = error95([1.0] * 58 + [3.0])
    assert (d.n, d.measured, d.unit, d.limit, d.margin) == (59, 3.0, "mm", 5.0, 2.0)
    assert d.accept == pytest.approx(4.611, abs=0.0005)
    assert d.uncertainty == pytest.approx(0.389, abs=0.0005)
    within = "within the acceptance limit of 4.611 mm; shown for 95 % of poses"
    shows = "59 of 59 poses within 3.00 mm show 95.0 %"
    assert d.sentence == f"The largest distance over 59 poses is 3.00 mm, {within}; {shows}."
    figures = "4.611, 5.378, T = 5 mm, u = 0.23 mm, 59 poses, 95 %, more near the acceptance limit"
    assert all(figure in d.rule for figure in figures.split(", "))
    assert d.verdict == "met"
    assert error95([1.0] * 232, poses=[k // 4 for k in range(232)]).n == 58
    nothing = error95([])
    assert nothing.n == 0
    assert nothing.measured is nothing.margin is nothing.uncertainty is None
    unknown = error95([0.1] * 59, u_mm=None)
    assert unknown.accept is None
    assert "accepted up to nothing" in unknown.rule
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


ARM = ArmTable(url="socket://127.0.0.1:1")
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
    ("detector", "n"),
    few([(just_over, 59), (spread, 59), (astray, 59), (biased, 59), (just_over, 91)], 2),
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
        [*seen[:20], *seen[met][:20]], [*met[:20], *met[met][:20]], strict=True
    ):
        assert (error95(row, u_mm=u).verdict is MET) == expected
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


def test_frozen_acceptance_limits() -> None:
    assert guard_band_mm(U) == pytest.approx(1.645 * U, abs=1e-4)
    assert axis_acceptance_limit_mm(T, U) == pytest.approx(4.622, abs=0.0005)
    assert axis_acceptance_limit_mm(T, T / 1.64) is None
    assert acceptance_limit_mm(T, U) == pytest.approx(4.611, abs=0.0005)
    assert refusal_limit_mm(T, U) == pytest.approx(5.378, abs=0.0005)
    assert acceptance_limit_mm(T, 0.0) == refusal_limit_mm(T, 0.0) == T
    assert acceptance_limit_mm(T, 1.8) is None


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


@given(
    st.integers(2, 500), st.sampled_from([0.9, 0.95, 0.99]), st.sampled_from([0.5, 0.9, 0.95, 0.99])
)
def test_the_normal_factor_against_scipy_stats(n: int, rate: float, confidence: float) -> None:
    referee = scipy.stats.nct.ppf(
        confidence, n - 1, scipy.stats.norm.ppf(rate) * np.sqrt(n)
    ) / np.sqrt(n)
    assert normal_k(n, rate, confidence) == pytest.approx(referee, rel=1e-6)


def test_the_largest_of_59_is_the_first_95_95_limit() -> None:
    assert quantile_bound(np.arange(58.0), 0.95) is None
    assert quantile_bound(np.arange(59.0), 0.95) == 58.0
    assert quantile_bound(np.arange(93.0), 0.95) == 91.0  # Wilks: from 93 on the second largest
    assert quantile_bound([], 0.95) is None


@pytest.mark.parametrize("failures", [0, 1])
def test_a_leak_of_next_to_nothing_leaves_the_exact_bound(failures: int) -> None:
    for n in range(failures + 1, 120):
        exact = shown_rate(failures, n)
        found = [shown_rate(failures, n, leak=leak) for leak in (2e-57, 1e-17)]
        assert found == pytest.approx([exact, exact], abs=1e-9)
