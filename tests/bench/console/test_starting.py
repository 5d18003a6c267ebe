"""A run that the page starts goes on without the console's window."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest

from bench.console.starting import start
from instruments.clock import RealClock

FLAGS = {"CREATE_NEW_PROCESS_GROUP": 0x0000_0200, "CREATE_NO_WINDOW": 0x0800_0000}  # winbase.h


def test_it_shares_neither_session_nor_window(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[str, Any] = {}

    class Started:
        def __init__(self, _: list[str], **settings: Any) -> None:
            given.update(settings)
            settings["stdout"].write(b"Run folder: runs/a-run\n")
            settings["stdout"].flush()

        def poll(self) -> None:
            """It goes on."""

    monkeypatch.setattr(subprocess, "Popen", Started)
    for name, value in FLAGS.items():
        monkeypatch.setattr(subprocess, name, value, raising=False)
    assert start(["run", "demo"], tmp_path, RealClock()) == "a-run"
    assert given["start_new_session"]
    assert given["creationflags"] == sum(FLAGS.values())
