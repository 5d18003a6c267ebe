"""A script of one trial is told of as one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.bench.commands import Said
from tests.bench.operated_runs import ONE, files
from tests.plain_text import plain_text


@pytest.mark.slow
def test_no_command_speaks_of_1_trials(tmp_path: Path, said: Said) -> None:
    run = files(tmp_path, script=ONE)
    shown = said(0, "{}", run).out
    shown += said(0, "{} --dry-run", run).out
    shown += said(0, "trials show {}", tmp_path / "script.toml").out
    assert "1 trial " in shown
    for page in tmp_path.rglob("report/*.html"):
        shown += plain_text(page)
    assert re.findall(r".{20}(?<! of )\b1 \w+[a-z]s\b.{20}", shown) == []
