"""Paired comparison: exact McNemar, Tango's interval, the bootstrap over poses, sign flips and Holm, against scipy and statsmodels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.stats import binomtest, bootstrap, norm, permutation_test, ttest_rel
from statsmodels.stats.contingency_tables import mcnemar  # type: ignore[import-untyped]
from statsmodels.stats.multitest import multipletests  # type: ignore[import-untyped]

from bench.scoring.paired import FEW, MANY, Discordance, discordance, holm, paired_difference, pose_differences, sign_flip_p

COUNTS = st.builds(Discordance, *[st.integers(0, 30)] * 4)


def test_six_scenes_all_one_way_are_needed() -> None:
    assert Discordance(both=18, only_old=6).p_value == pytest.approx(0.03125)
    assert Discordance(both=18, only_old=5).p_value == pytest.approx(0.0625)
    assert Discordance(both=24).p_value == 1.0


@given(COUNTS)
def test_mcnemar_against_statsmodels_and_the_binomial_test(d: Discordance) -> None:
    table = [[d.both, d.only_old], [d.only_new, d.neither]]
    assert d.p_value == pytest.approx(float(mcnemar(table, exact=True).pvalue), rel=1e-9)
    if d.only_old + d.only_new:
        assert d.p_value == pytest.approx(binomtest(d.only_old, d.only_old + d.only_new).pvalue, rel=1e-9)


def test_the_interval_of_a_published_table() -> None:
    # Bentur et al. 2009, 21 pairs with discordant 1 and 7, in Fagerland, Lydersen and Laake, Statistics in Medicine 33 (2014)
    span = Discordance(both=1, only_old=7, only_new=1, neither=12).interval()
    assert span == pytest.approx((-0.517, -0.026), abs=5e-4)


@settings(max_examples=60)
@given(COUNTS)
def test_the_interval_holds_what_the_score_test_does_not_refuse(d: Discordance) -> None:
    span = d.interval(0.95)
    if span is None:
        assert d.n == 0
        return
    estimate = d.difference
    assert estimate is not None
    assert -1.0 <= span[0] <= estimate <= span[1] <= 1.0
    for bound in span:
        if abs(bound) < 1.0 - 1e-6:
            assert score_statistic(d, bound) == pytest.approx(norm.ppf(0.975), abs=2e-3)


def score_statistic(d: Discordance, difference: float) -> float:
    """|z| of Tango's test with its nuisance found by search: q maximises the likelihood of the counts under `difference`."""
    b, c, rest = d.only_new, d.only_old, d.both + d.neither

    def unlikely(q: float) -> float:
        shares = np.array([q + difference, q, 1.0 - 2.0 * q - difference])
        return -float(np.sum(np.array([b, c, rest]) * np.log(np.maximum(shares, 1e-300))))

    low, high = max(0.0, -difference), (1.0 - difference) / 2.0
    q = minimize_scalar(unlikely, bounds=(low, high), method="bounded", options={"xatol": 1e-10}).x
    return abs(b - c - d.n * difference) / float(np.sqrt(d.n * (2.0 * q + difference * (1.0 - difference))))


@given(COUNTS)
def test_the_interval_turns_round_with_the_order(d: Discordance) -> None:
    turned = Discordance(d.both, d.only_new, d.only_old, d.neither)
    one, other = d.interval(), turned.interval()
    if one is not None and other is not None:
        assert one == pytest.approx((-other[1], -other[0]), abs=1e-8)


def test_no_discordant_scene_still_leaves_room() -> None:
    span = Discordance(both=24).interval()
    assert span is not None
    assert span[1] == pytest.approx(3.8415 / (24 + 3.8415), abs=1e-4)  # z^2 / (n + z^2), Tango 1998, equation 12 with b = c = 0


def test_who_succeeded_is_counted_and_adds() -> None:
    d = discordance([True, True, False, False], [True, False, True, False])
    assert d == Discordance(1, 1, 1, 1)
    assert d + d == Discordance(2, 2, 2, 2)
    assert (Discordance().difference, Discordance().interval()) == (None, None)
    with pytest.raises(ValueError, match="3 old and 2 new"):
        discordance([True] * 3, [True] * 2)


