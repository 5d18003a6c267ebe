"""A test that takes too long fails with its traceback, and the others go on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

pytestmark = pytest.mark.slow


def run_tests(folder: Path, text: str, *options: str) -> str:
    """What pytest prints of a file of tests under the project's own settings."""
    (folder / "test_slow.py").write_text(text, encoding="utf-8")
    settings = ["-c", str(ROOT / "pyproject.toml"), "--rootdir", str(folder), "--timeout", "1"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *settings, *options, "-p", "no:cacheprovider", "."],
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    return done.stdout + done.stderr


@pytest.mark.skipif(
    not hasattr(signal, "SIGALRM"),
    reason="pytest-timeout kills the process where there is no SIGALRM",
)
def test_a_timeout_costs_one_test(tmp_path: Path) -> None:
    printed = run_tests(
        tmp_path,
        "import time\n\ndef test_slow():\n    time.sleep(600)\n\ndef test_next():\n    pass\n",
    )
    assert "1 failed, 1 passed" in printed, printed
    assert "time.sleep(600)" in printed


@pytest.mark.weekly
def test_a_test_that_no_exception_ends_is_named_and_ends_the_run(tmp_path: Path) -> None:
    printed = run_tests(
        tmp_path,
        """
import time

def test_deaf():
    while True:
        try:
            time.sleep(600)
        except BaseException:
            pass
""",
        *("-o", "faulthandler_timeout=3", "-n", "1", "--max-worker-restart", "0"),
    )
    assert "crashed while running 'test_slow.py::test_deaf'" in printed, printed
    assert "in test_deaf" in printed


def test_a_test_with_more_time_of_its_own_has_it(tmp_path: Path) -> None:
    text = """
import time
import pytest

@pytest.mark.timeout(60)
def test_long():
    time.sleep(3)
"""
    watch = ("-o", "faulthandler_timeout=1")
    assert "1 passed" in run_tests(tmp_path, text, *watch, "-p", "tests.conftest")
