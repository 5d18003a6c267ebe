"""A test that takes too long fails with its traceback, and the others go on; one that no exception
ends is named, with its traceback, and ends its worker.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

TESTS = """
import time

def test_slow():
    time.sleep(600)

def test_next():
    pass

def test_deaf():
    while True:
        try:
            time.sleep(500)
        except BaseException:
            pass
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux alone")
def test_a_timeout_costs_one_test_and_a_test_without_an_end_its_worker(tmp_path: Path) -> None:
    (tmp_path / "test_slow.py").write_text(TESTS, encoding="utf-8")
    settings = ["-c", str(ROOT / "pyproject.toml"), "--rootdir", str(tmp_path), "--timeout", "1"]
    options = ["-o", "faulthandler_timeout=3", "-p", "tests.workers", "--workers", "2"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *settings, *options, "-p", "no:cacheprovider", "."],
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    printed = done.stdout + done.stderr
    assert "2 failed, 1 passed" in printed, printed
    assert "time.sleep(600)" in printed
    assert "crashed while running 'test_slow.py::test_deaf'" in printed, printed
    assert "in test_deaf" in printed
