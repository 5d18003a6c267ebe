"""Commands of all pages are those of the program, and their TOML is TOML; what needs no instrument
and no file of the reader's is run.
"""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import pytest

from bench.cli.main import main, parser
from tests.conftest import ROOT

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
COMMANDS = [
    (page.name, line)
    for page in PAGES
    for block in re.findall(r"```(?:sh)?\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    for line in block.splitlines()
    if line.startswith("teatbench ")
]
TOML = [
    (page.name, text)
    for page in PAGES
    for text in re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
]
RUN_HERE = ("plan --rate", "plan --trials", "plan --shift-mm", "plan --limit-mm", "calibrate board")


def words_of(line: str) -> list[str]:
    return shlex.split(line, comments=True)[1:]


@pytest.mark.parametrize(("page", "line"), COMMANDS)
def test_the_program_knows_the_command(
    page: str, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        parser().parse_args(words_of(line))
    except SystemExit:
        pytest.fail(f"{page}: {line}\n{capsys.readouterr().err}")


@pytest.mark.parametrize(
    ("page", "line"),
    [
        (page, line)
        for page, line in COMMANDS
        if line.startswith(tuple(f"teatbench {w}" for w in RUN_HERE))
    ],
)
def test_what_needs_nothing_else_works(
    page: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words_of(line)) == 0, page


@pytest.mark.parametrize(("page", "text"), TOML)
def test_each_example_of_a_file_is_toml(page: str, text: str) -> None:
    assert tomllib.loads(text), page
