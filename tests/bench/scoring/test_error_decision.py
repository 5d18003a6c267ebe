"""The decision on the error: its three outcomes, how many poses it asks for, and how often it
accepts what it must not.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import ncx2  # type: ignore[attr-defined, unused-ignore]  # re-exported by a star import

from bench.rig.model import Arm
from bench.scoring.decisions import Verdict, decide_error, worst_per_pose
from bench.scoring.errors import Floats
from bench.scoring.guard_band import acceptance_limit_mm, leak
from bench.scoring.rates import guarded_n, shown_falsely
from bench.truth.uncertainty import end_u_mm, reading_u_mm
from instruments.microscribe.mechanics import KinematicError, workspace
from instruments.microscribe.unit import shipped_unit

MET, NOT_MET, INCONCLUSIVE, NOT_MEASURED = Verdict
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
    assert (
        d.sentence
        == "The largest distance over 59 poses is 3.00 mm, within the acceptance limit of 4.611 mm;"
        " shown for 95 % of poses."
    )
    for figure in (
        "4.611",
        "5.378",
        "T = 5 mm",
        "u = 0.23 mm",
        "59 poses",
        "95 %",
        "more near the acceptance limit",
    ):
        assert figure in d.rule
    assert d.as_dict()["verdict"] == "met"


def test_near_the_limit_it_says_how_many_more() -> None:
    sentence = error([1.0] * 58 + [4.6]).sentence
    assert "needs 25 more (59 do where the largest lies further from it)" in sentence
    assert error([1.0] * 83 + [4.6]).verdict is MET


def test_what_was_missed_is_told_beside_the_errors_of_the_rest() -> None:
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


def test_the_quantile_forgives_what_the_largest_does_not() -> None:
    errors = [1.0] * 298 + [7.0, 8.0]
    assert error(errors).verdict is NOT_MET
    assert error(errors, statistic="quantile").verdict is MET
    assert error([7.0] * 60, statistic="quantile").verdict is NOT_MET
    assert error([1.0] * 58, statistic="quantile").verdict is INCONCLUSIVE


def test_nothing_measured_has_no_figures() -> None:
    d = error([])
    assert (d.n, d.measured, d.margin, d.uncertainty, d.verdict) == (
        0,
        None,
        None,
        None,
        NOT_MEASURED,
    )


def test_bad_rows() -> None:
    with pytest.raises(ValueError, match="2 names for 3 values"):
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
        return good + (1.0 - good) * float(ncx2.cdf((at / u) ** 2, 3, (5.0 / u) ** 2)) - 0.05

    return accept if risk(accept) <= 0.0 else float(brentq(risk, 1.0, accept))


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
            float(ncx2.cdf((share * accept / u) ** 2, 3, (5.0 / u) ** 2)), rel=1e-6, abs=1e-12
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
