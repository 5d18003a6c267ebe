"""A script of one trial is told of as one."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench.commands import Said
from tests.bench.operated_runs import ONE, files


@pytest.mark.slow
def test_no_command_speaks_of_1_trials(tmp_path: Path, said: Said) -> None:
    run = files(tmp_path, script=ONE)
    shown = said(0, "{}", run).out
    shown += said(0, "{} --dry-run", run).out
    shown += said(0, "trials show {}", tmp_path / "script.toml").out
    assert "1 trial " in shown
    for wrong in ("1 trials", "1 poses"):
        assert wrong not in shown
