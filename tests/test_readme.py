"""The README's commands are true: each is run, in its order, on a machine's own folder."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from bench.cli.arguments import EXIT_CODES
from tests.conftest import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
VERDICTS = (0, 1, 4)


def commands() -> list[str]:
    """Every line of the README's shell blocks."""
    return [
        line
        for block in re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
        for line in block.strip().split("\n")
    ]


def test_the_two_commands_stand_there_and_ci_calls_them() -> None:
    assert commands()[:2] == ["python3 run.py demo", "python3 run.py test"]
    ci = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "python3 run.py demo" in ci
    assert "\npython3 run.py test\n" in ci


@pytest.mark.slow
def test_each_command_of_the_readme_works(tmp_path: Path) -> None:
    ours = [line for line in commands() if line.startswith("teatbench ")]
    assert len(ours) == 12
    for line in ours:
        words = [sys.executable, "-m", "bench.cli", *shlex.split(line)[1:]]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            words,
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            encoding="utf-8",
            timeout=280,
            check=False,
        )
        assert done.returncode in (VERDICTS if words[3] in ("run", "score") else (0,)), (
            f"{line}\n{done.stdout}\n{done.stderr}"
        )
        assert "Traceback" not in done.stderr
        assert done.stdout.strip(), line


def test_links_of_the_readme_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)]+)\)", README):
        assert target.startswith("https://") or (ROOT / target).exists(), target


def test_exit_codes_are_those_of_the_program() -> None:
    told = re.search(r"Exit codes: (.*?)\.\n", README, re.DOTALL)
    assert told is not None
    assert " ".join(EXIT_CODES.split()) == f"exit codes: {told[1]}"
