"""The history of figures: a line for each that a run of the benchmarks has measured, added to the
file that TEATBENCH_HISTORY names (`.ci/weekly` names history.csv beside this).
"""

from __future__ import annotations

import csv
import os
import platform
import subprocess
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import cv2
import pytest

HEADS = ("date", "commit", "python", "processors", "load", "benchmark", "figure", "value")
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def one_core() -> Iterator[None]:
    """OpenCV works in one thread."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(threads)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A benchmark that failed has no line; its failure is the session's."""
    measured = getattr(session.config, "_benchmarksession", None)
    if (path := os.environ.get("TEATBENCH_HISTORY")) and measured and measured.benchmarks:
        note(Path(path), measured.benchmarks)


def note(path: Path, benchmarks: object) -> None:
    """Add the figures of pytest-benchmark's ``benchmarks`` to the table at ``path``."""
    new = not path.is_file()
    with path.open("a", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        if new:
            table.writerow(HEADS)
        table.writerows(_rows(benchmarks))


def _rows(benchmarks: object) -> Iterator[tuple[object, ...]]:
    load = round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else ""  # processes that wait
    date, python = f"{datetime.now(UTC):%Y-%m-%d}", platform.python_version()
    run = (date, _commit(), python, os.cpu_count(), load)
    for one in benchmarks:  # type: ignore[attr-defined]
        name = one.fullname.removeprefix("tests/benchmarks/")
        if one.stats and one.stats.data:
            yield *run, name, "median s", f"{one.stats.median:.4g}"
        for figure, value in one.extra_info.items():
            yield *run, name, figure, f"{value:.4g}" if isinstance(value, float) else value


def _commit() -> str:
    """With a + where files differ from it; "" outside of a clone."""
    told = ["git", "-C", str(ROOT), "describe", "--always", "--dirty=+"]
    return subprocess.run(told, capture_output=True, text=True, check=False).stdout.strip()
