"""`detectors new` writes a detector that answers, a learned one too; `detectors try` says what is
wrong with one; docs/first-detector.md, followed word by word, makes one, and docs/detectors.md names
the thesis's variants and failures.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bench.config import read_config
from bench.script.detectors import DetectorFile
from detector.external import ProcessLimits
from detector.registry import available
from tests.bench.commands import Said
from tests.bench.small_recording import write_recording
from tests.conftest import ROOT
from tests.test_thesis_example import SITUATIONS

READY = "print('{\"ready\": true}', flush=True)\n"
ANSWER = READY + "import json, sys\nfor line in sys.stdin:\n    frame = json.loads(line)['frame']\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("language", "needed", "compiled"),
    [
        ("python", sys.executable, ""),
        ("javascript", "node", ""),
        ("cpp", "c++", "c++ -std=c++17 -Wall -Werror -o mine mine.cpp"),
    ],
)
def test_a_new_detector_answers_as_it_is(
    language: str,
    needed: str,
    compiled: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    said: Said,
) -> None:
    if shutil.which(needed) is None:
        pytest.skip(f"needs {needed}")
    monkeypatch.chdir(tmp_path)
    assert "detectors try mine" in said(0, f"detectors new {language} --name mine").out
    if compiled:
        assert "compile it" in said(2, "detectors try mine").err
        subprocess.run(compiled.split(), cwd="detectors", check=True)
    seen = said(0, "detectors try mine {}", write_recording(tmp_path / "five")).out
    assert "teats found: 1, said to be hidden: 0; 2 can be seen" in seen
    assert "The format is right." in seen
    assert "mine: mine, a" in said(0, "detectors").out
    assert "is there already" in said(2, f"detectors new {language} --name mine").err


@pytest.mark.slow
def test_a_shipped_detector_is_tried_on_a_simulated_frame(said: Said) -> None:
    seen = said(0, "detectors try fused").out
    assert "frame ideal-0000 of the simulated situation ideal" in seen
    assert "mm from the end of teat 4" in seen


@pytest.mark.slow
@pytest.mark.parametrize(
    ("program", "why", "what_to_do"),
    [
        ("import time; time.sleep(60)", "was not ready", "Flush standard output"),
        (READY + "import time; time.sleep(60)", "gave no answer", "Flush standard output"),
        ("print('hello', flush=True)", "its first line must be", "before all else"),
        ("import no_such_module", "before it was ready", "Its last words are above"),
        (ANSWER + "    print('looking', flush=True)", "is not JSON", "answers only"),
        (ANSWER + "    print('{}', flush=True)", "asked about frame", "Give the question's frame"),
        (ANSWER + "    sys.exit(1)", "ended", "until its input ends"),
        (
            ANSWER + "    print(json.dumps({'frame': frame}), flush=True)",
            'no list "teats"',
            'Give "teats": []',
        ),
        (
            ANSWER + "    print(json.dumps({'frame': frame, 'teats': []}), flush=True); break",
            "the second time that it was asked",
            "until its input ends",
        ),
    ],
)
def test_each_fault_is_explained(
    program: str, why: str, what_to_do: str, tmp_path: Path, said: Said
) -> None:
    (tmp_path / "mine.py").write_text(program, encoding="utf-8")
    limits = {"was not ready": "start_limit_s = 1\n", "gave no answer": "time_limit_s = 1\n"}
    command = f"command = {json.dumps([sys.executable, 'mine.py'])}\n"
    (tmp_path / "mine.toml").write_text(command + limits.get(why, ""), encoding="utf-8")
    seen = said(
        1, "detectors try {} {}", tmp_path / "mine.toml", write_recording(tmp_path / "five")
    ).err
    assert why in seen
    assert what_to_do in seen


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
    shown, usual = read_config(tmp_path / "example.toml", DetectorFile), ProcessLimits()
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
    known = [(name, str(found)) for name, (_, found, _) in SITUATIONS.items()]
    assert re.findall(r"^\| `(\w+)` \| (\d) \|", PAGE, re.MULTILINE) == known
    assert {present for *_, present in SITUATIONS.values()} == {4}
