"""From a record to its decisions: what counts is the pose, what the truth could turn decides
nothing, and nothing measured is no zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.config import read_config
from bench.record.reader import RunRecord, TrialRecord
from bench.report.page import _confidence, _latency_parts
from bench.results.headline import judged
from bench.results.stated_arm import STATED_FACT
from bench.results.status import status_of
from bench.results.verdicts import judge, latency_of, run_verdict
from bench.scoring.decisions import Decision, Verdict
from bench.script.model import (
    RECORDING_RULES,
    ErrorRequirement,
    Rules,
    SuccessRequirement,
    TimeRequirement,
)
from reports.page import Paragraph
from tests.bench.results.test_arm_verdict import check, stated
from tests.bench.results.test_error_rows import ENDS, record, trial

MET, NOT_MET, OPEN, NOTHING = Verdict
STARVED = (
    "in 11.8 s of detection it had a processor for 2.4 s; it waited for one, or for something else"
)
RULES = read_config(RECORDING_RULES, Rules)


def decided(run: RunRecord) -> dict[str, Decision]:
    (judgement,) = judge(run, RULES)
    return {decision.name: decision for decision in judgement.decisions}


def timed(one: TrialRecord, seconds: float, **more: Any) -> TrialRecord:
    row = {"trial": one.id, "detector": "fused", "outcome": "answered", "cold": 0}
    row |= {"wall_seconds": seconds, "wall_start_up_s": None, "wall_cpu_s": 0.2, "wall_load": 0.5}
    return replace(one, detections=({**row, **more},))


def off_by(distances_mm: Sequence[float], repeats: int = 1) -> list[TrialRecord]:
    """A trial for each distance that the first teat is off, several in a row of one pose."""
    found = [np.add(ENDS, [[0.0, 0.0, by], [0.0, 0.0, 0.0]]) for by in distances_mm]
    return [
        timed(trial(k + 1, f"p{k // repeats:03d}", k % repeats + 1, ENDS, ends), 0.2)
        for k, ends in enumerate(found)
    ]


def test_59_good_poses_meet_everything(tmp_path: Path) -> None:
    run = record(tmp_path, off_by([1.0] * 59))
    verdicts = {name: d.verdict for name, d in decided(run).items()}
    assert verdicts == {rule.name: MET for rule in RULES.requirements}
    assert run_verdict(judge(run, RULES)) is MET
    assert {d.n for d in decided(run).values()} == {59}


def test_a_guard_band_that_the_touches_refute_lets_nothing_be_met(tmp_path: Path) -> None:
    run = record(tmp_path, off_by([1.0] * 59))
    facts = {**run.facts, "arm check before": check(4.0), STATED_FACT: stated()}
    doubted = decided(replace(run, facts=facts))
    open_ones = {name for name, d in doubted.items() if d.verdict is OPEN}
    guarded = ErrorRequirement | SuccessRequirement
    assert open_ones == {rule.name for rule in RULES.requirements if isinstance(rule, guarded)}
    assert all("guard band is too narrow" in doubted[name].sentence for name in open_ones)
    sound = {**facts, "arm check before": check()}
    assert {d.verdict for d in decided(replace(run, facts=sound)).values()} == {MET}


def test_repeats_are_not_poses_for_any_requirement(tmp_path: Path) -> None:
    found = decided(record(tmp_path, off_by([1.0] * 174, repeats=3)))
    assert {d.n for d in found.values()} == {58}
    assert found["error below 5 mm"].verdict is found["reliability"].verdict is OPEN
    assert "0 in 174 scenes of 58 poses" in found["no false teat"].sentence
    assert "over 174 detections" in found["detection time, limit"].sentence
    found = decided(record(tmp_path, off_by([1.0] * 185 + [7.0], repeats=3)))
    assert found["reliability"].sentence.startswith("61 of 62 poses succeeded")
    assert found["error below 5 mm"].verdict is NOT_MET


@pytest.mark.parametrize(
    ("near_mm", "error", "rate"), [(4.0, MET, MET), (4.8, OPEN, OPEN), (5.2, OPEN, OPEN)]
)
def test_what_the_truth_could_turn_is_not_shown(
    tmp_path: Path, near_mm: float, error: Verdict, rate: Verdict
) -> None:
    # A = 4.663, T + w = 5.329 for u = 0.2 mm
    found = decided(record(tmp_path, off_by([1.0] * 61 + [near_mm])))
    assert (found["error below 5 mm"].verdict, found["reliability"].verdict) == (error, rate)


def test_a_truth_that_states_no_uncertainty_accepts_no_error(tmp_path: Path) -> None:
    run = record(tmp_path, off_by([1.0] * 59))
    trials = [replace(t, truth=[{**row, "u_mm": None} for row in t.truth]) for t in run.trials]
    found = decided(replace(run, trials=tuple(trials)))["error below 5 mm"]
    assert found.verdict is OPEN
    assert "states no uncertainty" in found.sentence


def test_no_trial_measures_nothing(tmp_path: Path) -> None:
    run = record(tmp_path, [])
    assert {(d.verdict, d.measured) for d in decided(run).values()} == {(NOTHING, None)}
    assert judged(run, judge(run, RULES))[1].startswith("Look at the trials: poses such as these")
    assert run_verdict(judge(run, RULES)) is OPEN
    seen = trial(1, "p", 1, ENDS, ENDS[:0])
    hidden = replace(seen, truth=tuple({**row, "visible": 0} for row in seen.truth))
    found = judged(all_hidden := record(tmp_path, [hidden]), judge(all_hidden, RULES))
    assert found[1].startswith("No teat end can be seen in any trial")


def test_what_is_missed_has_no_error_and_shows_no_success(tmp_path: Path) -> None:
    none = np.zeros((0, 3))
    trials = [timed(trial(k, f"p{k}", 1, ENDS, none), 0.2) for k in range(1, 21)]
    found = decided(record(tmp_path, trials))
    error = found["error below 5 mm"]
    assert (error.verdict, error.measured) == (NOTHING, None)
    assert found["reliability"].verdict is NOT_MET
    trials = [*off_by([1.0] * 59), trial(60, "last", 1, ENDS, ENDS[:1])]
    sentence = decided(record(tmp_path, trials))["error below 5 mm"].sentence
    assert sentence.endswith("Only found teats count here; 1 was missed.")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cpu_s", "load", "why"),
    [
        (0.04, 0.5, STARVED),
        (None, 6.0, "half of the time 6.0 or more processes wanted each processor"),
        (None, 1.4, ""),
        (0.15, 6.0, ""),
        (0.8, 0.5, ""),
    ],
)
def test_a_machine_that_was_too_busy_is_reported_where_times_count(
    tmp_path: Path, cpu_s: float | None, load: float, why: str
) -> None:
    """In the bench's process by what the processor gave; of another by the machine's load."""
    trials = [timed(t, 0.2, wall_cpu_s=cpu_s, wall_load=load) for t in off_by([1.0] * 59)]
    run = record(tmp_path, trials)
    sentences = {name: d.sentence for name, d in decided(run).items()}
    of_time = {rule.name for rule in RULES.requirements if isinstance(rule, TimeRequirement)}
    note = {name for name, said in sentences.items() if "THE MACHINE WAS TOO BUSY" in said}
    assert note == (of_time if why else set())
    assert all(why in sentences[name] for name in of_time)
    page = [part.text for part in _latency_parts(run, RULES) if isinstance(part, Paragraph)]
    assert [why in text for text in page] == ([True] if why else [])


@pytest.mark.parametrize(
    ("cpu_s", "off_mm", "time", "reliability"),
    [
        (0.3, 1.0, OPEN, OPEN),  # accurate, and slow as the machine was starved
        (8.9, 1.0, NOT_MET, NOT_MET),  # slow by itself
        (0.3, 7.0, OPEN, NOT_MET),  # inaccurate, however long it may take
    ],
)
def test_a_starved_machine_decides_no_time(
    tmp_path: Path, cpu_s: float, off_mm: float, time: Verdict, reliability: Verdict
) -> None:
    slow = [
        replace(
            timed(one, 9.0, wall_cpu_s=cpu_s),
            scores={
                name: replace(score, seconds=9.0, in_time=False, success=False)
                for name, score in one.scores.items()
            },
        )
        for one in off_by([off_mm] * 59)
    ]
    run = record(tmp_path, slow)
    found = decided(run)
    if reliability is OPEN:
        then = judged(run, judge(run, RULES))[1]
        assert "Run it again on an idle machine to decide: " in then
        assert "; detection time, limit." in then, "more poses decide nothing of it"
    assert found["detection time, limit"].verdict is time
    assert found["reliability"].verdict is reliability
    told = "Without the time limit 59 of 59 poses succeeded." in found["reliability"].sentence
    assert told is (off_mm < 5.0)
    busy = "THE MACHINE WAS TOO BUSY" in found["reliability"].sentence
    assert busy is (off_mm < 5.0 and cpu_s < 1.0), "where late answers alone count against it"


def test_first_calls_and_short_times_say_nothing_of_the_machine(tmp_path: Path) -> None:
    cold = [timed(one, 9.0, cold=1, wall_cpu_s=0.1) for one in off_by([1.0])]
    short = [timed(one, 0.01, wall_cpu_s=0.0) for one in off_by([1.0] * 9)]
    assert latency_of(record(tmp_path, [*cold, *short]), "fused").starved == ""


@pytest.mark.parametrize(
    ("off_mm", "poses", "word", "said"),
    [
        (7.0, 6, "not met", "6 poses were tried: what failed in them shows what is not met, "),
        (1.0, 6, "inconclusive", "6 poses without a failure would show a success rate of"),
        (1.0, 59, "met", "59 poses without a failure would show a success rate of"),
    ],
)
def test_how_sure_that_is_fits_the_verdict(
    tmp_path: Path, off_mm: float, poses: int, word: str, said: str
) -> None:
    run = record(tmp_path, off_by([off_mm] * poses))
    assert run_verdict(judge(run, RULES)) == word
    sure = _confidence(run, RULES, poses, {word})
    assert sure.startswith(said)
    of_two = _confidence(run, RULES, poses, {word, "inconclusive"})
    assert of_two.startswith(f"{poses} poses without a failure"), "of another detector"
    assert ("takes 59 poses without a failure" in sure) is (poses < 59)


def test_no_verdict_holds_on_a_damaged_record(tmp_path: Path) -> None:
    run = replace(record(tmp_path, off_by([1.0] * 59)), damage=("run: a row is gone",))
    assert {d.verdict for d in decided(run).values()} == {OPEN}
    for decision in decided(run).values():
        assert decision.sentence.startswith("The record is NOT as it was written. ")
    status = status_of(run, judge(run, RULES))
    assert status.word == "no verdict"
    assert "run: a row is gone" in status.why
