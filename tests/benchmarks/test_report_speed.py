"""A report of 1 000 trials of two detectors with their frames: how long it takes, how large its page
is, how fast a browser has it. Printed, not asserted.

A short run's trials are told again under new names and as of other frames.
"""

from __future__ import annotations

import shutil
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from bench.cli.main import main
from bench.config import read_calibration
from bench.record.reader import RunRecord, read_run
from bench.report.beside import drawn_beside
from bench.report.growing import TrialParts
from bench.report.page import build_page
from bench.results.status import status_of
from bench.results.verdicts import judge, stored_rules
from reports.render import write_report
from tests.benchmarks.figures import beside_fixed, figure, taken_s
from tests.chromium import browser_page

TRIALS = 1_000


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, short_script: Path) -> RunRecord:
    out = tmp_path_factory.mktemp("long")
    two = ["--detector", "fused", "--detector", "thesis"]
    assert main(["run", str(short_script), "--out", str(out), *two]) in (0, 1, 4)
    (folder,) = out.iterdir()
    short = read_run(folder)
    shutil.rmtree(folder / "report")
    text = [short.trials[k % len(short.trials)] for k in range(TRIALS)]
    # each of a pose of its own, as drawn scenes are
    heads = [
        {**trial.head, "number": k, "name": name, "id": f"{k:04d}-{name}"}
        for k, trial in enumerate(text, 1)
        for name in [f"{trial.pose}-{k}"]
    ]
    return replace(
        short,
        trials=tuple(
            replace(trial, head=head, frames=[{**f, "sha256": head["id"]} for f in trial.frames])
            for trial, head in zip(text, heads, strict=True)
        ),
    )


def written(run: RunRecord, parts: TrialParts) -> Path:
    rules = stored_rules(run.folder)
    folder = run.folder / "report"
    calibration, judged = read_calibration(run.folder / "calibration.toml"), judge(run, rules)
    status = status_of(run, judged)
    with drawn_beside(parts.figures) as finished:
        page = build_page(run, status, rules, judged, calibration, folder, parts=parts)
        return write_report(page, folder, finished=finished)


def test_report_of_1000_trials_that_grew(benchmark: BenchmarkFixture, run: RunRecord) -> None:
    parts, begun_s = TrialParts(), time.process_time()
    parts.begin(TRIALS)
    parts.draw(run, TRIALS)
    each_ms = 1e3 * (time.process_time() - begun_s) / TRIALS
    figure(benchmark, "drawn between two trials, ms of a processor", each_ms, "at most 20")
    begun_s = time.process_time()
    with closing(parts):
        benchmark.pedantic(written, args=(run, parts), rounds=1, iterations=1)
    spent_s = time.process_time() - begun_s
    beside_fixed(benchmark, "report of 1 000 trials, what is left at the end", spent_s, "2")
    figure(benchmark, "the same by the clock, s", taken_s(benchmark, "max"), "2")


@pytest.mark.browser
def test_report_of_1000_trials(benchmark: BenchmarkFixture, run: RunRecord) -> None:
    begun_s = time.process_time()
    path = benchmark.pedantic(written, args=(run, TrialParts()), rounds=1, iterations=1)
    beside_fixed(benchmark, "report of 1 000 trials", time.process_time() - begun_s, "10")
    assert len(list((path.parent / "trials").iterdir())) == TRIALS
    assert path.stat().st_size <= 1_000_000  # no matter of speed, so it may be asserted
    figure(benchmark, "the same by the clock, s", taken_s(benchmark, "max"), "10")
    figure(benchmark, "its page, bytes", path.stat().st_size, "at most 1 000 000")
    with browser_page() as seen:
        page = seen.open(path)
        loaded_ms = page.evaluate(
            "() => performance.getEntriesByType('navigation')[0].loadEventEnd"
        )
        figure(benchmark, "its page loads in, s", loaded_ms / 1000, "at most 0.3")
        listed = seen.open(path.parent / "page-trials.html")
        trial = listed.locator("#trial-500 a").get_attribute("href")
        assert trial is not None
        seen.open(path.parent / trial)
        assert set(seen.image_widths().values()) == {640, 1360}
