"""docs/detectors.md does what it says: its example runs as it stands, and its file holds the
defaults.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np

from bench.config import read_config
from bench.results.thesis_figures import thesis
from bench.script.detectors import DetectorFile
from detector.external import Limits
from detector.registry import available
from tests.bench.commands import Said
from tests.bench.small_recording import write_recording
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "detectors.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    assert found
    return found[1]


def test_the_example_is_a_detector_in_20_lines(tmp_path: Path, said: Said) -> None:
    recording, program = write_recording(tmp_path / "five"), block("python")
    assert len(program.strip().splitlines()) <= 20
    (tmp_path / "my_detector.py").write_text(program, encoding="utf-8")
    (tmp_path / "example.toml").write_text(
        block("toml").replace('"python3"', json.dumps(sys.executable)), encoding="utf-8"
    )
    lines = [
        json.loads(line)
        for line in said(0, "detect {} --json --detector {}", recording, tmp_path / "example.toml")
        .out.strip()
        .splitlines()
    ]
    assert len(lines) == 5
    for line in lines:
        assert (line["detector"], line["hidden"], line.get("reason")) == ("example", 2, None)
        in_space, in_pixels = line["teats"]
        assert in_space["world_mm"] == [-160.0, 205.0, 136.0]
        assert in_space["covariance_mm2"][1][1] == 0.4
        assert np.abs(in_pixels["world_mm"]).max() < 1000


def test_the_file_shows_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "example.toml").write_text(block("toml"), encoding="utf-8")
    shown, usual = read_config(tmp_path / "example.toml", DetectorFile), Limits()
    assert (shown.start_limit_s, shown.time_limit_s, shown.memory_limit_mib) == (
        usual.start_s,
        usual.answer_s,
        usual.memory_mib,
    )
    assert (shown.restarts, shown.faults_in_a_row) == (usual.restarts, usual.in_a_row)


def test_every_variant_of_the_thesis_is_told() -> None:
    for name in available([]):
        assert f"`{name}`" in PAGE, name


def test_the_published_failures_are_told() -> None:
    text = re.findall(r"^\| `(\w+)` \| (\d) \|", PAGE, re.MULTILINE)
    assert [(name, int(found)) for name, found in text] == [
        (one.name, one.found) for one in thesis().situations
    ]
    assert {one.present for one in thesis().situations} == {4}
