"""Which trials a report says to look at first: each detector's own failures, the undecided first."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import pytest

from bench.record.reader import RunRecord, read_run
from bench.report.tables import scoreboard
from bench.report.trials import first_looks, first_trials, undecided_of, worst_trials
from bench.results.verdicts import Judgement
from bench.scoring.decisions import Decision, Verdict
from reports.page import Cell
from tests.bench.small_run import KEPT

BASELINE, UNDER_TEST = "thesis", "fused"


def run_with(failures: dict[str, Collection[int]], repeats: int = 6) -> RunRecord:
    """A run of six trials in which the detectors failed so; later failures are the worse ones."""
    kept = read_run(KEPT)
    (score,) = kept.trials[0].scores.values()
    trials = []
    for number in range(1, 7):
        far = tuple(mm + number for mm in score.match.distances_mm)
        scores = {
            name: replace(
                score, success=number not in failed, match=score.match._replace(distances_mm=far)
            )
            for name, failed in failures.items()
        }
        own = {
            "id": f"{number:03d}-pose",
            "number": number,
            "name": f"pose-{(number - 1) // repeats}",
        }
        head = {**kept.trials[0].head, **own}
        trials.append(replace(kept.trials[0], head=head, scores=scores))
    facts = {**kept.facts, "detectors": list(failures)}
    return replace(kept, facts=facts, trials=tuple(trials))


def numbers(run: RunRecord, undecided: Collection[str] = ()) -> list[int]:
    return [int(trial.head["number"]) for trial in worst_trials(run, undecided)]


def test_the_one_failure_of_the_undecided_detector_comes_before_all_of_the_baseline() -> None:
    run = run_with({BASELINE: range(1, 7), UNDER_TEST: [2]})
    assert numbers(run, {UNDER_TEST}) == [2, 6, 5, 4, 3, 1]
    assert numbers(run)[:2] == [6, 2], "each in turn, where none is undecided"
    looked = first_looks(run, {UNDER_TEST})
    assert looked is not None
    (_, cell), *_ = looked.entries
    assert isinstance(cell, Cell)
    assert cell.text.startswith(f"{UNDER_TEST}: ")


def test_the_cards_begin_with_the_same_detector_as_the_line_above_them() -> None:
    run = run_with({BASELINE: range(1, 7), UNDER_TEST: [6]})
    (first, why), (_, second), *_ = first_trials(run, {UNDER_TEST}).values()
    assert (first.head["number"], why) == (6, f"Worst of {UNDER_TEST}")
    assert second == f"Worst of {BASELINE}"


def test_the_first_card_is_a_failure_where_there_is_one() -> None:
    """Also one that was only too slow, beside a success that is further off."""
    run = run_with({BASELINE: range(1, 7), UNDER_TEST: [2]})
    (first, _), *_ = first_trials(run, {UNDER_TEST}).values()
    assert [first.head["number"]] == numbers(run, {UNDER_TEST})[:1] == [2]


def test_other_poses_come_before_repeats_of_one() -> None:
    """Frames of one pose show the same thing; a pose that succeeded comes after each failure."""
    run = run_with({UNDER_TEST: [1, 2, 5, 6]}, repeats=2)
    assert numbers(run) == [6, 2, 5, 1]
    looked = [int(trial.head["number"]) for trial, _ in first_trials(run).values()]
    assert looked == [6, 2, 5, 1], "three of the worst, and a typical one"


@pytest.mark.parametrize(
    ("verdict", "undecided"),
    [(Verdict.INCONCLUSIVE, True), (Verdict.NOT_MEASURED, True), (Verdict.NOT_MET, False)],
)
def test_whom_the_run_has_not_decided(verdict: Verdict, undecided: bool) -> None:
    decision = Decision(name="error", verdict=verdict, limit=5.0, rule="", sentence="")
    assert (UNDER_TEST in undecided_of([Judgement(UNDER_TEST, (decision,))])) is undecided
    sound = (replace(decision, name=name, verdict=Verdict.MET) for name in ("arm", "bath"))
    made = (decision, *sound)
    for own, called in ({"arm", "bath"}, "own"), ({"arm", "bath", "error"}, "other ones"):
        (*_, last) = scoreboard([Judgement(UNDER_TEST, made, frozenset(own))]).rows
        assert last[0] == f"The bench's {called}"
        (score,) = last[2]
        assert score is not None
        assert score.value == "2 of 2"


def test_what_the_bench_shows_stands_under_no_detector() -> None:
    """Beside two detectors it spans their columns; a check that failed has a row of its own."""
    decision = Decision(name="bath", verdict=Verdict.MET, limit=5.0, rule="", sentence="")
    made = (decision, replace(decision, name="arm", verdict=Verdict.NOT_MET))
    both = [Judgement(name, made, frozenset({"arm", "bath"})) for name in (UNDER_TEST, BASELINE)]
    board = scoreboard(both)
    assert [(name, len(scores)) for name, _, scores in board.rows] == [
        ("Bench: bath", 1),
        ("Bench: arm", 1),
    ]
    assert set(board.shared) == {"Bench: bath", "Bench: arm"}
    assert board.caption == "What each detector shows.", "from 0 values says nothing"
