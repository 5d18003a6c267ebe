"""Whole commands as a user calls them: seconds and peak memory, printed beside the aims and not
asserted.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from statistics import median

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from tests.benchmarks.figures import PEAK_KIB, beside_fixed
from tests.conftest import ROOT

TRACED = ROOT / "tests/data/path_traced"
CHILDREN = ("children_user", "children_system")

CHILD = (
    PEAK_KIB
    + """
import runpy, sys
try:
    runpy.run_module("bench.cli", run_name="__main__", alter_sys=True)
finally:
    print("peak", peak_kib(), file=sys.stderr)
"""
)

START = """
import os, runpy, sys, time
def ends(event, arguments):
    if event == "tempfile.mkdtemp" and "teatbench-dry-run-" in arguments[0]:
        print("spent", time.process_time(), file=sys.stderr, flush=True)
        os._exit(0)
sys.addaudithook(ends)
runpy.run_module("bench.cli", run_name="__main__", alter_sys=True)
"""


def call(*arguments: str, child: str = CHILD) -> str:
    """Run a command in a fresh process; its standard error."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", child, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode in (0, 1, 4), done.stderr
    return done.stderr


def show(what: str, stderr: str, aim: str) -> None:
    peak_mib = int(stderr.split("peak ")[1].split()[0]) / 1024
    print(f"\n{what}: peak memory {peak_mib:.0f} MiB (aims: {aim})")


@pytest.mark.skipif(
    sys.platform == "win32", reason="the peak memory is read from the POSIX module resource"
)
def test_the_demo(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    stderr = benchmark.pedantic(lambda: call("run", "demo", "--out", str(tmp_path)), rounds=1)
    show("demo, 60 scenes, two detectors", stderr, "at most 30 s, under 1024 MiB")


@pytest.mark.skipif(
    sys.platform == "win32", reason="the peak memory is read from the POSIX module resource"
)
def test_help(benchmark: BenchmarkFixture) -> None:
    stderr = benchmark.pedantic(lambda: call("--help"), rounds=5, warmup_rounds=1)
    show("teatbench --help", stderr, "at most 0.3 s")


@pytest.mark.parametrize("detector", ["fused", "thesis"])
def test_detect_on_one_frame(benchmark: BenchmarkFixture, tmp_path: Path, detector: str) -> None:
    shutil.copytree(TRACED / "frames/0000", tmp_path / "frames/0000")
    shutil.copy(TRACED / "calibration.toml", tmp_path)
    before = os.times()
    told = ("detect", str(tmp_path), "--detector", detector)
    benchmark.pedantic(lambda: call(*told), rounds=5, iterations=1)
    after = os.times()
    spent_s = sum(getattr(after, of) - getattr(before, of) for of in CHILDREN) / 5
    beside_fixed(benchmark, f"detect on one frame, {detector}", spent_s, "0.8")


def test_start_of_a_dry_run(benchmark: BenchmarkFixture) -> None:
    """Until its rehearsal makes its folder: files are read, poses looked at, detectors made."""
    spent_s: list[float] = []

    def start() -> None:
        stderr = call("run", "six-situations", "--dry-run", child=START)
        spent_s.append(float(stderr.split("spent ")[1].split()[0]))

    benchmark.pedantic(start, rounds=15, warmup_rounds=2)
    beside_fixed(benchmark, "start of a dry run", median(spent_s[2:]), "0.5")
