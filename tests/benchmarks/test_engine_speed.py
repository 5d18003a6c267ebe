"""What the engine itself costs: a trial without frames, touches or a detection, with its looks,
prompts, states and record; and by how much the memory of a run grows.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import pytest

from bench.cli.main import main
from bench.record.reader import TrialRecord
from bench.rig.loading import load_rig
from bench.run.events import RunState
from bench.run.start import run_queue
from bench.run.trial import TrialRun
from bench.script.model import load_script
from bench.script.planned_trials import PlannedTrial
from tests.bench.killed_runs import Silent
from tests.bench.operated_runs import SCRIPT, files
from tests.benchmarks.figures import figure
from tests.conftest import resident_mib

TRIALS = 300


def empty_trials(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """From now on a trial is its row alone; gives back when each began."""
    began: list[float] = []

    def run(trials: Any, trial: PlannedTrial) -> None:
        began.append(perf_counter())
        trials._ctx.check()
        trials._settle()
        trials._ctx.states.to(RunState.RUNNING)
        head = {
            "id": trial.id,
            "number": trial.number,
            "name": trial.name,
            "situation": trial.situation,
            "repeat": trial.repeat,
        }
        trials._ctx.store.finished(TrialRecord({**head, "wall_time": ""}))

    monkeypatch.setattr("bench.run.trial.TrialRun.run", run)
    return began


def test_overhead_of_a_trial_without_frames(
    benchmark: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = SCRIPT.replace("poses = [", f"repeats = {TRIALS // 3}\nposes = [")
    files(tmp_path, script=script)
    began = empty_trials(monkeypatch)
    rig, loaded = load_rig(tmp_path / "rig.toml"), load_script(tmp_path / "script.toml")
    benchmark.pedantic(lambda: run_queue(rig, [loaded], tmp_path / "runs", Silent()), rounds=1)
    assert len(began) == TRIALS
    in_order = [1e3 * (b - a) for a, b in pairwise(began)]
    figure(
        benchmark,
        "ms of the engine for a trial without frames, median",
        median(in_order),
        "at most 2",
    )
    third = TRIALS // 3
    ratio = median(in_order[-third:]) / median(in_order[:third])
    figure(benchmark, "the same, median of the last third over that of the first", ratio, "1")


def test_memory_of_the_demo(
    benchmark: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, after_mib = TrialRun.run, list[float]()

    def watched(trials: TrialRun, trial: PlannedTrial) -> None:
        run(trials, trial)
        after_mib.append(resident_mib())

    monkeypatch.setattr(TrialRun, "run", watched)
    benchmark.pedantic(main, (["run", "demo", "--out", str(tmp_path)],), rounds=1)
    figure(benchmark, "MiB more after its last", after_mib[-1] - after_mib[9], "0")
