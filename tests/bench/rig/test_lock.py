"""Two benches never have one rig: the second is told who has it; a dead bench's lock is taken
over.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from filelock import FileLock

from bench.config import ConfigError
from bench.record.state import holder_of, still_runs, this_process
from bench.rig.loading import find_rig, load_rig
from bench.rig.lock import RigInUseError, lock_path, locked
from tests.bench.commands import Said
from tests.bench.operated_runs import files
from tests.conftest import ROOT
from tests.waiting import PATIENCE_S, within

HOLDER = """
import sys, time
from pathlib import Path
from bench.rig.lock import locked
with locked(Path(sys.argv[1]), "runs/here", print):
    print("held", flush=True)
    sys.stdin.readline()
"""


def holder(path: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", HOLDER, str(path)]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def refused(path: Path, why: str, error: type[Exception] = RigInUseError) -> None:
    with pytest.raises(error, match=why), locked(path, "x", print):
        pass


def taken_over(path: Path) -> list[str]:
    """What is told when the lock is taken and given back."""
    note = list[str]()
    with locked(path, "x", note.append):
        pass
    return note


@pytest.mark.slow
def test_the_lock_of_a_bench_that_was_killed_is_taken_over_and_that_is_reported(
    tmp_path: Path,
) -> None:
    path = tmp_path / "lab.lock.json"
    first = holder(path)
    first.kill()
    first.communicate(timeout=PATIENCE_S)
    (note,) = taken_over(path)
    assert f"the lock of a bench that died (pid {first.pid}" in note


def test_who_has_ended_or_has_a_dead_bench_s_number_is_no_bench_that_lives() -> None:
    me = this_process()
    assert still_runs(me)
    assert not still_runs(me | {"created": me["created"] - 3600.0}), "its number is another's now"
    assert not still_runs({"host": me["host"], "run": "what it wrote can't be read"})
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        assert still_runs({"pid": child.pid})
        child.kill()
        within(lambda: not still_runs({"pid": child.pid}), "it has ended, unwaited for")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems need no /proc")
def test_without_proc_a_bench_still_says_who_it_is_and_a_dead_one_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(psutil, "PROCFS_PATH", str(tmp_path))
    me = this_process()
    assert (me["pid"], me["created"]) == (os.getpid(), None)
    assert still_runs(me)
    with subprocess.Popen([sys.executable, "-c", ""]) as child:
        child.wait(PATIENCE_S)
    assert not still_runs({"pid": child.pid})
    assert not still_runs({"pid": 2**70})


def test_a_lock_of_another_machine_is_believed(tmp_path: Path) -> None:
    path = tmp_path / "lab.lock.json"
    path.write_text(json.dumps({"host": "another", "pid": 1}), encoding="utf-8")
    refused(path, rf"pid 1, host another.*delete .*{path.name}")


def test_a_file_that_says_nothing_understandable_is_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "lab.lock.json"
    path.write_text("{half", encoding="utf-8")
    assert "can't be read" in taken_over(path)[0]


def test_an_emulated_rig_needs_none_and_a_folder_that_is_not_there_is_reported(
    tmp_path: Path,
) -> None:
    assert lock_path(load_rig(find_rig(None))) is None
    assert holder_of(tmp_path) == {}, "a scored recording never had one"
    with locked(None, "x", print):
        pass
    refused(tmp_path / "no" / "lab.lock.json", "the rig can't be locked", ConfigError)


@pytest.mark.slow
def test_a_second_run_names_who_has_the_rig_opens_nothing_and_gets_it_when_that_one_ends(
    tmp_path: Path, said: Said
) -> None:
    arguments, rig = files(tmp_path, operator="console:"), tmp_path / "rig.toml"
    # nobody is there, and nobody is asked
    urls = iter(["socket://127.0.0.1:9", "tcp://127.0.0.1:9", "recording:frames"])
    text = re.sub('"emulator:"', lambda _: f'"{next(urls)}"', rig.read_text(encoding="utf-8"))
    text = text.replace("[bath]", '[bath]\ncut_out_tested = "2024-03-01"')
    text = text.replace("bath_start_c = 33.0", "").replace("[emulation]", "")
    rig.write_text(text, encoding="utf-8")
    first, note = holder(path := rig.with_name("rig.lock.json")), list[str]()
    assert f"rig: another bench has it: pid {first.pid}" in said(3, "{}", arguments).err
    assert not (tmp_path / "runs").exists()
    refused(path, rf"another bench has it: pid {first.pid}, host {platform.node()}.*runs/here")
    first.communicate("\n", 60)
    with locked(path, "x", note.append):
        assert json.loads(path.read_text(encoding="utf-8"))["pid"] == os.getpid()
    assert note == [], "it was given back in order"
    assert path.read_bytes() == b""


def test_a_folder_that_knows_no_locks_is_no_bench_that_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lockless(_: FileLock) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(FileLock, "_acquire", lockless)
    why = "the rig can't be locked: No locks available"
    refused(tmp_path / "lab.lock.json", why, ConfigError)
