"""docs/first-detector.md, followed word by word: its program and its file answer its commands, and
the file holds the defaults; docs/detectors.md names the thesis's variants and failures.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from bench.config import read_config
from bench.results.thesis_figures import thesis
from bench.script.detectors import DetectorFile
from detector.external import Limits
from detector.registry import available
from tests.bench.commands import Said
from tests.conftest import ROOT

TUTORIAL, PAGE = (
    (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    for name in ("first-detector", "detectors")
)


def block(language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", TUTORIAL, re.DOTALL)
    assert found
    return found[1]


@pytest.mark.slow
def test_the_tutorial_word_by_word(
    tmp_path: Path, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = block("python")
    assert len(program.strip().splitlines()) <= 20
    monkeypatch.chdir(tmp_path)
    for name, text in (("my_detector.py", program), ("mine.toml", block("toml"))):
        assert f"`{name}`" in TUTORIAL
        text = text.replace('"python3"', json.dumps(sys.executable))
        (tmp_path / name).write_text(text, encoding="utf-8")
    record, detect, score = (
        line.removeprefix("teatbench ") for line in block("sh").strip().splitlines()
    )
    said(0, record)
    lines = [json.loads(line) for line in said(0, detect).out.strip().splitlines()]
    assert len(lines) == 2
    for line in lines:
        assert (line["detector"], line["hidden"], line.get("reason")) == ("mine", 2, None)
        in_space, in_pixels = line["teats"]
        assert in_space["world_mm"] == [-160.0, 205.0, 136.0]
        assert in_space["covariance_mm2"][1][1] == 0.4
        assert np.abs(in_pixels["world_mm"]).max() < 1000
    table = said(1, score).out
    assert "mine" in table
    assert "fused" in table
    (run,) = (tmp_path / "runs").iterdir()
    assert (run / "report" / "index.html").is_file()


def test_the_file_shows_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "example.toml").write_text(block("toml"), encoding="utf-8")
    shown, usual = read_config(tmp_path / "example.toml", DetectorFile), Limits()
    assert (shown.start_limit_s, shown.time_limit_s, shown.memory_limit_mib) == (
        usual.start_s,
        usual.answer_s,
        usual.memory_mib,
    )
    assert (shown.restarts, shown.faults_in_a_row) == (usual.restarts, usual.in_a_row)


def test_every_variant_of_the_thesis_is_reported() -> None:
    for name in available([]):
        assert f"`{name}`" in PAGE, name


def test_the_published_failures_are_reported() -> None:
    text = re.findall(r"^\| `(\w+)` \| (\d) \|", PAGE, re.MULTILINE)
    assert [(name, int(found)) for name, found in text] == [
        (one.name, one.found) for one in thesis().situations
    ]
    assert {one.present for one in thesis().situations} == {4}
