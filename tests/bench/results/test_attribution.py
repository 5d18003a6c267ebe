"""A fault of the bench is never a failure of the detector: each missed or wrong teat is attributed
to one party.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bench.record.reader import RunRecord, TrialRecord
from bench.report.tables import attribution_parts
from bench.results.attribution import AttributedFault, Cause, DetectionFault, attributed, counted
from bench.scoring.scene import SceneScore, score_scene
from reports.page import Notes, Table

ENDS = np.array([[0.0, 0.0, 0.0], [60.0, 0.0, 0.0], [0.0, 60.0, 0.0], [60.0, 60.0, 0.0]])


def score(
    found: list[list[float]], visible: tuple[bool, ...] = (True,) * 4, u_mm: float = 0.3
) -> SceneScore:
    return score_scene(
        found, ENDS, np.array(visible), u_mm=u_mm, seconds=0.1, limit_mm=5.0, time_limit_s=2.0
    )


def trial(
    name: str, seen: SceneScore, visible: tuple[bool, ...] = (True,) * 4, **head: Any
) -> TrialRecord:
    truth = tuple(
        {"teat": str(number), "visible": int(flag), "how": "touched"}
        for number, flag in enumerate(visible, 1)
    )
    kept = {"id": name, "bath_state": "stable", "invalid": None, **head}
    detections = ({"detector": "d", "reason": None},)
    return TrialRecord(kept, truth=truth, detections=detections, scores={"d": seen})


def run(
    *trials: TrialRecord,
    ending: str = "finished",
    skipped: tuple[Any, ...] = (),
    events: tuple[Any, ...] = (),
) -> RunRecord:
    poses = (
        [[one.id] for one in trials]
        + [[row["trial"]] for row in skipped]
        + [["never"]] * (ending != "finished")
    )
    facts = {"detectors": ["d"], "ending": ending, "pose set": {"poses": poses}}
    return RunRecord(Path(), facts, trials, skipped, events=events)


def whose(record: RunRecord) -> list[tuple[str, DetectionFault, Cause]]:
    return [(one.teat, one.what, one.cause) for one in attributed(record, "d")]


def test_what_the_detector_did_is_the_detectors() -> None:
    seen = score([[0.5, 0, 0], [68.0, 0, 0], [0, 60, 1], [-90, -90, 0]])
    assert whose(run(trial("a", seen))) == [
        ("4", DetectionFault.MISSED, Cause.DETECTOR),
        ("2", DetectionFault.OFF, Cause.DETECTOR),
        ("", DetectionFault.FALSE, Cause.DETECTOR),
    ]


def test_an_end_in_the_guard_band_is_the_truths() -> None:
    found = [*ENDS[:3].tolist(), [65.2, 60.0, 0.0]]
    assert whose(run(trial("a", score(found, u_mm=0.3)))) == [
        ("4", DetectionFault.OFF, Cause.TRUTH)
    ]
    assert whose(run(trial("a", score(found, u_mm=0.001)))) == [
        ("4", DetectionFault.OFF, Cause.DETECTOR)
    ]


def test_an_end_that_cannot_be_seen_is_no_detectors_fault() -> None:
    hidden = (True, True, True, False)
    assert whose(run(trial("a", score(ENDS[:3].tolist(), hidden), hidden))) == [
        ("4", DetectionFault.MISSED, Cause.NOT_VISIBLE)
    ]
    assert whose(run(trial("a", score(ENDS.tolist(), hidden), hidden))) == [], "found all the same"


def test_a_bath_that_was_not_stable_is_the_benchs_and_a_truth_taken_back_the_truths() -> None:
    missed = score(ENDS[:3].tolist())
    assert whose(run(trial("a", missed, bath_state="heating"))) == [
        ("4", DetectionFault.MISSED, Cause.BENCH)
    ]
    assert whose(run(trial("a", missed, invalid="the stage lost its place"))) == [
        ("4", DetectionFault.MISSED, Cause.TRUTH)
    ]


def test_trials_that_were_not_judged() -> None:
    rows = (
        {"trial": "x", "reason": "it leaks"},
        {"trial": "y", "reason": "teat 2: 5 of 5 touches could not be used"},
        {"trial": "z", "reason": "the bench died in it 2 times, and doesn't try it again"},
    )
    events = ({"kind": "skipped", "text": "x: the operator skipped it: it leaks"},)
    causes = [one.cause for one in attributed(run(skipped=rows, events=events), "d")]
    assert causes == [Cause.OPERATOR, Cause.TRUTH, Cause.BENCH]
    for ending, cause in (
        ("aborted", Cause.OPERATOR),
        ("faulted", Cause.BENCH),
        ("interrupted", Cause.BENCH),
    ):
        assert [(one.trial, one.cause) for one in attributed(run(ending=ending), "d")] == [
            ("never", cause)
        ]


def test_the_report_counts_them_apart_and_names_what_is_not_the_detectors() -> None:
    record = run(
        trial("a", score(ENDS[:3].tolist())),
        trial("b", score(ENDS[:2].tolist()), bath_state="heating"),
    )
    table, notes = attribution_parts(record)
    assert isinstance(table, Table)
    assert table.rows[0] == ("missed", "1", "0", "2", "0", "0", "0")
    assert isinstance(notes, Notes)
    assert len(notes.items) == 2
    found = attributed(record, "d")
    assert counted(found)[DetectionFault.MISSED, Cause.BENCH] == 2
    assert isinstance(found[0], AttributedFault)
