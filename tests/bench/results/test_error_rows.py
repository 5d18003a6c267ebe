"""What errors depend on, and the gage study of the truth, from a record made by hand."""

from __future__ import annotations

import shutil
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.record.reader import RunRecord, TrialRecord
from bench.record.schema import RULES
from bench.report.comparison import notes
from bench.results.comparison import Side, compare_sides, scored_together
from bench.results.error_rows import (
    ErrorRows,
    error_rows,
    run_bias,
    run_trends,
    truth_gage,
)
from bench.scoring.errors import Floats
from bench.scoring.rates import Rate
from bench.scoring.scene import score_scene
from bench.script.model import RECORDING_RULES, TRIALS, load_script

ENDS = np.array([[-260.0, 267.0, 136.0], [-110.0, 284.0, 136.0]])


def trial(
    number: int, pose: str, repeat: int, ends: Floats, found: Floats, u_mm: float = 0.2, **head: Any
) -> TrialRecord:
    names = {"id": f"{number:03d}-{pose}-{repeat}", "number": number, "name": pose}
    names |= {"repeat": repeat, "situation": "map", "invalid": None}
    of_all = {"u_mm": u_mm, "visible": 1, "how": "touched"}
    rows = [
        {"teat": str(k), "x_mm": x, "y_mm": y, "z_mm": z, **of_all}
        for k, (x, y, z) in enumerate(ends.tolist(), 1)
    ]
    score = score_scene(
        found, ends, [True] * len(ends), u_mm=u_mm, seconds=0.1, limit_mm=5.0, time_limit_s=2.0
    )
    times = {"captured_s": 60.0 * number, "bath_c": 33.0}
    return TrialRecord({**names, **times, **head}, truth=rows, scores={"fused": score})


def record(folder: Path, trials: list[TrialRecord]) -> RunRecord:
    return RunRecord(folder, {"detectors": ["fused"], "ending": "finished"}, tuple(trials))


@pytest.fixture
def drifting(tmp_path: Path) -> RunRecord:
    """Thirty poses along x, visited twice: y is off by 10 um a minute, z by 20 um a mm of x; the
    second teat is missed at pose 3.
    """
    rng = np.random.default_rng(1)
    trials = []
    for number in range(1, 61):
        place = (number - 1) % 30
        ends = np.add(ENDS, [2.0 * place, 0.0, 0.0])
        off = [0.0, 0.01 * number, 0.02 * (2.0 * place)]
        errors = np.add(off, rng.normal(0, 0.05, (2, 3)))
        found = (ends + errors)[: 1 if place == 3 else 2]
        pose = f"map-{place:02d}", 1 + (number - 1) // 30
        trials.append(trial(number, *pose, ends, found, u_mm=0.02))
    return record(tmp_path, trials)


def test_each_visible_teat_is_a_row_found_or_not(drifting: RunRecord) -> None:
    rows = error_rows(drifting, "fused")
    assert (len(rows.poses), int(rows.found.sum()), rows.errors_mm.shape) == (120, 118, (118, 3))
    assert rows.places_mm[:2] == pytest.approx(ENDS)
    assert rows.time_s[:4].tolist() == [60.0, 60.0, 120.0, 120.0]
    assert np.isnan(rows.tilt_deg).all()  # a record without a script has no phantom
    assert error_rows(drifting, "thesis").poses == ()


def test_a_drift_and_a_tilted_plane_are_found_and_nothing_else(drifting: RunRecord) -> None:
    found = {(one.quantity, one.response): one for one in run_trends(error_rows(drifting, "fused"))}
    assert found["time_s", "y"].slope == pytest.approx(0.01 / 60.0, rel=0.1)
    assert found["time_s", "y"].groups == 60  # within each pose, frame set by frame set
    assert found["x_mm", "z"].slope is not None
    assert found["x_mm", "z"].slope > 0.001
    assert found["x_mm", "z"].groups == 30
    assert found["bath_c", "y"].slope is None
    significant = {key for key, one in found.items() if one.significant and key[1] != "distance"}
    # in its order of visits, place and time go together
    assert significant <= {("time_s", "y"), ("x_mm", "z"), ("x_mm", "y")}
    assert {("time_s", "y"), ("x_mm", "z")} <= significant


