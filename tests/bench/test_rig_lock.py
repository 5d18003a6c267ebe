"""Two benches never have one rig: the second is told who has it; a dead bench's lock is taken over."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from bench.config import ConfigError
from bench.rig import find_rig, load_rig
from bench.running.rig_lock import RigInUseError, lock_path, locked
from tests.conftest import ROOT

HOLDER = """
import sys, time
from pathlib import Path
from bench.running.rig_lock import locked
with locked(Path(sys.argv[1]), "runs/here", print):
    print("held", flush=True)
    sys.stdin.readline()
"""


def holder(path: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", HOLDER, str(path)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_the_second_bench_is_told_who_has_the_rig_and_gets_it_when_that_one_ends(tmp_path: Path) -> None:
    path, told = tmp_path / "lab.lock.json", list[str]()
    first = holder(path)
    who = rf"another bench has it: pid {first.pid}, host {platform.node()}.*runs/here"
    with pytest.raises(RigInUseError, match=who), locked(path, "x", told.append):
        pass
    first.communicate("\n", 20)
    with locked(path, "x", told.append):
        assert json.loads(path.read_text(encoding="utf-8").rstrip("\0"))["pid"] == os.getpid()
    assert told == [], "it was given back in order"
    assert path.read_bytes() == b""


def test_the_lock_of_a_bench_that_was_killed_is_taken_over_and_that_is_told(tmp_path: Path) -> None:
    path, told = tmp_path / "lab.lock.json", list[str]()
    first = holder(path)
    first.kill()
    first.communicate(timeout=60)
    with locked(path, "x", told.append):
        pass
    assert len(told) == 1
    assert f"the lock of a bench that died (pid {first.pid}" in told[0]


def test_a_lock_of_another_machine_is_believed(tmp_path: Path) -> None:
    path = tmp_path / "lab.lock.json"
    path.write_text(json.dumps({"host": "another", "pid": 1}), encoding="utf-8")
    with pytest.raises(RigInUseError, match=rf"pid 1, host another.*delete .*{path.name}"), locked(path, "x", print):
        pass


def test_a_file_that_says_nothing_understandable_is_taken_over(tmp_path: Path) -> None:
    path, told = tmp_path / "lab.lock.json", list[str]()
    path.write_text("{half", encoding="utf-8")
    with locked(path, "x", told.append):
        pass
    assert "can't be read" in told[0]


def test_an_emulated_rig_needs_none_and_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    assert lock_path(load_rig(find_rig(None))) is None
    with locked(None, "x", print):
        pass
    with pytest.raises(ConfigError, match="the rig can't be locked"), locked(tmp_path / "no" / "lab.lock.json", "x", print):
        pass
