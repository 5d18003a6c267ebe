"""The requirement `arm_verified`: a table of what a run may know of its arm, and what is said."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2, f

from bench.results.stated_arm import STATED_FACT, contradictions, stated_fact, too_small
from bench.results.verdicts import decide_arm
from bench.rig.arm_files import LengthTest, LocationTest, Verification, as_dict
from bench.rig.model import ROUNDING_MM, ArmTable
from bench.scoring.decisions import Verdict
from bench.scoring.guard_band import acceptance_limit_mm, leak
from bench.scoring.stated_u import StatedCheck, largest_limit_mm
from bench.script.model import ArmRequirement, find_script, load_script
from tests.bench.calibrate.test_arm_dialogues import CROSS, SWUNG

RULE = ArmRequirement(
    kind="arm_verified",
    name="arm",
    location_limit_mm=0.46,
    shift_limit_mm=1.5,
    drift_limit_mm=0.5,
    length_limit_mm=0.7,
    max_age_days=180,
)
PLACE = np.array([-190.0, 120.0, 15.0])
STARTED = datetime(2026, 6, 1, tzinfo=UTC)


def check(
    scale: float = 1.0, shift_mm: float = 0.0, axes: np.ndarray = SWUNG, n: int = 5
) -> dict[str, Any]:
    """Touches whose largest deviation is 0.3 mm times ``scale``."""
    tips = scale * CROSS + PLACE + [0.0, 0.0, shift_mm]
    of = zip(tips[:n].tolist(), axes.tolist(), strict=False)
    touches = [{"tip_mm": tip, "axis": axis} for tip, axis in of]
    return {"check_point_mm": PLACE.tolist(), "touches": touches}


def one_more(off_mm: float, before: dict[str, Any]) -> dict[str, Any]:
    """The check afterwards, of one new touch."""
    touch = {"tip_mm": (PLACE + np.array([0.0, 0.0, off_mm])).tolist(), "axis": SWUNG[0].tolist()}
    return before | {"touches": [*before["touches"], touch], "new": 1}


def dated(
    days: float = 10.0,
    scale: float = 1.0,
    error_mm: float = 0.1,
    serial: str = "40937",
    lengths: bool = True,
) -> dict[str, Any]:
    length = LengthTest("upright", np.zeros(3), np.array([0.0, 0.0, 300.0 + error_mm]), 300.0)
    locations = (LocationTest("near", scale * CROSS, SWUNG),)
    made = STARTED - timedelta(days=days)
    return as_dict(Verification(made, serial, locations, (length,) if lengths else ()))


def facts(
    before: Any = None, after: Any = None, verification: Any = None, **more: Any
) -> dict[str, Any]:
    found = {"arm check before": before, "arm check after": after, "arm verification": verification}
    found |= more
    head = {"wall_started": STARTED.isoformat(), "identities": {"arm": {"serial_number": "40937"}}}
    return head | {key: value for key, value in found.items() if value is not None}


GOOD, WORSE = check(), check(1.6)
MET, NOT_MET, OPEN = Verdict.MET, Verdict.NOT_MET, Verdict.INCONCLUSIVE
CASES: list[tuple[dict[str, Any], Verdict, str]] = [
    (facts(GOOD, GOOD), OPEN, "names no dated verification with a length check"),
    (facts(GOOD, GOOD, kind="emulated"), MET, "0.30 mm before and 0.30 mm after; no dated"),
    (facts(GOOD, GOOD, dated()), MET, "verified on 2026-05-22"),
    (facts(), Verdict.NOT_MEASURED, "neither a check point nor a verification"),
    (facts(GOOD), OPEN, "not checked after the trials"),
    (facts(verification=dated()), OPEN, "before the trials; the arm was not checked after"),
    (facts(WORSE, GOOD), NOT_MET, "before the trials: readings of one point lie up to 0.48 mm"),
    (facts(GOOD, WORSE), NOT_MET, "the check after the trials"),
    (facts(check(1.5), GOOD, dated()), MET, "0.45 mm before"),
    (facts(*[check(shift_mm=1.6)] * 2), NOT_MET, "1.60 mm from its place before the trials"),
    (facts(GOOD, check(shift_mm=0.6)), NOT_MET, "moved by 0.60 mm during the run"),
    (facts(GOOD, check(shift_mm=0.4), dated()), MET, ""),
    (facts(check(axes=np.repeat(SWUNG[:1], 5, axis=0)), GOOD), OPEN, "swung by 0 degrees only"),
    (facts(check(n=4), GOOD), OPEN, "4 touches only"),
    (facts(GOOD, GOOD, dated(181)), NOT_MET, "181 days old, limit 180 days"),
    (facts(GOOD, GOOD, dated(179)), MET, ""),
    (facts(GOOD, GOOD, dated(-1)), NOT_MET, "look at the computer's clock"),
    (facts(GOOD, GOOD, dated(serial="1234")), NOT_MET, "of the arm 1234, but the run used 40937"),
    (facts(GOOD, GOOD, dated(scale=1.6)), NOT_MET, "in the dated verification, near"),
    (facts(GOOD, GOOD, dated(error_mm=-0.8)), NOT_MET, "300 mm were measured -0.80 mm wrong"),
    (facts(GOOD, GOOD, dated(lengths=False)), OPEN, "no calibrated length was measured"),
    (facts(WORSE), NOT_MET, "0.48 mm"),
    (facts(GOOD, one_more(0.4, GOOD), dated()), MET, "0.30 mm before"),
    (facts(GOOD, one_more(0.6, GOOD), dated()), NOT_MET, "moved by 0.60 mm during the run"),
]


@pytest.mark.parametrize(("known", "verdict", "says"), CASES)
def test_each_case(known: dict[str, Any], verdict: Verdict, says: str) -> None:
    decision = decide_arm(RULE, known)
    assert decision.verdict is verdict, decision.sentence
    assert says.lower() in decision.sentence.lower()
    before, last = decision.sentence[-2:-1], decision.sentence[-1:]
    assert last in ".?"
    assert before not in ".?"


def test_a_script_may_go_without_the_dated_verification_or_its_length() -> None:
    unlimited = RULE.model_copy(update={"length_limit_mm": None})
    assert decide_arm(unlimited, facts(GOOD, GOOD, dated(lengths=False))).verdict is OPEN
    assert decide_arm(unlimited, facts(GOOD, GOOD, dated())).verdict is MET
    lenient = unlimited.model_copy(update={"dated_required": False})
    assert decide_arm(lenient, facts(GOOD, GOOD)).verdict is MET
    assert decide_arm(lenient, facts(GOOD, GOOD, dated(lengths=False))).verdict is MET
    assert ("length" in decide_arm(lenient, facts()).rule) is False


def test_the_worst_figure_is_shown_against_its_limit() -> None:
    d = decide_arm(RULE, facts(check(), check(1.2), dated(scale=1.4)))
    assert (d.n, d.limit, d.unit) == (15, 0.46, "mm")
    assert (d.measured, d.margin) == pytest.approx((0.42, 0.04))


def test_the_shipped_script_asks_for_it() -> None:
    asked = load_script(find_script(None)).script.requirements
    (rule,) = (rule for rule in asked if isinstance(rule, ArmRequirement))
    limits = rule.location_limit_mm, rule.drift_limit_mm, rule.length_limit_mm
    assert (*limits, rule.dated_required) == (None, None, None, True)


# The stated uncertainty against the touches: numbers drawn, no arm and no picture


def stated(u_mm: float = 0.23, df: float | None = None) -> dict[str, Any]:
    return stated_fact(ArmTable.model_construct(url="", accuracy_mm=u_mm, accuracy_df=df))


def drawn(chance: np.random.Generator, times: float, lengths: bool) -> dict[str, Any]:
    """A run of 30 touches by an arm of ``times`` its stated u, along each axis; with ``lengths`` a
    verification of ten touches and seven lengths.
    """
    sd_mm = np.hypot(0.23 * times, ROUNDING_MM)
    axes = np.tile(SWUNG, (3, 1)).tolist()
    each = [PLACE + chance.normal(0.0, sd_mm, (15, 3)) for _ in range(2)]
    before, after = (
        {
            "check_point_mm": PLACE.tolist(),
            "touches": [{"tip_mm": t, "axis": a} for t, a in zip(tips.tolist(), axes, strict=True)],
        }
        for tips in each
    )
    ends = chance.normal(0.0, sd_mm, (7, 2, 3)) + np.array([[0.0, 0.0, 0.0], [300.0, 0.0, 0.0]])
    found = Verification(
        STARTED,
        "40937",
        (LocationTest("near", chance.normal(0.0, sd_mm, (10, 3)), np.tile(SWUNG, (2, 1))),),
        tuple(LengthTest("flat", a, b, 300.0) for a, b in ends),
    )
    more = {"verification": as_dict(found)} if lengths else {}
    return facts(before, after, **more) | {STATED_FACT: stated()}


@pytest.mark.slow
@pytest.mark.parametrize("lengths", [False, True])
def test_an_arm_at_twice_its_stated_u_is_caught_and_a_sound_one_rarely_accused(
    lengths: bool,
) -> None:
    chance, runs = np.random.default_rng(20), 400
    accused = {
        times: sum(bool(too_small(drawn(chance, times, lengths))) for _ in range(runs)) / runs
        for times in (1.0, 2.0)
    }
    assert accused[2.0] >= 0.95
    assert accused[1.0] <= 0.05 + 2.0 * np.sqrt(0.05 * 0.95 / runs), "5 %, as far as 400 runs tell"


def test_what_the_touches_show_is_against_the_arm_and_named() -> None:
    wide = facts(GOOD, GOOD, kind="emulated") | {STATED_FACT: stated(0.05)}
    decision = decide_arm(RULE, wide)
    assert decision.verdict is NOT_MET
    assert "differ as those of an arm of u = 0.08 mm do; stated are 0.05 mm" in decision.sentence
    assert decide_arm(RULE, wide | {STATED_FACT: stated()}).verdict is MET


def test_a_statement_of_few_degrees_of_freedom_is_held_less_firmly() -> None:
    """Against chi-square and Fisher's F of scipy's distributions."""
    exact, vague = StatedCheck("", 30.0, 12), StatedCheck("", 30.0, 12, 5.0)
    assert exact.p_value == pytest.approx(chi2.sf(30.0, 12))
    assert vague.p_value == pytest.approx(f.sf(30.0 / 12, 12, 5.0))
    assert exact.limit(0.05) == pytest.approx(chi2.isf(0.05, 12))
    assert vague.limit(0.05) == pytest.approx(12 * f.isf(0.05, 12, 5.0))
    low, high = exact.ratio_interval
    assert (low, high) == pytest.approx(np.sqrt(30.0 / chi2.ppf([0.975, 0.025], 12)))
    assert ArmTable.model_construct(url="", accuracy_mm=0.2, accuracy_df=8.0).u_mm == pytest.approx(
        0.2 * np.sqrt(8 / 6)
    )


def test_half_of_the_real_u_lets_a_sixth_of_false_acceptances_through() -> None:
    """The figure that the report names: accepted by the guard band of half of the real u."""
    assert leak(float(acceptance_limit_mm(5.0, 0.115) or 0.0), 5.0, 0.23) == pytest.approx(
        0.18, abs=0.03
    )


FOLLOWS = RULE.model_copy(
    update={"location_limit_mm": None, "drift_limit_mm": None, "length_limit_mm": None}
)


@pytest.mark.slow
def test_limits_that_follow_from_the_statement_refuse_a_sound_arm_seldom() -> None:
    rng, refused = np.random.default_rng(1), {"follow": 0, "told": 0}
    runs = 250
    for _ in range(runs):
        known = drawn(rng, 1.0, lengths=True)
        refused["follow"] += decide_arm(FOLLOWS, known).verdict is NOT_MET
        refused["told"] += decide_arm(RULE, known).verdict is NOT_MET
    assert refused["follow"] / runs <= 0.06
    assert refused["told"] / runs > 0.95


def test_a_limit_that_contradicts_the_statement_is_told_with_its_chance() -> None:
    rng = np.random.default_rng(2)
    (text,) = contradictions(RULE, stated(), (5, 5), None)
    assert "location_limit_mm = 0.46 mm contradicts" in text
    chance = float(re.findall(r"in (\d+) % of runs", text)[0]) / 100.0
    seen = [
        max(
            np.linalg.norm(tips - tips.mean(axis=0), axis=1).max()
            for tips in rng.normal(0.0, np.hypot(0.23, ROUNDING_MM), (2, 5, 3))
        )
        > 0.46
        for _ in range(4000)
    ]
    assert chance == pytest.approx(np.mean(seen), abs=0.03)
    assert [*contradictions(FOLLOWS, stated(), (5, 5), None)] == []
    fine = RULE.model_copy(update={"location_limit_mm": 1.5})
    assert [*contradictions(fine, stated(), (5, 5), None)] == []
    known = facts(check(5.0), GOOD, dated()) | {STATED_FACT: stated()}
    assert "contradicts the arm's stated accuracy" in decide_arm(RULE, known).sentence


@pytest.mark.slow
@pytest.mark.parametrize("df", [None, 12.0])
def test_the_largest_of_n_distances_exceeds_its_limit_as_often_as_is_claimed(
    df: float | None,
) -> None:
    rng, draws = np.random.default_rng(3), 40_000
    u = np.ones(draws) if df is None else np.sqrt(df / rng.chisquare(df, draws))
    for n in (5, 10):
        tips = u[:, None, None] * rng.normal(size=(draws, n, 3))
        far = np.linalg.norm(tips - tips.mean(axis=1, keepdims=True), axis=2).max(axis=1)
        beyond = float(np.mean(far > largest_limit_mm(1.0, [n], df, 0.05)))
        assert beyond <= 0.055
        assert df is not None or beyond == pytest.approx(0.05, abs=0.005)
