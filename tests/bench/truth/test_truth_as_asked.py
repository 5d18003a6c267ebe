"""Touched truth end to end, the command that registers a stage, and scripts that ask for what can't
be.
"""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.cli.main import main
from bench.config import ConfigError
from bench.record.reader import RunRecord
from bench.record.schema import DATABASE
from bench.report.truth import deviation_parts
from bench.rig.loading import load_rig
from bench.run.truth_source import refuse_carry
from bench.script.model import load_script
from bench.script.planned_trials import PlannedTrial
from bench.truth.registration_file import load_registration, write_registration
from bench.truth.touching import NoTruthError
from reports.parts import Notes
from tests.bench.run.test_attempts import PLANNED, Context, attempts
from tests.bench.truth.touches import registered, stage_of
from tests.bench.truth.truth_runs import CARRY, done, rig_in, script_in


def test_a_ball_tip_gives_the_same_ends(tmp_path: Path) -> None:
    ball = done(
        rig_in(tmp_path, arm="tip_radius_mm = 3.0"),
        script_in(tmp_path, 'mode = "touch"\nreadings = 4', ""),
        tmp_path,
    )
    assert np.linalg.norm(ball.off_mm, axis=1).max() < 0.8, "not corrected it would be 3 mm"
    assert len(ball.run.trials[0].touches) == 16
    assert "tip radius" in ball.page
    tips = [
        np.array([row["x_mm"], row["y_mm"], row["z_mm"]])
        for row in ball.run.trials[0].touches
        if row["teat"] == "1"
    ]
    end = json.loads(ball.run.trials[0].truth[0]["exact_mm"])
    assert np.linalg.norm(np.mean(tips, axis=0) - end) == pytest.approx(3.0, abs=0.8), (
        "the record keeps what the arm read"
    )


@pytest.mark.parametrize(
    ("mistake", "said"),
    [("wrong teat", "looks like teat"), ("forgotten teat", "the end of teat 1 once more")],
)
def test_a_mistake_of_the_operator_is_noticed_and_put_right(
    tmp_path: Path, mistake: str, said: str
) -> None:
    wrong = done(
        rig_in(tmp_path, emulation=f'mistakes = ["{mistake}"]'),
        script_in(tmp_path, 'mode = "touch"', ""),
        tmp_path,
    )
    refused = [row for row in wrong.run.trials[0].touches if row["refused"]]
    assert len(refused) == 1
    assert said in refused[0]["refused"]
    assert np.linalg.norm(wrong.off_mm, axis=1).max() < 0.8
    assert "Touches that were refused and asked for again" in wrong.page


def test_a_registration_of_the_command_serves_a_script(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = rig_in(tmp_path)
    assert (
        main(["calibrate", "stage", "--rig", str(rig), "--out", str(tmp_path / "stage.toml")]) == 0
    )
    said = capsys.readouterr().out
    assert "rigid: residual" in said
    assert 'registration = "stage.toml"' in said
    script = script_in(
        tmp_path,
        'mode = "carry"\nregistration = "stage.toml"',
        "poses = [{ x_mm = -20.0 }, { x_mm = 20.0 }]",
    )
    run = done(rig, script, tmp_path).run
    assert [trial.how for trial in run.trials] == ["touched", "carried"]
    assert (run.folder / "stage.toml").is_file()
    assert [row["number"] for row in run.checks] == [1, 1, 1, 1], "the last check"


def test_a_crooked_stage_is_written_down_and_complained_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = rig_in(tmp_path, emulation="stage = { scale_errors = [0.012, 0.0, 0.0, 0.0] }")
    command = ["calibrate", "stage", "--rig", str(rig), "--out", str(tmp_path / "stage.toml")]
    assert main(command) == 1
    said = capsys.readouterr()
    assert "SIGNIFICANT" in said.out
    assert "scale x +1.2" in said.err
    assert "Set its steps per mm" in said.err
    assert load_registration(tmp_path / "stage.toml").diagnostics[0].value == pytest.approx(
        0.012, abs=1e-3
    )
    assert main(command) == 2, "a file that is there is not written over"


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--at=0,0", "--at=80,0"], "three or more"),
        (["--at=-80,0", "--at=0,0", "--at=80,0"], "nearly on a line"),
        (["--layout", "table-5-2"], "table-5-2"),
        (["--teat", "9"], "has 4 teats"),
    ],
)
def test_positions_that_register_nothing_are_refused(
    tmp_path: Path, more: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", "stage", "--out", str(tmp_path / "stage.toml"), *more]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "stage.toml").exists()


def test_a_registration_of_another_arm_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    registration = replace(registered(stage_of(rng), rng), serial_number="55555")
    write_registration(tmp_path / "stage.toml", registration)
    run = done(
        rig_in(tmp_path),
        script_in(tmp_path, 'mode = "carry"\nregistration = "stage.toml"', ""),
        tmp_path,
    ).run
    assert run.ending == "faulted"
    (fault,) = [event["text"] for event in run.events if event["kind"] == "fault"]
    assert "was made with the arm 55555, but the arm that answers is 40937" in fault
    assert "calibrate stage" in fault


def test_a_trial_without_truth_is_left_out_with_its_reason_and_the_run_goes_on(
    tmp_path: Path,
) -> None:
    def once(trial: PlannedTrial) -> None:
        if trial is PLANNED[0]:
            raise NoTruthError("truth", "teat 2: 7 of 7 touches could not be used")

    told = Context(tmp_path)
    all_of, store = attempts(told, once), told.store
    for trial in PLANNED[:2]:
        all_of.run(trial)
    store.close()
    with closing(sqlite3.connect(store.folder / DATABASE)) as db:
        rows = [
            dict(zip(("trial", "reason"), row, strict=True))
            for row in db.execute("SELECT trial, reason FROM skipped")
        ]
    assert [row["trial"] for row in rows] == [PLANNED[0].id]
    assert told.events == [
        f"skipped {PLANNED[0].id}: truth: teat 2: 7 of 7 touches could not be used"
    ]
    run = RunRecord(tmp_path, {}, (), tuple(rows), (), (), np.zeros((0, 3)), (), np.zeros(0), None)
    (notes,) = deviation_parts(run)
    assert isinstance(notes, Notes)
    assert notes.items == (
        f"{PLANNED[0].id} has no truth: teat 2: 7 of 7 touches could not be used",
    )


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        ('mode = "carry"', "carry needs a registration"),
        ('mode = "carry"\nregistration = "none.toml"', "no such file beside the script"),
        ("check_every = 3", "only for mode"),
        (
            'mode = "carry"\nregistration = "first"\nregistration_at_mm = [[0.0, 0.0]]',
            "registration_at_mm",
        ),
        ('mode = "tuoch"', "carry"),
    ],
)
def test_a_script_that_asks_for_what_can_t_be_is_refused(
    tmp_path: Path, truth: str, said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        load_script(script_in(tmp_path, truth))


def test_carry_without_a_stage_is_refused_before_anything_is_opened(tmp_path: Path) -> None:
    rig = rig_in(tmp_path)
    rig.write_text(
        rig.read_text(encoding="utf-8").replace('[stage]\nurl = "emulator:"\n', ""),
        encoding="utf-8",
    )
    with pytest.raises(ConfigError, match="needs a stage"):
        refuse_carry(load_rig(rig), load_script(script_in(tmp_path, CARRY)))
