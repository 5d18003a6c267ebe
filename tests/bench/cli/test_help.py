"""`--help`: commands by task, and an example of each that can be given as it stands."""

from __future__ import annotations

import re
import shlex

import pytest

from bench.cli.commands import COMMANDS, TASKS
from bench.cli.main import parser
from tests.bench.commands import Said


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
