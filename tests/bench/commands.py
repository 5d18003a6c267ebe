"""Commands as a person writes them: words, and ``{}`` for each value, which may be several; and the
example of a real rig, with its instruments elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import pytest

from bench.cli.main import main
from bench.rig.loading import RIGS


def words(text: str, *values: object) -> list[str]:
    """The words of ``text``; each ``{}`` is the next of ``values``, or all in it for a sequence."""
    found: list[str] = []
    following = iter(values)
    for word in text.split():
        value = next(following) if word == "{}" else word
        found += map(str, value) if isinstance(value, list | tuple) else [str(value)]
    return found


def teatbench(text: str, *values: object) -> int:
    """Run a command in this process; gives back its exit code."""
    return main(words(text, *values))


class Output(NamedTuple):
    """What a command wrote."""

    out: str
    err: str


class Said:
    """Runs a command that must end with ``code``, without a traceback; gives back what it wrote."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, code: int, text: str, *values: object) -> Output:
        self._capsys.readouterr()
        try:
            found: int | str | None = teatbench(text, *values)
        except SystemExit as ended:  # argparse's
            found = ended.code
        written = Output(*self._capsys.readouterr())
        assert found == code, written.err
        assert "Traceback" not in written.err
        return written


NO_CAMERA = {'"opencv:0"  ': '"opencv:none1.avi"  '}


def lab_rig(folder: Path, changes: Mapping[str, str]) -> Path:
    """The example of a real rig in ``folder``, with each of ``changes`` made in its text."""
    text = (RIGS / "lab.example.toml").read_text(encoding="utf-8")
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    (folder / "lab.toml").write_text(text, encoding="utf-8")
    (folder / "calibration.toml").write_bytes((RIGS / "calibration.toml").read_bytes())
    return folder / "lab.toml"
