"""What the engine itself costs: a trial without frames, touches or a detection, with its looks, prompts, states and record."""

from __future__ import annotations

from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any

import pytest

from bench.jobs import run_script
from bench.planning import PlannedTrial
from bench.rig import load_rig
from bench.script import load_script
from bench.store import FinishedTrial
from tests.bench.operated_runs import SCRIPT, files
from tests.benchmarks.figures import figure

TRIALS = 300


class Quiet:
    """Shows nothing."""

    def state(self, text: str) -> None: ...
    def trial(self, done: int, total: int, name: str) -> None: ...
    def warn(self, text: str) -> None: ...
    def aside(self) -> nullcontext[None]:
        return nullcontext()


def empty_trials(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """From now on a trial is its row alone; gives back when each began."""
    began: list[float] = []

    def run(trials: Any, trial: PlannedTrial) -> None:
        began.append(perf_counter())
        trials._attention.check()
        trials._settle()
        trials._settle_again(trial.id)
        head = {"id": trial.id, "number": trial.number, "name": trial.name, "situation": trial.situation, "repeat": trial.repeat}
        trials._store.finished(FinishedTrial({**head, "wall_time": ""}, [], [], [], [], [], []))

    monkeypatch.setattr("bench.trial_run.TrialRun.run", run)
    return began


def test_overhead_of_a_trial_without_frames(benchmark: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = SCRIPT.replace("poses = [", f"repeats = {TRIALS // 3}\nposes = [")
    files(tmp_path, script=script)
    began = empty_trials(monkeypatch)
    rig, loaded = load_rig(tmp_path / "rig.toml"), load_script(tmp_path / "script.toml")
    benchmark.pedantic(lambda: run_script(rig, loaded, tmp_path / "runs", Quiet()), rounds=1)
    assert len(began) == TRIALS
    each_ms = sorted(1e3 * (b - a) for a, b in pairwise(began))
    figure(benchmark, "ms of the engine for a trial without frames, median", each_ms[len(each_ms) // 2], "at most 2")
    third, began = TRIALS // 3, began[5:]  # the first waited for the bath
    ratio = each_ms_of(began[-third:]) / each_ms_of(began[:third])
    figure(benchmark, "the same, mean of the last third over that of the first", ratio, "1")


def each_ms_of(began: list[float]) -> float:
    return 1e3 * (began[-1] - began[0]) / (len(began) - 1)
