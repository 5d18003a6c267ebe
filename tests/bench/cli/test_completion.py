"""`completion`: what bash is given for a line, and a script for each shell."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from bench.cli.commands import SHELLS
from bench.cli.completion import NO_RIGS as HIDDEN
from bench.rig.loading import NO_RIGS
from tests.bench.commands import Said
from tests.conftest import ROOT


@pytest.mark.parametrize("shell", SHELLS)
def test_each_shell_has_a_script(shell: str, said: Said) -> None:
    assert "teatbench" in said(0, f"completion {shell}").out


def test_what_is_no_rig_is_not_offered() -> None:
    assert set(HIDDEN) == set(NO_RIGS)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None or sys.platform == "win32", reason="needs bash")
@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("teatbench ca", ["calibrate", "camera"]),
        ("teatbench store export r --fo", ["--format"]),
        ("teatbench run six", ["six-situations"]),
        ("teatbench check emu", ["emulated"]),
        ("teatbench score r --detector thesis-p", ["thesis-published-homography"]),
    ],
)
def test_bash_completes_a_line(line: str, offered: list[str], tmp_path: Path) -> None:
    program = tmp_path / "teatbench"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m bench.cli "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    asked = f"""source <("{program}" completion bash); COMP_LINE='{line}'; COMP_POINT={len(line)}
COMP_TYPE=9; _python_argcomplete teatbench; printf '%s\\n' "${{COMPREPLY[@]}}" """
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", asked],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)},
        check=True,
    )
    assert set(offered) <= {word.strip() for word in done.stdout.splitlines()}, done


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("fish") is None, reason="needs fish")
def test_fish_completes_a_line(tmp_path: Path) -> None:
    program = tmp_path / "teatbench"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m bench.cli "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["fish", "-c", "teatbench completion fish | source; complete -C 'teatbench run six'"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)},
        check=True,
    )
    assert done.stdout.split() == ["six-situations"], done
