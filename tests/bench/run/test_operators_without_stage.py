"""A rig without a stage: every pose is something that the operator does, the emulated one as well
as a script of answers.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bench.record.reader import RunRecord
from bench.script.phantom import shipped_phantom
from instruments.world.phantom import PlatePose
from tests.bench.operated_runs import CHECK_POINT, files, run

POSES = (PlatePose(12.0, -8.0), PlatePose(-15.0, 0.0, 6.0, float(np.radians(4.0))), PlatePose())


def exact_ends(record: RunRecord) -> list[np.ndarray]:
    """Where the teat ends were in each trial, as the emulated world knows it."""
    return [
        np.array([json.loads(row["exact_mm"]) for row in trial.truth]) for trial in record.trials
    ]


def wanted_ends() -> list[np.ndarray]:
    return [shipped_phantom("table-5-1").moved(pose).ends_mm for pose in POSES]


def texts(record: RunRecord, kind: str) -> list[str]:
    return [event["text"] for event in record.events if event["kind"] == kind]


def test_without_a_stage_the_emulated_operator_puts_the_plate_where_the_script_says(
    tmp_path: Path,
) -> None:
    code, record = run(files(tmp_path), tmp_path)
    assert code == 0, texts(record, "fault")
    assert "stage" not in record.facts["identities"]
    for found, wanted in zip(exact_ends(record), wanted_ends(), strict=True):
        assert found == pytest.approx(wanted, abs=1e-6)


def test_placement_errors_come_out_in_the_truth_and_not_as_errors_of_it(tmp_path: Path) -> None:
    emulation = "placement_error_mm = 2.0\nplacement_error_deg = 1.0\nhand_error_mm = 0.05"
    code, record = run(files(tmp_path, emulation=emulation), tmp_path)
    assert code == 0, texts(record, "fault")
    for found, wanted, trial in zip(exact_ends(record), wanted_ends(), record.trials, strict=True):
        assert 0.1 < np.linalg.norm(found - wanted, axis=1).max() < 20.0
        touched = np.array([[row[f"{axis}_mm"] for axis in "xyz"] for row in trial.truth])
        assert np.linalg.norm(touched - found, axis=1).max() < 2.0
    assert (
        len(
            {
                round(float((f - w)[0, 0]), 6)
                for f, w in zip(exact_ends(record), wanted_ends(), strict=True)
            }
        )
        == 3
    )


def test_without_a_stage_a_script_of_answers_is_asked_for_every_pose(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = (
        "homing: go\ncheck point: go x2\n"
        "set up (Move the plate to x +12 mm, y -8 mm): hidden 2 4\ntouch: go x4\n"
        "set up (Move the plate to x -15 mm, y +0 mm, z +6 mm, yaw +4 deg): go\ntouch: go x4\n"
        "set up (x +0 mm, y +0 mm): go\ntouch: go x4\ncheck point: go x2\n"
    )
    arguments = files(
        tmp_path, operator="script:answers.txt", check_point=CHECK_POINT, answers=answers
    )
    code, record = run(arguments, tmp_path)
    assert code == 0, texts(record, "fault")
    assert [row["visible"] for row in record.trials[0].truth] == [1, 0, 1, 0]
    for found, wanted in zip(exact_ends(record), wanted_ends(), strict=True):
        assert found == pytest.approx(wanted, abs=1e-6)
    said = capsys.readouterr().out
    assert (
        "[trial 2 of 3, teat 4 of 4; less than a minute left] Touch the end of teat 4 (LF) of 4"
        in said
    )
    assert record.folder.joinpath("answers.txt").read_text(encoding="utf-8") == answers


@pytest.mark.parametrize("mistake", ["wrong teat", "forgotten teat"])
def test_a_mistake_of_the_hand_is_noticed_and_does_not_get_into_the_truth(
    mistake: str, tmp_path: Path
) -> None:
    code, record = run(files(tmp_path, emulation=f'mistakes = ["{mistake}"]'), tmp_path)
    assert code == 0, texts(record, "fault")
    refused = [row for trial in record.trials for row in trial.touches if row["refused"]]
    assert [(row["trial"], row["teat"]) for row in refused] == [(record.trials[0].id, "2")]
    for trial, wanted in zip(record.trials, wanted_ends(), strict=True):
        touched = np.array([[row[f"{axis}_mm"] for axis in "xyz"] for row in trial.truth])
        assert np.linalg.norm(touched - wanted, axis=1).max() < 2.0
