"""`--help`: commands by task, and an example of each that can be given as it stands; `completion`:
what a shell is given for a line, and a script for each.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from bench.cli.commands import COMMANDS, NEXT, SHELLS, TASKS
from bench.cli.completion import NO_RIGS as HIDDEN
from bench.cli.main import main, parser
from bench.cli.manual import topics
from bench.rig.loading import NO_RIGS
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


CAPITALS = {"RIG": "emulated", "RUN": "runs/1", "X": "1", "Y": "1"}
VALUES = {"port": "COM5", "profile": "julabo-presto", "script": "plane-map", "rig": "emulated"}


@pytest.mark.parametrize("name", COMMANDS)
def test_the_next_two_commands_can_be_given(name: str) -> None:
    for text in NEXT[name]:
        filled = re.sub(r"\{(\w+)\}", lambda found: VALUES.get(found[1], "a"), text)
        words = [CAPITALS.get(word, word) for word in shlex.split(filled)]
        given = parser().parse_args(words)
        if given.called == "help" and given.topic:
            assert given.topic in topics()


def test_a_person_is_told_what_comes_next(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["trials", "show", "demo"]) == 0
    assert "Then" not in capsys.readouterr().out
    monkeypatch.setattr(type(sys.stdout), "isatty", lambda _: True, raising=False)
    assert main(["trials", "show", "demo"]) == 0
    then = capsys.readouterr().out.partition("Then, for instance:\n")[2]
    assert then == "  teatbench run demo --rig RIG --dry-run\n  teatbench run demo --rig RIG\n"
    assert main(["trials", "--json"]) == 0
    assert "Then" not in capsys.readouterr().out


def test_a_page_of_the_documentation_is_shown_offline(said: Said) -> None:
    listed = said(0, "help").out
    pages = sorted(path.stem for path in (ROOT / "docs").glob("*.md"))
    assert [line.partition(":")[0] for line in listed.splitlines()[:-1]] == pages
    assert said(0, "help record").out.startswith("# Record")
    assert said(0, "help resume").out == said(0, "help runs").out
    assert 'did you mean "record"' in said(2, "help recor").err
    firsts = {name.split()[0] for name in COMMANDS}
    assert firsts - {*topics()} <= {"help", "completion"}  # every command has its page


@pytest.mark.parametrize("shell", SHELLS)
def test_each_shell_has_a_script(shell: str, said: Said) -> None:
    assert "teatbench" in said(0, f"completion {shell}").out


def test_what_is_no_rig_is_not_offered() -> None:
    assert set(HIDDEN) == set(NO_RIGS)


ASKED = {
    "bash": """source <("{program}" completion bash); COMP_LINE='{line}'; COMP_POINT={end}
COMP_TYPE=9; _python_argcomplete teatbench; printf '%s\\n' "${{COMPREPLY[@]}}" """,
    "fish": "teatbench completion fish | source; complete -C '{line}'",
}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
@pytest.mark.parametrize(
    ("shell", "line", "offered"),
    [
        ("bash", "teatbench ca", {"calibrate", "camera"}),
        ("bash", "teatbench store export r --fo", {"--format"}),
        ("bash", "teatbench run six", {"six-situations"}),
        ("bash", "teatbench check emu", {"emulated"}),
        ("bash", "teatbench score r --detector thesis-p", {"thesis-published-homography"}),
        ("fish", "teatbench run six", {"six-situations"}),
    ],
)
def test_a_shell_completes_a_line(shell: str, line: str, offered: set[str], tmp_path: Path) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"needs {shell}")
    program = tmp_path / "teatbench"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m bench.cli "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        [shell, "-c", ASKED[shell].format(program=program, line=line, end=len(line))],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)},
        check=True,
    )
    found = {word.strip() for word in done.stdout.splitlines()}
    assert offered <= found if shell == "bash" else offered == found, done
