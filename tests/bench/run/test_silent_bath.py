"""What the screen and a viewer are shown from the moment at which the bath's link dies."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from bench.record.reader import read_run
from bench.record.state import State
from bench.run.live import Live
from tests.bench.killed_runs import Silent, start
from tests.bench.operated_runs import files

SILENT = '[[emulation.faults]]\ninstrument = "bath"\nname = "silence"\nat_s = 45.0'
LAST = re.compile(r"bath: no answer for \d+ s \(last [\d.]+ degC\)")


class Screen(Silent):
    """Keeps what stood in the line, with the warnings among it."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def state(self, text: str) -> None:
        self.lines.append(text)

    def warn(self, text: str) -> None:
        super().warn(text)
        self.lines.append(f"WARNED {text}")


@pytest.mark.slow
def test_nothing_of_before_is_shown_once_the_bath_says_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lives: list[Any] = []
    monkeypatch.setattr(Live, "due", True)
    monkeypatch.setattr(Live, "write", lambda _self, state, _tip: lives.append(state))
    files(tmp_path, emulation=f"prompt_s = 5.0\n{SILENT}")
    screen = Screen()
    run = read_run(start(tmp_path, progress=screen)[0])
    assert run.state is State.TRIPPED
    (trip,) = [k for k, line in enumerate(screen.lines) if line.startswith("WARNED interlock")]
    shown = [line for line in screen.lines[trip:] if not line.startswith("WARNED")]
    safing = [line for line in shown if "going to safe" in line]
    assert len(safing) > 3, "again and again until it has given up"
    assert all(LAST.search(line) for line in safing), safing
    assert len(set(safing)) > 2, "the age goes on"
    for line in shown:
        assert " left" not in line, line
        assert "heating" not in line, line
    before = [line for line in screen.lines[:trip] if LAST.search(line)]
    assert before, "before the interlock trips, too"
    assert not any(" left" in line for line in before), before
    dead = [live for live in lives if live["bath"]["silence"]]
    assert {live["left_s"] for live in dead} == {None}
    assert all(live["instruments"]["bath"].startswith("no answer for") for live in dead)
    assert lives[-1]["state"] == "safing"
