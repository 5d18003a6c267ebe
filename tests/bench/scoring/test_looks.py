"""Looks that are taken again and again at growing data: how often they decide falsely."""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.special import bdtr

from bench.scoring.comparison import ScenePair, compare
from bench.scoring.decisions import Decision, Verdict, decide_error, decide_rate, decide_time
from bench.scoring.looks import FIRST, Looks, RateTest, spent_on
from bench.scoring.rates import Rate, zero_failure_n
from bench.scoring.scene import score_scene
from bench.scoring.sequential import confidence_sequence, least_mean, least_rate

MET, NOT_MET, INCONCLUSIVE = Verdict.MET, Verdict.NOT_MET, Verdict.INCONCLUSIVE
LOOKS = 10
SERIES, FEW = 20_000, 1000
SLACK = 4.0  # standard deviations of what so few series show, where they are few
WEEKLY = (pytest.mark.weekly, pytest.mark.timeout(7200))
counts = pytest.mark.parametrize(
    "series", [pytest.param(FEW, marks=pytest.mark.slow), pytest.param(SERIES, marks=WEEKLY)]
)


def falsely(decided: int, series: int) -> None:
    """At most 5 %: exactly where there are many series, with slack where there are few."""
    slack = 0.0 if series == SERIES else SLACK * np.sqrt(0.05 * 0.95 / series)
    assert decided <= (0.05 + slack) * series, f"{decided} of {series}"


def shares(
    series: int, chance: float, sizes: Callable[[Decision | None, int], int], first: int, own: bool
) -> tuple[int, int]:
    """How many series of looks at a rate of failures met, and failed, a rate of 95 %. ``own``: each
    run's own look is one of those before, not only the first's.
    """
    known: dict[Hashable, tuple[Decision, int]] = {}
    rng, met, failed = np.random.default_rng(7), 0, 0
    for _ in range(series):
        poses, bad, looks, seen = 0, 0, FIRST, set[Verdict]()
        more = first
        for _ in range(LOOKS):
            poses, bad = poses + more, bad + int(rng.binomial(more, chance))
            key = (poses, bad, looks)
            if key not in known:
                rate = Rate(poses - bad, poses)
                decided = decide_rate("r", rate, required=0.95, confidence=0.95, looks=looks)
                known[key] = decided, sizes(decided, poses)
            decision, then = known[key]
            seen.add(decision.verdict)
            if decision.verdict is MET:
                break
            before = Looks(own=(more,)) if looks is FIRST else looks
            grown = (*before.own, then) if own else before.own
            pooled = before.pooled if looks is FIRST else (*before.pooled, poses)
            looks, more = Looks(own=grown, pooled=pooled), then
        met, failed = met + (MET in seen), failed + (NOT_MET in seen)
    return met, failed


def advised(decision: Decision | None, poses: int) -> int:
    """As many as the sentence says, 300 at most."""
    assert decision is not None
    words = decision.sentence.split()
    at = words.index("more") if "more" in words else 0
    return min(int(words[at - 1]), 300) if at else 34


@counts
@pytest.mark.parametrize("first", [59, 100])
def test_reliability_at_its_limit_is_met_in_no_more_than_5_percent(series: int, first: int) -> None:
    met, _ = shares(series, 0.0501, lambda _, __: 34, first, own=False)
    falsely(met, series)


@pytest.mark.weekly
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("first", [30, 59, 92, 124])
def test_so_it_is_where_as_many_poses_are_added_as_would_decide(first: int, own: bool) -> None:
    met, _ = shares(SERIES, 0.0501, advised, first, own)
    falsely(met, SERIES)


@counts
def test_a_rate_just_above_the_limit_is_refused_in_no_more_than_5_percent(series: int) -> None:
    _, failed = shares(series, 0.0499, lambda _, __: 34, 100, own=False)
    falsely(failed, series)


@counts
@pytest.mark.parametrize("u_mm", [0.0, 0.23])
def test_an_error_beyond_its_limit_in_one_pose_of_twenty_is_accepted_in_no_more_than_5_percent(
    series: int, u_mm: float
) -> None:
    """Bad poses lie just beyond the limit; half of the truth's variance is the same all through."""
    rng, met = np.random.default_rng(11), 0
    for _ in range(series):
        common = rng.normal(0.0, u_mm * np.sqrt(0.5), 3)
        seen, looks = np.zeros(0), FIRST
        for look in range(LOOKS):
            more = 59 if not look else 32
            true = np.zeros((more, 3))
            true[rng.random(more) < 0.0501, 2] = 5.0 + 1e-9
            fresh = rng.normal(0.0, u_mm * np.sqrt(0.5), (more, 3))
            seen = np.append(seen, np.linalg.norm(true + common + fresh, axis=1))
            decision = decide_error(
                "e", seen, limit_mm=5.0, u_mm=u_mm, rate=0.95, confidence=0.95, looks=looks
            )
            if decision.verdict is not INCONCLUSIVE or seen.max() > 5.0:
                break  # the largest only grows
            looks = looks.after(len(seen))
        met += decision.verdict is MET
    falsely(met, series)


STILL, MOVED = (
    score_scene(
        [[0.0, 0.0, mm]], [[0.0, 0.0, 0.0]], [True],
        u_mm=0.0, seconds=0.1, limit_mm=5.0, time_limit_s=2.0,
    )
    for mm in (0.0, 5.0)
)  # fmt: skip


