"""`--help`: commands by task, and an example of each that can be given as it stands; what
a shell is given for a line.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path

import pytest
from argcomplete.shell_integration import shellcode

from bench.cli.commands import COMMANDS, exit_codes, interrupted, table
from bench.cli.main import _named, main, parser
from bench.cli.manual import topics
from tests.bench.commands import Said
from tests.conftest import ROOT

TASKS = table("tasks")["tasks"]


def test_every_command_belongs_to_one_task(said: Said) -> None:
    firsts = [name for names in TASKS.values() for name in names]
    assert sorted(firsts) == sorted({name.split()[0] for name in COMMANDS})
    seen = said(0, "--help").out
    assert re.findall(r"^([a-z ]+):$", seen, re.MULTILINE) == [*TASKS, "options"]
    assert seen.count("example: teatbench ") == len(TASKS)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_commands_help_has_an_example_its_exit_codes_and_what_ctrl_c_leaves(
    name: str, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = said(0, f"{name} --help").out
    (example,) = re.findall(r"^example: teatbench (.+)$", shown, re.M)
    assert example.split()[: len(name.split())] == name.split()
    codes = re.findall(r"^  (\d) ", shown.partition("exit codes:\n")[2], re.M)
    assert codes == [*exit_codes(name)]
    assert {"0", "2", "3"} <= {*codes}
    monkeypatch.setattr("bench.cli.main.call", lambda _: signal.raise_signal(signal.SIGINT))
    left = said(3, "{}", shlex.split(example)).err
    assert left == f"teatbench: interrupted: {interrupted(name)}.\n"


def test_only_what_the_words_name_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def add(of: ArgumentParser, *_: object, **_how: object) -> None:
        made.append(of.prog)

    monkeypatch.setattr(ArgumentParser, "add_argument", add)
    parser.__wrapped__(_named(["store", "export", "runs/1"]))
    assert {prog.split()[1] for prog in made if prog.count(" ")} == {"store"}
    # which takes the words of an earlier release too
    assert _named(["tell", "runs/1", "skip"]) == {"control"}
    assert _named(["--version"]) == frozenset()


def test_each_ending_is_of_a_command_and_in_one_row() -> None:
    for rows in (table("endings")["codes"], table("endings")["interrupted"]):
        named = [name for row in rows for name in row["of"]]
        assert len(named) == len({*named}) == len({*named} & {*COMMANDS})
    assert {*named} == {*COMMANDS}  # each says what Ctrl-C leaves


@pytest.mark.slow
def test_ctrl_c_after_a_run_says_that_it_is_kept(
    said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reporting(*_: object, begun: Callable[[str], None], **_how: object) -> None:
        begun("Run folder: runs/1")
        raise KeyboardInterrupt

    monkeypatch.setattr("bench.run_queue", reporting, raising=False)
    seen = said(3, "run six-situations")
    assert "Run folder" in seen.out
    assert "the run is kept, and its report may be missing" in seen.err


CAPITALS = {"RIG": "emulated", "RUN": "runs/1", "X": "1", "Y": "1"}
VALUES = {"port": "COM5", "profile": "julabo-presto", "script": "plane-map", "rig": "emulated"}


@pytest.mark.parametrize("name", COMMANDS)
def test_the_next_two_commands_can_be_given(name: str) -> None:
    for text in table("following")[name]:
        filled = re.sub(r"\{(\w+)\}", lambda found: VALUES.get(found[1], "a"), text)
        words = [CAPITALS.get(word, word) for word in shlex.split(filled)]
        given = parser().parse_args(words)
        if given.called == "help" and given.topic:
            assert " ".join(given.topic) in topics()


@pytest.mark.slow
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
    monkeypatch.setattr("bench.cli.main.call", lambda _: 0)
    assert main(["run", "demo", "--dry-run"]) == 0
    then = capsys.readouterr().out.partition("Then, for instance:\n")[2]
    assert then == "  teatbench run demo --rig RIG\n  teatbench trials show demo\n", "no report"


def test_a_page_of_the_documentation_is_shown_offline(said: Said) -> None:
    listed = said(0, "help").out
    pages = sorted(path.stem for path in (ROOT / "docs").glob("*.md"))
    assert [line.partition(":")[0] for line in listed.splitlines()[:-1]] == pages
    assert said(0, "help record").out.startswith("# Record")
    assert said(0, "help resume").out == said(0, "help runs").out
    assert said(0, "help store check").out == said(0, "help record").out
    assert said(0, "help tell").out == said(0, "help control").out
    assert said(0, "help guard band").out.startswith("guard band: What is taken off a limit")
    assert said(0, "help Undecided").out.startswith("undecided: ")
    assert said(0, "help check touches").out.startswith("check point: A divot")
    assert "these pages speak of it: faults, lab, runs" in said(2, "help pedal").err
    for near, meant in ("recor", "record"), ("store chek", "store check"), ("apx", "apex"):
        assert f'did you mean "{meant}"' in said(2, f"help {near}").err
    assert "did you mean" not in said(2, "help nosuch").err
    assert "went: bash and zsh" in said(2, "help completion").err
    assert {*COMMANDS} - {*topics()} <= {"help"}  # every command has its page


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("teatbench ca", {"calibrate", "camera", "campaign"}),
        ("teatbench store ch", {"check"}),
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
