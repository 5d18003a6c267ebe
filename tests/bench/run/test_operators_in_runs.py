"""What an operator may want of a run: skip a trial, have it again, abort; and what ends a prompt of
his, or faults his script.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.record.reader import RunRecord
from bench.script.phantom import shipped_phantom
from instruments.world.phantom import PlatePose
from tests.bench.operated_runs import CHECK_POINT, SCRIPT, STAGE, files, record_of, run, texts
from tests.plain_text import plain_text

pytestmark = pytest.mark.slow

WILLING = (
    "otherwise homing: go\notherwise check point: go\notherwise set up: go\notherwise touch: go\n"
)


SCRIPTED = "script:answers.txt"


def answered(folder: Path, answers: str) -> tuple[int, RunRecord]:
    """A run whose operator is a script of ``answers``, with its exit code and its report."""
    return run(files(folder, operator=SCRIPTED, answers=answers), folder)


def page_of(record: RunRecord) -> str:
    return plain_text(record.folder / "report" / "index.html")


def test_a_skipped_trial_leaves_the_counts_and_is_reported_with_its_reason(tmp_path: Path) -> None:
    why = "the teat came off"
    code, record = answered(tmp_path, f"{WILLING}touch (trial 2 of 3, teat 3): skip {why}\n")
    assert code == 0, texts(record, "fault")
    assert [trial.head["number"] for trial in record.trials] == [1, 3]
    (row,) = record.skipped
    assert (row["number"], row["situation"], row["reason"]) == (2, "ideal", why)
    assert texts(record, "skipped") == [f"{row['trial']}: the operator skipped it: {why}"]
    page = page_of(record)
    assert "Deviations from the script" in page
    assert f"{row['trial']} was skipped by the operator: {why}" in page
    assert "on 2 frame sets of 2 poses" in page


def test_a_run_of_which_all_was_skipped_has_no_verdict(tmp_path: Path) -> None:
    answers = "otherwise homing: go\notherwise set up: skip no phantom here\n"
    code, record = answered(tmp_path, answers)
    assert (code, len(record.skipped)) == (4, 3)
    assert "All 3 trials were left out, so nothing was scored" in page_of(record)
    assert 'name="bath"' in (record.folder / "report" / "junit.xml").read_text(encoding="utf-8")


def test_a_script_that_does_not_fit_the_run_faults_it(tmp_path: Path) -> None:
    code, record = answered(tmp_path, "homing: go\ntouch: go\n")
    assert (code, record.ending) == (3, "faulted")
    why = "no answer to this prompt (asked set up: [trial 1 of 3; less than a minute left]"
    assert f"answers.txt has {why}" in texts(record, "fault")[0]


POSES = (PlatePose(12.0, -8.0), PlatePose(-15.0, 0.0, 6.0, float(np.radians(4.0))), PlatePose())


WANTED = np.array([shipped_phantom("table-5-1").moved(pose).ends_mm for pose in POSES])


def exact_ends(record: RunRecord) -> np.ndarray:
    """Where the teat ends were in each trial (3, 4, 3), as the emulated world knows it."""
    return np.array(
        [[json.loads(row["exact_mm"]) for row in trial.truth] for trial in record.trials]
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
    record = record_of(tmp_path, operator=SCRIPTED, answers=answers, check_point=CHECK_POINT)
    assert record.ending == "finished", texts(record, "fault")
    assert [row["visible"] for row in record.trials[0].truth] == [1, 0, 1, 0]
    assert exact_ends(record) == pytest.approx(WANTED, abs=1e-6)
    at = "[trial 2 of 3, teat 4 of 4, 1 of 4 touches left; less than a minute left]"
    assert f"{at} Touch the end of teat 4, left front (LF), with" in capsys.readouterr().out
    assert record.folder.joinpath("answers.txt").read_text(encoding="utf-8") == answers


FAR = SCRIPT.replace("x_mm = -15.0, z_mm = 6.0, yaw_deg = 4.0", "x_mm = -150.0, y_mm = 130.0")
FAR_REGISTRATION = (
    '[truth]\nmode = "carry"\nregistration = "first"\nregistration_teat = 4\n'
    "registration_at_mm = [[-150.0, -130.0], [150.0, -130.0], [-150.0, 130.0]]\n\n[bath]"
)


def test_what_the_emulated_arm_does_not_reach_is_said_and_is_no_lost_link(tmp_path: Path) -> None:
    record = record_of(tmp_path, script=FAR, stage=STAGE)
    assert [trial.head["number"] for trial in record.trials] == [1, 3]
    (row,) = record.skipped
    assert row["reason"].startswith("the arm doesn't reach the end of left front (LF) at [")
    assert "arm_placed in [emulation]" in row["reason"]
    assert texts(record, "dropped out") == texts(record, "fault") == []


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (
            {"script": SCRIPT.replace("[bath]", FAR_REGISTRATION), "stage": STAGE},
            "position 3 of the stage's registration was not touched: the arm doesn't reach the end",
        ),
        (
            {"check_point": CHECK_POINT.replace("120.0", "900.0")},
            "the arm doesn't reach the check point at [-190, 900, 15] mm",
        ),
    ],
)
def test_before_the_trials_it_ends_the_run(
    asked: dict[str, Any], said: str, tmp_path: Path
) -> None:
    record = record_of(tmp_path, **asked)
    (aborted,) = texts(record, "aborted")
    assert aborted.startswith(said)
    assert texts(record, "dropped out") == texts(record, "fault") == []


GLARING = SCRIPT.replace('layout = "table-5-1"', 'family = "non_vertical"\nmember = 16069')


def test_a_drawn_scene_is_lit_so_that_the_frame_check_takes_it(tmp_path: Path) -> None:
    """Of this member 29 % are white as drawn: its board is light, and its lamps are strong."""
    record = record_of(tmp_path, script=GLARING.replace('set_up = "Teats as in table 5.1."', ""))
    assert len(record.trials) == 3, texts(record, "fault")
    assert texts(record, "frames") == []
