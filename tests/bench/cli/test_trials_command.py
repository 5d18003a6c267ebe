"""`trials`: what ships, what a script comes to and takes; `plan`: what poses can show."""

from __future__ import annotations

import json
from dataclasses import replace
from unittest.mock import patch

import pytest

from bench.config import read_config
from bench.rig.loading import find_rig, load_rig
from bench.run.estimate import ASSUMED, estimate, move_s
from bench.scoring.decisions import decide_error
from bench.scoring.sample_size import plan_poses
from bench.script.model import find_script, load_script
from tests.bench.commands import Said


@pytest.mark.slow
def test_show_lists_every_trial_and_the_time(said: Said) -> None:
    seen = said(0, "trials show plane-map").out
    assert "156 trials, 156 poses" in seen
    assert "156-plane-156-1" in seen
    assert "a grid of 13 x 12 poses" in seen
    assert "settling 36 min" in seen


def test_show_cuts_no_name(monkeypatch: pytest.MonkeyPatch, said: Said) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    seen = said(0, "trials show six-situations").out
    for name in ("001-non-vertical-1", "spurious", "overlapping", "table-5-1"):
        assert name in seen
    assert "…" not in seen
    assert "0 in all trials: x, y, z, yaw" in seen


def test_show_as_json(said: Said) -> None:
    with patch("bench.rig.loading.read_config", wraps=read_config) as read:
        text = json.loads(said(0, "trials show repeatability --json").out)
    assert sum(call.args[0] == find_rig("emulated") for call in read.call_args_list) == 1
    assert len(text["trials"]) == 150
    place = {"x_mm": 104.0, "y_mm": 96.0, "z_mm": 0.0, "yaw_deg": 0.0, "from": None}
    assert text["trials"][1] == {"id": "002-p-2-1", "pose": "p-2", "repeat": 1, **place}
    parts = {key: value for key, value in text["estimate"].items() if key != "total_s"}
    assert text["estimate"]["total_s"] == pytest.approx(sum(parts.values()))
    assert text["assumed"]["touch [s]"] == ASSUMED["touch"]


def test_moves_by_hand() -> None:
    """25 mm at 25 mm/s and 200 mm/s^2: 1 s, and 1/8 s for starting and braking."""
    assert move_s(25.0, 1500.0, 200.0) == pytest.approx(1.125)
    assert move_s(2.0, 1500.0, 200.0) == pytest.approx(0.2), "too short to come to speed"
    assert move_s(0.0, 1500.0, 200.0) == 0.0


def test_the_time_by_hand() -> None:
    rig, script = load_rig(find_rig(None)), load_script(find_script(None))
    time = estimate(rig, script)
    assert time.settling_s == pytest.approx(600.0 + 13.0 / 0.5 * 60.0)  # from 20 to 33 degC
    assert time.captures_s == pytest.approx(18 * 2.0)
    assert time.touches_s == pytest.approx(18 * 4 * 3 * 8.0)
    assert time.set_ups_s == pytest.approx(6 * 60.0)
    assert time.moves_s == pytest.approx(60.0)


def test_without_a_stage_each_pose_is_a_persons() -> None:
    rig, script = load_rig(find_rig(None)), load_script(find_script("plane-map"))
    by_hand = estimate(replace(rig, rig=rig.rig.model_copy(update={"stage": None})), script)
    assert by_hand.moves_s == 0.0
    assert by_hand.set_ups_s == pytest.approx(60.0 + 155 * 30.0)
    assert by_hand.total_s > estimate(rig, script).total_s


SHOWN = {
    "--rate 0.99 --confidence 0.95": (
        "A rate of 99 % with 95 % confidence (one-sided): 299 poses without a failure (473 with 1",
        "at least 6 must be lost",
    ),
    "": tuple(f": {n} poses without a failure" for n in (59, 299, 2995)),
    "--trials 24 --rate 0.95 --sd-mm 1.5": (
        "24 poses without a failure show 88.3 % with 95 % confidence (one-sided).",
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
    assert plan_poses([0.95], 0.95, poses=0).rate_shown is None