def test_the_interval_is_scipys_paired_bootstrap() -> None:
    rng = np.random.default_rng(1)
    old = rng.gamma(2.0, 0.5, 25)
    new = old + rng.normal(0.1, 0.3, 25)
    mine = paired_difference(old, new, seed=7)
    theirs = bootstrap(
        (old, new), lambda a, b, axis: np.mean(b - a, axis=axis), paired=True, vectorized=True, rng=np.random.default_rng(7)
    ).confidence_interval
    assert (mine.low, mine.high) == pytest.approx((theirs.low, theirs.high), abs=0.006)
    assert mine.mean == pytest.approx(float(np.mean(new - old)))
    assert paired_difference(old, new, seed=7) == mine


def test_the_interval_covers_as_often_as_it_claims() -> None:
    rng = np.random.default_rng(2)
    held = 0
    for _ in range(300):
        found = paired_difference(np.zeros(30), rng.normal(0.2, 1.0, 30), resamples=999)
        assert found.low is not None
        assert found.high is not None
        held += found.low <= 0.2 <= found.high
    assert 0.89 < held / 300 < 0.985  # BCa of 30 values covers about 94 %


@pytest.mark.parametrize("n", [3, 5, FEW - 1])
def test_few_poses_cover_as_often_as_they_claim(n: int) -> None:
    draws = np.random.default_rng(n).normal(0.2, 1.0, (400, n))
    spans = [paired_difference(np.zeros(n), row) for row in draws]
    held = [span.low is not None and span.high is not None and span.low <= 0.2 <= span.high for span in spans]
    assert float(np.mean(held)) == pytest.approx(0.95, abs=0.035)


def test_poses_are_resampled_not_rows() -> None:
    rng = np.random.default_rng(3)
    pose_wise = rng.normal(0.0, 1.0, 12)
    rows, poses = np.repeat(pose_wise, 50), np.repeat(np.arange(12), 50).tolist()
    by_pose, by_row = paired_difference(np.zeros(600), rows, poses), paired_difference(np.zeros(600), rows)
    assert by_pose.poses == 12
    assert by_pose.high is not None
    assert by_pose.low is not None
    assert by_row.high is not None
    assert by_row.low is not None
    assert by_pose.high - by_pose.low > 4 * (by_row.high - by_row.low)  # 600 rows taken for independent would be 7 times too sure


def test_many_poses_are_students() -> None:
    rng = np.random.default_rng(4)
    old = rng.random(MANY + 1)
    new = old + rng.normal(0.01, 0.1, MANY + 1)
    found, test = paired_difference(old, new), ttest_rel(new, old)
    span = test.confidence_interval()
    assert (found.low, found.high, found.p_value) == pytest.approx((span.low, span.high, test.pvalue))


@given(st.lists(st.integers(-5000, 5000).filter(bool).map(lambda k: k / 1024), min_size=2, max_size=10))
def test_sign_flips_against_scipy(values: list[float]) -> None:
    """Sums of 1024ths are exact, so that both see the same ties: theirs takes two that rounding keeps apart for different."""
    theirs = permutation_test((np.array(values),), np.sum, permutation_type="samples", n_resamples=np.inf).pvalue
    assert sign_flip_p(np.array(values)) == pytest.approx(float(theirs), abs=1e-9)


def test_many_signs_are_drawn() -> None:
    values = np.random.default_rng(5).normal(0.3, 1.0, 40)
    assert sign_flip_p(values, seed=1) == pytest.approx(ttest_rel(values, np.zeros(40)).pvalue, abs=0.02)
    assert sign_flip_p(np.zeros(40)) == 1.0


def test_what_cannot_be_said() -> None:
    nothing, one, alike = paired_difference([], []), paired_difference([1.0], [1.5]), paired_difference([1.0, 2.0], [1.5, 2.5])
    assert (nothing.poses, nothing.mean, nothing.p_value) == (0, None, None)
    assert (one.poses, one.mean, one.low) == (1, 0.5, None)
    assert (alike.low, alike.high) == (0.5, 0.5)
    with pytest.raises(ValueError, match="2 old and 1 new"):
        paired_difference([1.0, 2.0], [1.0])
    with pytest.raises(ValueError, match="1 pose names"):
        pose_differences([1.0, 2.0], [1.0, 2.0], ["a"])


@pytest.mark.parametrize("n", [1, 2, 5, 12])
def test_holm_against_statsmodels(n: int) -> None:
    p_values = np.random.default_rng(n).random(n) ** 2
    assert holm(p_values.tolist()) == pytest.approx(tuple(multipletests(p_values, method="holm")[1]))


def test_holm_by_hand() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx((0.03, 0.06, 0.06))
    assert holm([]) == ()
    with pytest.raises(ValueError, match="not between 0 and 1"):
        holm([1.2])
