"""By how much the memory of a run grows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from bench.cli.main import main
from bench.run.trial import TrialRun
from bench.script.planned_trials import PlannedTrial
from tests.benchmarks.figures import figure
from tests.conftest import resident_mib


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
