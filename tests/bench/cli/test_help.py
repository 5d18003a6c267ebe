"""`--help`: commands by task, and an example of each that can be given as it stands; what
a shell is given for a line.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from argcomplete.shell_integration import shellcode

from bench.cli.commands import COMMANDS, TASKS
from bench.cli.main import parser
from tests.bench.commands import Said
from tests.conftest import ROOT


def test_every_command_belongs_to_one_task(said: Said) -> None:
    firsts = [name for names in TASKS.values() for name in names]
    assert sorted(firsts) == sorted({name.split()[0] for name in COMMANDS})
    seen = said(0, "--help").out
    assert re.findall(r"^([a-z ]+):$", seen, re.MULTILINE) == [*TASKS, "options"]
    assert seen.count("example: teatbench ") == len(TASKS)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_example_in_a_commands_help_is_taken(name: str, said: Said) -> None:
    (example,) = re.findall(r"^example: teatbench (.+)$", said(0, f"{name} --help").out, re.M)
    assert example.split()[: len(name.split())] == name.split()
    parser().parse_args(shlex.split(example))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("teatbench ca", {"calibrate", "camera", "campaign"}),
        ("teatbench store export r --fo", {"--format"}),
    ],
)
def test_bash_completes_a_line_by_argcomplete(line: str, offered: set[str], tmp_path: Path) -> None:
    program = tmp_path / "teatbench"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m bench.cli "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    asked = f"""{shellcode(["teatbench"])}
COMP_LINE='{line}'; COMP_POINT={len(line)}; COMP_TYPE=9; _python_argcomplete teatbench
printf '%s\\n' "${{COMPREPLY[@]}}" """
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", asked],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)},
        check=True,
    )
    assert {word.strip() for word in done.stdout.splitlines()} == offered, done
