"""All commands with everything that can be wrong: one sentence, the exit code 2 for wrong use and 3
for an instrument that does not answer, no traceback, and nothing left behind.
"""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
import sys
import threading
import tomllib
from pathlib import Path
from unittest.mock import Mock

import pytest

from bench.cli.commands import table
from bench.cli.main import main
from bench.script.model import TRIALS
from tests.bench.commands import Said
from tests.bench.small_run import KEPT
from tests.conftest import ROOT
from tests.examples import few

TABLE = tomllib.loads((ROOT / "tests" / "data" / "wrong_use.toml").read_text(encoding="utf-8"))
WRONG_USE = TABLE["wrong_use"] | {
    word: f"'{word}' went: {use}" for word, use in table("removed").items()
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "code", "message"),
    [(c, n, m) for n, of in ((2, WRONG_USE), (3, TABLE["no_answer"])) for c, m in of.items()],
)
def test_wrong_use_gets_a_sentence_and_leaves_nothing_behind(
    command: str,
    code: int,
    message: str,
    said: Said,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n\n\n" if "--check 2000" in command else ""))
    (tmp_path / "there.toml").write_text("precious", encoding="utf-8")
    parts = re.split(r"(?=\[\[)", (TRIALS / "six-situations.toml").read_text(encoding="utf-8"))
    bare = "".join(part for part in parts if '"arm_verified"' not in part)
    (tmp_path / "bare.toml").write_text(bare, encoding="utf-8")
    before = threading.active_count()
    written = said(code, command)
    assert message in written.err
    if not command.startswith("arm"):
        assert written.out == "", "no empty bar beside a refusal"
    assert (tmp_path / "there.toml").read_text(encoding="utf-8") == "precious"
    assert {path.name for path in tmp_path.iterdir()} == {"there.toml", "bare.toml"}
    assert threading.active_count() == before


@pytest.mark.skipif(sys.platform != "linux", reason="needs a device that is no serial port")
def test_a_port_that_cannot_be_opened_is_named(said: Said) -> None:
    assert "the port can't be opened" in said(3, "arm read --port /dev/null --homed").err


READ = ("help record", "store check {run}", "report {run} --no-pdf", "runs {runs}")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="closes descriptors by a shell of POSIX")
@pytest.mark.parametrize("command", few(READ, 4))
def test_whoever_reads_on_the_exit_code_is_the_command_s(command: str, tmp_path: Path) -> None:
    shutil.copytree(KEPT, run := tmp_path / "runs" / "kept")
    words = [*command.format(run=run, runs=run.parent).split()]
    alone = [sys.executable, "-m", "bench.cli", *words]
    for closed in ("", "<&- >&- 2>&-"):
        read, write = os.pipe()
        os.close(read)
        asked = ["sh", "-c", f'exec "$@" {closed}', "sh", *alone]
        with os.fdopen(write) as nobody:
            ended = subprocess.run(asked, cwd=ROOT, stdout=nobody, stderr=subprocess.PIPE)
        assert (ended.returncode, ended.stderr) == (0, b""), closed
    assert main(["store", "check", str(run)]) == 0


NAMELESS = {"run": 'no trial script ""', "run --rig": 'no rig ""', "emulate": 'no rig ""'}
NAMELESS |= {"score": ". is no recording", "detect": ". is no recording", "report": ". is no run"}


@pytest.mark.parametrize("command", NAMELESS)
def test_a_name_too_long_or_empty_is_named(command: str, tmp_path: Path, said: Said) -> None:
    assert "disk full" not in said(2, f"{command} {{}}", tmp_path / ("long" * 80)).err
    assert NAMELESS[command] in said(2, f"{command} {{}}", "").err


def test_what_may_not_be_read(tmp_path: Path, said: Said, monkeypatch: pytest.MonkeyPatch) -> None:
    denied = Mock(side_effect=PermissionError(13, "Permission denied", str(tmp_path)))
    monkeypatch.setattr("bench.cli.main.call", denied)
    monkeypatch.setattr("bench.files.os.access", lambda *_: False)
    assert said(2, "runs").err.endswith(f"{tmp_path} can't be read: Permission denied\n")


def caused(error: Exception, by: Exception) -> Exception:
    error.__context__ = by
    return error


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        ImportError("libcv2.so: failed to map segment from shared object"),
        OSError(12, "Cannot allocate memory"),
        RuntimeError("OpenCV: Insufficient memory"),
        RuntimeError("can't start new thread"),
        caused(RuntimeError("cannot join thread before it is started"), MemoryError()),
    ],
)
def test_a_limit_of_memory_ends_with_a_sentence(
    error: Exception, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: object) -> None:
        raise error

    monkeypatch.setattr("bench.cli.main.call", fail)
    assert "out of memory: give the machine" in said(3, "runs").err


@pytest.mark.skipif(sys.platform == "win32", reason="Windows limits no process's addresses")
def test_under_a_limit_in_which_no_library_loads_nothing_is_begun(
    said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bench.cli.main.call", lambda _: pytest.fail("it was begun"))
    monkeypatch.setattr("resource.getrlimit", lambda _: (350_000 << 10, 350_000 << 10))
    refused = "341 MB of memory are allowed, 512 are needed: give the machine, or the limit"
    assert refused in said(3, "runs").err