def pairs_of(poses: int, grown: int) -> Iterator[ScenePair]:
    """One teat a pose; in so many the new one's distance grew by the whole limit."""
    for k in range(poses):
        yield ScenePair(f"{k}", f"{k}", "ideal", STILL, MOVED if k < grown else STILL)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("series", "first", "looks"),
    [(400, 72, 4), *(pytest.param(SERIES, first, LOOKS, marks=WEEKLY) for first in (72, 110))],
)
def test_the_gate_lets_one_that_is_worse_by_its_margin_through_in_no_more_than_5_percent(
    series: int, first: int, looks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mean distance grows by 0.2505 mm, margin 0.25."""
    # of one situation the gate asks no p-value
    monkeypatch.setattr("bench.scoring.comparison.sign_flip_p", lambda *_: 1.0)
    rng, known, met = np.random.default_rng(13), dict[tuple[int, int], Verdict](), 0
    for _ in range(series):
        poses, grown = 0, 0
        for look in range(looks):
            more = 34 if look else first
            poses, grown = poses + more, grown + int(rng.binomial(more, 0.0501))
            if (poses, grown) not in known:
                found = compare([*pairs_of(poses, grown)], margin_mm=0.25, again=look)
                known[poses, grown] = found.gate.verdict
            if known[poses, grown] is MET:
                met += 1
                break
    falsely(met, series)


@pytest.mark.parametrize("poses", [1, 58, 59, 60, 92, 93, 124, 1000])
def test_what_a_first_look_spends_is_the_chance_that_it_decides(poses: int) -> None:
    accepts, refuses = spent_on(poses, 0.95, 0.95)
    bad = np.arange(poses + 1)
    verdicts = [
        decide_rate("r", Rate(poses - k, poses), required=0.95, confidence=0.95).verdict
        for k in range(min(poses, 120) + 1)
    ]
    of = np.diff(bdtr(bad, poses, 0.05), prepend=0.0)[: len(verdicts)]
    for spent, verdict in ((accepts, MET), (refuses, NOT_MET)):
        chance = sum(p for p, said in zip(of, verdicts, strict=True) if said is verdict)
        assert spent == pytest.approx(chance, abs=1e-9)
    assert max(accepts, refuses) <= 0.05


def test_the_first_look_is_the_exact_test_and_no_figure_moves() -> None:
    for k in range(4):
        rate = Rate(100 - k, 100)
        test = RateTest(0.95, 0.95)
        assert test.lower(rate) == rate.lower_bound(0.95)
        assert test.upper(rate) == rate.upper_bound(0.95)


def test_a_plan_for_looks_keeps_some_for_those_that_follow() -> None:
    """With two planned, the first has 2.5 %: it needs more poses, and the next ones fewer."""
    one, two = (Looks(planned) for planned in (1, 2))
    rate = Rate(59, 59)
    assert [
        decide_rate("r", rate, required=0.95, confidence=0.95, looks=looks).verdict
        for looks in (one, two)
    ] == [MET, INCONCLUSIVE]
    lost = Rate(58, 59)
    more, fewer = (RateTest(0.95, 0.95, looks).more(lost) for looks in (one, two))
    assert more is not None
    assert fewer is not None
    assert fewer < more
    assert zero_failure_n(0.95, two.first_confidence(0.95)) == 72


def test_the_poses_that_a_sentence_asks_for_decide() -> None:
    seen = Rate(99, 103)
    more = RateTest(0.95, 0.95).more(seen)
    assert more is not None
    for short, verdict in ((0, MET), (1, INCONCLUSIVE)):
        rate = Rate(seen.successes + more - short, seen.trials + more - short)
        looks = Looks(own=(seen.trials,))
        decided = decide_rate("r", rate, required=0.95, confidence=0.95, looks=looks)
        assert decided.verdict is verdict
    assert "holds at every look" in decided.rule


def test_times_pay_as_rates_do() -> None:
    seconds = [0.1] * 120
    how = {"limit_s": 2.0, "statistic": "max", "rate": 0.95}
    assert decide_time("t", seconds, **how).verdict is MET  # type: ignore[arg-type]
    again = decide_time("t", seconds, **how, looks=Looks(own=(59,)))  # type: ignore[arg-type]
    assert again.verdict is INCONCLUSIVE
    assert "as a further look" in again.sentence


def test_bets_on_means_are_those_on_rates() -> None:
    for hits, trials in ((0, 9), (30, 30), (57, 60), (3, 400)):
        rate = least_rate(hits, trials, 0.025)
        assert least_mean([1.0, 0.0], [hits, trials - hits], 0.025) == pytest.approx(rate)
        assert confidence_sequence(hits, trials, 0.95)[0] == pytest.approx(rate)


@pytest.mark.parametrize(
    ("planned", "poses", "failed", "spent", "more"),
    [(1, 30, 0, 0.0, 50), (1, 59, 1, 0.0485, 177), (1, 92, 1, 0.0089, 71), (2, 59, 1, 0.0, 99)],
)
def test_the_figures_of_the_docs(
    planned: int, poses: int, failed: int, spent: float, more: int
) -> None:
    test = RateTest(0.95, 0.95, Looks(planned))
    sure = test.looks.first_confidence(0.95)
    assert spent_on(poses, 0.95, sure)[0] == pytest.approx(spent, abs=5e-5)
    assert test.more(Rate(poses - failed, poses)) == more


def test_what_a_further_look_needs_is_as_the_page_says() -> None:
    page = (Path(__file__).parents[3] / "docs" / "scoring.md").read_text(encoding="utf-8")
    row = re.compile(
        r"^\| (\d+) poses, (none|one) failed \|.*\| (\d+) more \| (\d+) more \|$", re.M
    )
    rows = row.findall(page)
    assert len(rows) == 3
    for poses, failed, *needed in rows:
        n = int(poses)
        shown = Rate(n - (failed == "one"), n)
        test = RateTest(0.95, 0.95)
        assert [test.more(shown, leaks=leaks) for leaks in (False, True)] == [*map(int, needed)]