def test_tilts_come_from_the_scripts_own_phantom(tmp_path: Path) -> None:
    script = Path(shutil.copy(TRIALS / "six-situations.toml", tmp_path / "script.toml"))
    planned = load_script(script).planned[0]
    tilts = [
        float(np.degrees(np.arctan(np.hypot(*np.tan(teat.tilt_rad)))))
        for teat in planned.phantom.teats
    ]
    ends = np.add(ENDS, [0.0, 0.0, 1.0])
    run = record(tmp_path, [trial(planned.number, planned.name, planned.repeat, ends, ends)])
    assert run.trials[0].id == planned.id
    assert error_rows(run, "fused").tilt_deg == pytest.approx(tilts[:2])
    assert max(tilts) > 1.0


def test_runs_merge_by_their_counts_and_a_pose_has_to_succeed_in_each(
    drifting: RunRecord, tmp_path: Path
) -> None:
    trials = [trial(1, "map-00", 1, ENDS, ENDS[:1]), trial(2, "map-01", 1, ENDS, ENDS)]
    other = record(tmp_path, trials)
    alone = scored_together([drifting], "fused")
    together = scored_together([drifting, other], "fused")
    own = (alone.counts, scored_together([other], "fused").counts)
    assert astuple(together.counts) == tuple(map(sum, zip(*map(astuple, own), strict=True)))
    assert len(together.errors_mm) == 118 + 3
    assert alone.success == Rate(29, 30)  # pose 3 misses a teat
    one, same = (replace(run, facts={**run.facts, "script": "map"}) for run in (drifting, other))
    # pose 0 failed in the second run
    assert scored_together([one, same], "fused").success == Rate(28, 30)
    another = replace(other, facts={"script": "other"})
    assert scored_together([one, another], "fused").success == Rate(30, 32)


def test_an_empty_run_depends_on_nothing(tmp_path: Path) -> None:
    rows: ErrorRows = error_rows(record(tmp_path, []), "fused")
    assert all(one.slope is None for one in run_trends(rows))
    assert run_bias(rows).next_error is None


def touched(
    pose: str, number: int, repeat: int, points: Floats, refused: str | None = None
) -> TrialRecord:
    base = trial(number, pose, repeat, ENDS[:1], ENDS[:1])
    rows = tuple(
        {"teat": "1", "touch": k, "x_mm": x, "y_mm": y, "z_mm": z, "refused": refused}
        for k, (x, y, z) in enumerate(points.tolist(), 1)
    )
    return replace(base, touches=rows)


def set_ups(folder: Path, poses: int = 40, repeats: int = 6, touches: int = 3) -> RunRecord:
    rng = np.random.default_rng(2)
    made: list[TrialRecord] = []
    for pose in range(poses):
        for repeat in range(repeats):
            again = rng.normal(0, 0.30, 3)  # a set-up's own offset, another at each pose
            points = ENDS[0] + [5.0 * pose, 0.0, 0.0] + again + rng.normal(0, 0.10, (touches, 3))
            made.append(touched(f"p{pose}", len(made) + 1, repeat + 1, points))
    return record(folder, made)


def test_a_comparison_of_two_runs_tells_how_well_their_truths_agree(tmp_path: Path) -> None:
    runs = [set_ups(tmp_path / name, repeats=1) for name in ("old", "new")]
    for run in runs:
        run.folder.mkdir(exist_ok=True)
        shutil.copy(RECORDING_RULES, run.folder / RULES)
    old, new = (Side(run, "fused") for run in runs)
    of_truth = "The truth itself"
    (text,) = [note for note in notes(compare_sides(old, new)) if note.startswith(of_truth)]
    assert "40 ends touched 3 times in each run" in text
    assert "reproducibility 0.000, 0.000, 0.000 mm" in text
    found = compare_sides(old, new)
    few = replace(found, pairs=tuple(one for one in found.pairs if one.pose in ("p0", "p1", "p2")))
    (text,) = [note for note in notes(few) if note.startswith(of_truth)]
    assert "3 ends touched" in text, "of poses that are compared alone"
    assert "of the tolerance of 10 mm" in text
    assert not [note for note in notes(compare_sides(old, old)) if note.startswith(of_truth)]


def test_what_holds_no_study_says_why(tmp_path: Path, drifting: RunRecord) -> None:
    assert truth_gage([drifting]).why == "no teat end was touched"
    assert "repeat the poses" in truth_gage([set_ups(tmp_path, repeats=1)]).why
    one_pose = truth_gage([set_ups(tmp_path, poses=1)])
    assert one_pose.why == "only one end was touched in several set-ups"
    refused = record(tmp_path, [touched("p", 1, 1, np.zeros((3, 3)), refused="spread")])
    assert truth_gage([refused]).why == "no teat end was touched"
