"""The plane map of 156 poses, emulated, scored and reported: seconds, printed beside the aim and not
asserted.
"""

from __future__ import annotations

import io
import time
from pathlib import Path

from pytest_benchmark.fixture import BenchmarkFixture
from rich.console import Console

from bench.cli.terminal import TerminalProgress
from bench.record.reader import read_run
from bench.report.page import write_run_report
from bench.rig.loading import find_rig, load_rig
from bench.run.start import run_script
from bench.script.model import find_script, load_script
from tests.benchmarks.figures import figure, taken_s


def run(out: Path) -> Path:
    """The plane map on the emulated rig; gives back the run's folder."""
    with TerminalProgress(Console(file=io.StringIO())) as progress:
        folder, _ = run_script(
            load_rig(find_rig(None)), load_script(find_script("plane-map")), out, progress
        )
    return folder


def test_the_plane_map(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    spent_s: list[float] = []

    def whole() -> Path:
        before_s = time.process_time()
        folder = run(tmp_path)
        write_run_report(folder)
        spent_s.append(time.process_time() - before_s)
        return folder

    folder = benchmark.pedantic(whole, rounds=1)
    assert len(read_run(folder).trials) == 156
    figure(
        benchmark,
        "plane map of 156 poses, emulated, scored and reported, s",
        taken_s(benchmark, "mean"),
        "at most 60 s",
    )
    figure(
        benchmark,
        "the same in seconds of one processor",
        spent_s[0],
        "less than the above; more means that the machine was busy",
    )
