"""`detectors new` writes a detector that answers; `detectors try` says what is wrong with one."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.commands import Said
from tests.bench.small_recording import write_recording

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
