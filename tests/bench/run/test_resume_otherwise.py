"""Resuming where the world went on without the bench, as in real time, and with a truth that the
stage carries.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from bench.record.check import check_run
from bench.record.reader import RunRecord, read_run
from bench.record.writer import Store
from bench.run.engine import Ending
from bench.run.start import RunOptions, resume_run
from bench.truth.carrying import REFERENCE_FACT
from tests.bench.killed_runs import (
    Silent,
    killed_at,
    killed_while,
    only_run,
    results,
    resume,
    start,
    steps_of,
)
from tests.bench.operated_runs import CHECK_POINT, SCRIPT, STAGE, files

if sys.platform == "win32":
    pytest.skip("forks benches, and kills them", allow_module_level=True)

from bench.run.trial import TrialRun

KILLS = int(os.environ.get("TEATBENCH_KILLS", "1"))
CARRY = SCRIPT.replace(
    "poses = [{ x_mm = 12.0, y_mm = -8.0 }, { x_mm = -15.0, z_mm = 6.0, yaw_deg = 4.0 }, {}]",
    "poses = [{ x_mm = 12.0, y_mm = -8.0 }, { x_mm = -15.0 }, {}]",
).replace(
    "[[requirements]]", '[truth]\nmode = "carry"\nregistration = "first"\n\n[[requirements]]', 1
)


def killed_in_the_last_trial(folder: Path, out: str) -> RunRecord:
    assert killed_while("'003-place-3-1'", "_store_trial", TrialRun, lambda: start(folder, out))
    return read_run(only_run(folder, out))


def test_a_world_that_went_on_is_prepared_anew_and_what_is_redone_is_kept_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files(tmp_path, stage=STAGE, check_point=CHECK_POINT)
    before = killed_in_the_last_trial(tmp_path, "runs")
    kept = results(before.folder)
    # nothing is gone through again
    monkeypatch.setattr("bench.run.start.in_virtual_time", lambda *_, **__: False)
    assert resume(tmp_path, "runs")[1] is Ending.FINISHED
    after = read_run(before.folder)
    assert [trial.id for trial in after.trials] == [
        "001-place-1-1",
        "002-place-2-1",
        "003-place-3-1",
    ]
    now = results(after.folder)
    for table in ("trials", "frames", "touches", "truth", "detections", "found", "scores"):
        assert all(row in now[table] for row in kept[table]), (
            f"nothing finished is lost or changed: {table}"
        )
    assert after.facts["arm check before"] == before.facts["arm check before"]
    assert len(after.facts["arm check before, session 2"]["touches"]) == 2
    assert after.facts["identities, session 2"] == after.facts["identities"]
    assert [event["text"] for event in after.events if event["kind"] == "resumed"] == [
        "session 2 goes on after 2 trials"
    ]


def test_a_carried_truth_goes_on_either_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files(tmp_path, stage=STAGE, script=CARRY)
    start(tmp_path, "whole")
    wanted = results(only_run(tmp_path, "whole"))
    assert wanted["checks"]
    assert [trial.how for trial in read_run(only_run(tmp_path, "whole")).trials] == [
        "touched",
        "carried",
        "carried",
    ]
    killed_in_the_last_trial(tmp_path, "caught-up")
    assert resume(tmp_path, "caught-up")[1] is Ending.FINISHED
    assert results(only_run(tmp_path, "caught-up")) == wanted
    left = killed_in_the_last_trial(tmp_path, "went-on")
    monkeypatch.setattr("bench.run.start.in_virtual_time", lambda *_, **__: False)
    resume(tmp_path, "went-on")
    after = read_run(left.folder)
    assert [trial.how for trial in after.trials] == ["touched", "carried", "carried"], (
        "the reference of the record is used further"
    )
    assert after.facts[REFERENCE_FACT]["trial"] == "001-place-1-1"
    assert {check["held"] for check in after.checks} <= {0, 1}
    assert after.checks[-1]["after_trial"] == "003-place-3-1"


@pytest.mark.parametrize(
    ("limit_mm", "kind"),
    [(1.5, "check touch"), (0.01, "invalid")],
    ids=["a check that holds", "a check that fails"],
)
def test_killed_just_after_a_check_of_the_carried_truth(
    tmp_path: Path, limit_mm: float, kind: str
) -> None:
    """The check is in the record, the trial that it came before is not: gone through again, it is
    not written a second time.
    """
    files(
        tmp_path,
        stage=STAGE,
        script=CARRY.replace(
            'mode = "carry"', f'mode = "carry"\ncheck_every = 1\ncheck_limit_mm = {limit_mm}'
        ),
    )
    start(tmp_path, "whole")
    wanted = results(only_run(tmp_path, "whole"))
    assert killed_while(f"'{kind}'", "event", Store, lambda: start(tmp_path, "runs"))
    assert read_run(only_run(tmp_path, "runs")).checks
    assert resume(tmp_path, "runs")[1] is Ending.FINISHED
    assert results(only_run(tmp_path, "runs")) == wanted
    assert check_run(only_run(tmp_path, "runs")).whole


@pytest.mark.timeout(max(120, 60 * KILLS))
def test_killed_at_random_moments_with_a_carried_truth_equals_undisturbed(tmp_path: Path) -> None:
    files(
        tmp_path,
        stage=STAGE,
        script=CARRY.replace('mode = "carry"', 'mode = "carry"\ncheck_every = 1'),
    )
    steps = steps_of(lambda: start(tmp_path, "whole"))
    wanted = results(only_run(tmp_path, "whole"))
    for number, step in enumerate(np.random.default_rng(14).integers(1, steps, KILLS).tolist()):
        out = f"killed-{number}"
        assert killed_at(step, lambda out=out: start(tmp_path, out)), step  # type: ignore[misc]
        if (tmp_path / out).is_dir():
            assert resume(tmp_path, out)[1] is Ending.FINISHED, step
            assert results(only_run(tmp_path, out)) == wanted, f"killed at step {step} of {steps}"


def test_a_run_that_somebody_ended_goes_on_too(tmp_path: Path) -> None:
    files(tmp_path)

    class Leaves(Silent):
        def trial(self, done: int, total: int, name: str) -> None:
            self.left = name == "place-3"

        def typed(self) -> str | None:
            return "abort" if getattr(self, "left", False) else None

    from bench.rig.loading import load_rig
    from bench.run.start import run_script
    from bench.script.model import load_script

    person = Leaves()
    folder, ending = run_script(
        load_rig(tmp_path / "rig.toml"),
        load_script(tmp_path / "script.toml"),
        tmp_path / "runs",
        person,
        RunOptions(typed=person.typed),
    )
    assert (ending, len(read_run(folder).trials)) == (Ending.ABORTED, 2)
    assert resume_run(folder, Silent(), RunOptions())[1] is Ending.FINISHED
    run = read_run(folder)
    assert len(run.trials) == 3
    assert "deaths" in run.facts
    assert not run.facts["deaths"], "an end that was asked for is no death"
