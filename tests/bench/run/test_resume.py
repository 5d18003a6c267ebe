"""`teatbench resume` after any death: the run goes on at its first trial without a result, and ends
as if nothing had been.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bench.cli.main import main
from bench.config import ConfigError
from bench.record.reader import read_run
from bench.run.engine import Ending
from bench.run.lock import locked, run_lock
from bench.run.resume import what_is_left
from bench.run.states import EVENT
from bench.run.trial import TrialRun
from bench.script.model import load_script
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
from tests.bench.operated_runs import CHECK_POINT, STAGE, files
from tests.conftest import ROOT

if sys.platform == "win32":
    pytest.skip("forks benches, and kills them", allow_module_level=True)

KILLS = int(os.environ.get("TEATBENCH_KILLS", "2"))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """The folder of a whole run in ``whole``, and how many steps its clock made."""
    folder = tmp_path_factory.mktemp("undisturbed")
    files(
        folder,
        stage=STAGE,
        check_point=CHECK_POINT,
        touches=2,
        emulation="placement_error_mm = 1.0\nprompt_s = 2.0",
    )
    return folder, steps_of(lambda: start(folder, "whole"))


@pytest.mark.timeout(max(120, 60 * KILLS))
def test_killed_at_random_moments_and_resumed_equals_undisturbed(
    undisturbed: tuple[Path, int],
) -> None:
    folder, steps = undisturbed
    wanted = results(only_run(folder, "whole"))
    assert all(
        wanted[table]
        for table in ("trials", "frames", "touches", "truth", "detections", "scores", "bath")
    )
    for number, step in enumerate(np.random.default_rng(9).integers(1, steps, KILLS).tolist()):
        out = f"killed-{number}"
        assert killed_at(step, lambda out=out: start(folder, out)), step  # type: ignore[misc]
        if not (folder / out).is_dir():
            continue  # before there was a run at all
        assert resume(folder, out)[1] is Ending.FINISHED, step
        assert results(only_run(folder, out)) == wanted, f"killed at step {step} of {steps}"


def test_two_runs_with_one_seed_are_the_same_but_for_real_time(
    undisturbed: tuple[Path, int],
) -> None:
    folder, _ = undisturbed
    start(folder, "twin")
    one, other = (read_run(only_run(folder, out)) for out in ("whole", "twin"))
    assert results(one.folder) == results(other.folder)
    assert [(e["t_s"], e["kind"], e["text"]) for e in one.events] == [
        (e["t_s"], e["kind"], e["text"]) for e in other.events
    ]
    for trial in one.trials:
        for frame in trial.frames:
            assert (one.folder / frame["path"]).read_bytes() == (
                other.folder / frame["path"]
            ).read_bytes()
    assert one.head is not None
    assert other.head is not None
    assert one.head.digest == other.head.digest, "the chain without real time"


def test_killed_twice_on_its_way_and_once_while_it_catches_up(
    undisturbed: tuple[Path, int],
) -> None:
    folder, steps = undisturbed
    assert killed_at(int(0.9 * steps), lambda: start(folder, "often"))
    assert killed_at(int(0.3 * steps), lambda: resume(folder, "often"))
    progress = Silent()
    assert resume(folder, "often", progress)[1] is Ending.FINISHED
    run = read_run(only_run(folder, "often"))
    assert results(run.folder) == results(only_run(folder, "whole"))
    assert not progress.warned
    assert len(run.facts["deaths"]) == 1, "the death amid catching up is no trial's"
    assert [event["text"] for event in run.events if event["kind"] == "resumed"] == [
        (
            f"session 3 goes on after {len(run.trials) - 1} trials, gone through again on the emulated"
            " rig: 2 with the same touches"
        )
    ]


def test_a_trial_that_killed_the_bench_twice_is_skipped_and_reported(
    undisturbed: tuple[Path, int],
) -> None:
    folder, _ = undisturbed
    poison = "002-place-2-1"
    for begin in (start, resume, resume):
        killed = killed_while(
            f"'{poison}'",
            "_store_trial",
            TrialRun,
            lambda begin=begin: begin(folder, "poison"),  # type: ignore[misc]
        )
        assert killed is (
            begin is start or len(read_run(only_run(folder, "poison")).facts.get("deaths", {})) < 2
        )
    run = read_run(only_run(folder, "poison"))
    assert run.ending == "finished"
    assert [trial.id for trial in run.trials] == ["001-place-1-1", "003-place-3-1"]
    assert [(row["trial"], row["reason"]) for row in run.skipped] == [
        (poison, "the bench died in it 2 times, and doesn't try it again")
    ]
    assert main(["report", str(run.folder)]) in (0, 1, 4)
    assert "died in it 2 times" in (run.folder / "report" / "index.html").read_text(
        encoding="utf-8"
    )


def test_nothing_is_left_of_a_finished_run(
    undisturbed: tuple[Path, int], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = undisturbed
    assert main(["resume", str(only_run(folder, "whole"))]) == 2
    assert "is finished: nothing is left to do" in capsys.readouterr().err


def test_a_run_that_is_under_way_is_left_alone(
    undisturbed: tuple[Path, int], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = undisturbed
    assert killed_at(200, lambda: start(folder, "busy"))
    run = only_run(folder, "busy")
    before = read_run(run)
    with locked(run_lock(run), "somebody", print):
        command = [sys.executable, "-m", "bench.cli", "resume", str(run)]
        said = subprocess.run(
            command, capture_output=True, text=True, cwd=ROOT, timeout=60, check=False
        )
    assert said.returncode == 3
    assert "run: another bench has it" in said.stderr
    assert read_run(run).facts == before.facts


def test_a_rig_or_script_that_has_changed_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files(tmp_path)
    assert killed_at(10, lambda: start(tmp_path))
    run = only_run(tmp_path, "runs")
    script = tmp_path / "script.toml"
    script.write_text(
        script.read_text(encoding="utf-8").replace("x_mm = 12.0", "x_mm = 11.0"), encoding="utf-8"
    )
    assert main(["resume", str(run)]) == 2
    assert "script.toml has changed since the run" in capsys.readouterr().err
    script.unlink()
    assert main(["resume", str(run)]) == 2
    assert f"a copy of it is {run / 'script.toml'}" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="is no run"):
        what_is_left(tmp_path, [])


def test_states_of_a_resumed_run_are_in_its_record(undisturbed: tuple[Path, int]) -> None:
    folder, _ = undisturbed
    run = read_run(only_run(folder, "whole"))
    planned = [trial.id for trial in load_script(folder / "script.toml").planned]
    assert [event["text"] for event in run.events if event["kind"] == EVENT] == [
        "preparing",
        "settling",
        "running",
        "safing",
        "finished",
    ]
    assert [trial.id for trial in run.trials] == planned
