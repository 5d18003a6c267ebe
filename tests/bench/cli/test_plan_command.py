"""`teatbench plan`: what it says of claims, of the poses that there are, and of what makes no
sense.
"""

from __future__ import annotations

import json

import pytest

from bench.scoring.decisions import decide_error
from bench.scoring.sample_size import make_plan
from tests.bench.commands import Said

SHOWN = {
    "--rate 0.99 --confidence 0.95": (
        "A rate of 99 % with 95 % confidence: 299 poses without a failure (473 with 1",
        "at least 6 must be lost",
    ),
    "": tuple(f": {n} poses without a failure" for n in (59, 299, 2995)),
    "--trials 24 --rate 0.95 --sd-mm 1.5": (
        "24 poses without a failure show 88.3 % with 95 % confidence.",
        "95 %: can't be shown; 35 more are needed.",
        "a loss of 30.9 % of poses shows with a chance of 80 %",
        "A difference of 0.896 mm in mean distance",  # TTestPower of statsmodels: 0.8958
    ),
    # repeats of a pose count once
    "--script six-situations": ("6 poses without a failure show 60.7 %",),
    "--limit-mm 5 --u-mm 0.23 --rate 0.95": (
        "u = 0.23 mm along an axis: accepted up to 4.611 mm; near that limit more poses are needed:",
        "95 %: 59 poses show it where the largest is at most 4.332 mm; 91 up to the acceptance limit.",
    ),
    "--limit-mm 5 --u-mm 0.23 --trials 70": (
        "70 poses show it where the largest is at most 4.552 mm",
    ),
    "--limit-mm 5 --u-mm 0.23 --confidence 0.99": ("no number up to the acceptance limit",),
    "--limit-mm 5 --u-mm 2.5": ("the truth is too uncertain",),
    "--limit-mm 5 --u-mm 0.23 --trials 10": ("10 poses don't show it",),
    # what is just missed is not rounded away
    "--trials 58 --rate 0.95": (
        "58 poses without a failure show 94.97 %",
        "95 %: can't be shown; 1 more is needed.",
    ),
    "--trials 1": ("1 pose without a failure shows 5.0 %",),
}


@pytest.mark.parametrize("options", SHOWN)
def test_what_a_plan_says(options: str, said: Said) -> None:
    note = said(0, f"plan {options}").out
    assert [text for text in SHOWN[options] if text not in note] == []


@pytest.mark.parametrize(
    ("n", "largest", "verdict"),
    [
        (59, 4.332, "met"),
        (59, 4.334, "inconclusive"),
        (91, 4.610, "met"),
        (90, 4.610, "inconclusive"),
    ],
)
def test_a_decision_agrees_with_what_a_plan_says(n: int, largest: float, verdict: str) -> None:
    found = decide_error(
        "error", [largest] * n, limit_mm=5.0, u_mm=0.23, rate=0.95, confidence=0.95
    )
    assert found.verdict.value == verdict


@pytest.mark.slow
def test_for_programs(said: Said) -> None:
    note = json.loads(
        said(0, "plan --trials 93 --rate 0.95 --true-rate 0.99 --sd-mm 1 --shift-mm 0.5 --json").out
    )
    chance = pytest.approx(0.99**93 + 93 * 0.01 * 0.99**92)
    (claim,) = note["claims"]
    assert claim == {
        "rate": 0.95,
        "poses_needed": [59, 93, 124, 153],
        "failures_allowed": 1,
        "chance": chance,
        "at_the_edge": None,
        "error_shown_mm": None,
    }
    assert note["poses_for_shift"] == 34


def test_no_pose_shows_nothing() -> None:
    assert make_plan([0.95], 0.95, poses=0).rate_shown is None
