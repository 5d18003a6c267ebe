"""`teatbench plan`: what it says of claims, of the poses that there are, and of what makes no
sense.
"""

from __future__ import annotations

import json

import pytest

from bench.scoring.decisions import decide_error
from bench.scoring.sample_size import make_plan
from tests.bench.commands import Said


def test_how_many_poses_a_claim_needs(said: Said) -> None:
    told = said(0, "plan --rate 0.99 --confidence 0.95").out
    assert "A rate of 99 % with 95 % confidence: 299 poses without a failure (473 with 1" in told
    assert "at least 6 must be lost" in told


def test_without_arguments_the_usual_rates(said: Said) -> None:
    told = said(0, "plan").out
    assert all(f": {n} poses without a failure" in told for n in (59, 299, 2995))


def test_what_the_poses_that_there_are_can_show(said: Said) -> None:
    told = said(0, "plan --trials 24 --rate 0.95 --sd-mm 1.5").out
    assert "24 poses without a failure show 88.3 % with 95 % confidence." in told
    assert "95 %: can't be shown; 35 more are needed." in told
    assert "a loss of 30.9 % of poses shows with a chance of 80 %" in told
    assert "A difference of 0.896 mm in mean distance" in told  # TTestPower of statsmodels: 0.8958


def test_a_scripts_poses_count_once_however_often_they_are_repeated(said: Said) -> None:
    assert "6 poses without a failure show 60.7 %" in said(0, "plan --script six-situations").out


def test_how_near_to_its_limit_the_largest_error_may_lie(said: Said) -> None:
    told = said(0, "plan --limit-mm 5 --u-mm 0.23 --rate 0.95").out
    assert (
        "u = 0.23 mm along an axis: accepted up to 4.611 mm; near that limit more poses are needed:"
        in told
    )
    assert (
        "95 %: 59 poses show it where the largest is at most 4.332 mm; 91 up to the acceptance"
        " limit." in told
    )
    for n, largest, verdict in (
        (59, 4.332, "met"),
        (59, 4.334, "inconclusive"),
        (91, 4.610, "met"),
        (90, 4.610, "inconclusive"),
    ):
        decision = decide_error(
            "error", [largest] * n, limit_mm=5.0, u_mm=0.23, rate=0.95, confidence=0.95
        )
        assert decision.verdict.value == verdict
    shown = said(0, "plan --limit-mm 5 --u-mm 0.23 --trials 70").out
    assert "70 poses show it where the largest is at most 4.552 mm" in shown
    shown = said(0, "plan --limit-mm 5 --u-mm 0.23 --confidence 0.99").out
    assert "no number up to the acceptance limit" in shown
    assert "the truth is too uncertain" in said(0, "plan --limit-mm 5 --u-mm 2.5").out
    assert "10 poses don't show it" in said(0, "plan --limit-mm 5 --u-mm 0.23 --trials 10").out


def test_what_is_just_missed_is_not_rounded_away(said: Said) -> None:
    told = said(0, "plan --trials 58 --rate 0.95").out
    assert "58 poses without a failure show 94.97 %" in told
    assert "95 %: can't be shown; 1 more is needed." in told
    assert "1 pose without a failure shows 5.0 %" in said(0, "plan --trials 1").out


@pytest.mark.slow
def test_for_programs(said: Said) -> None:
    told = json.loads(
        said(0, "plan --trials 93 --rate 0.95 --true-rate 0.99 --sd-mm 1 --shift-mm 0.5 --json").out
    )
    chance = pytest.approx(0.99**93 + 93 * 0.01 * 0.99**92)
    (claim,) = told["claims"]
    assert claim == {
        "rate": 0.95,
        "poses_needed": [59, 93, 124, 153],
        "failures_allowed": 1,
        "chance": chance,
        "at_the_edge": None,
        "error_shown_mm": None,
    }
    assert told["poses_for_shift"] == 34


def test_no_pose_shows_nothing() -> None:
    assert make_plan([0.95], 0.95, poses=0).rate_shown is None
