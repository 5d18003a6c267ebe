"""Detectors that nobody here wrote: whatever they say and leave behind is scored as what it is and
told in one line.
"""

from __future__ import annotations

import json
import sqlite3
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.config import ConfigError
from bench.report.wording import id_of
from bench.script.detectors import make_detectors
from reports.trust import checked_slug
from tests.bench.commands import Said
from tests.bench.small_recording import write_recording

pytestmark = pytest.mark.slow

SPEAKER = r"""
import os, sys
os.write(1, b'{"ready": true}\n')
answers = [
    b'"teats": [], "reason": "half \\ud800 a pair"',
    b'"teats": [], "reason": "a\\u0000b\\u001b[31mred\\uffff"',
    b'"teats": [{"world_mm": [1, 2, 3], "covariance_mm2": [[1e308, 0, 0], [0, 1e308, 0], [0, 0, 1e308]]}]',
    b'"teats": [{"left_px": [1e308, -1e308], "right_px": [1e308, 1e308]}]',
    b'"teats": [], "hidden": 1',
]
for number, line in enumerate(sys.stdin, 1):
    os.write(2, bytes(range(256)))
    os.write(1, b'{"frame": "%d", %s}\n' % (number, answers[number - 1]))
"""


def test_no_words_of_a_program_and_no_name_stop_a_run(tmp_path: Path, said: Said) -> None:
    (tmp_path / "speaker.py").write_text(SPEAKER, encoding="utf-8")
    declared = f'name = "My.speaker_2"\ncommand = [{json.dumps(sys.executable)}, "speaker.py"]\n'
    (tmp_path / "speaker.toml").write_text(declared, encoding="utf-8")
    recording = write_recording(tmp_path / "five")
    speaker, out = tmp_path / "speaker.toml", tmp_path / "runs"
    written = said(1, "score {} --detector {} --out {}", recording, speaker, out)
    assert "2 failure" in written.out
    (run,) = (tmp_path / "runs").iterdir()
    page = (run / "report" / "index.html").read_text(encoding="utf-8")
    assert "Teats found by My.speaker_2" in page
    with sqlite3.connect(run / "run.sqlite") as database:
        text = database.execute("select outcome, reason from detections order by trial").fetchall()
    database.close()
    outcomes = " ".join(outcome for outcome, _ in text)
    assert outcomes == "answered answered failure failure answered"
    assert text[0][1] == "half \ufffd a pair"
    assert text[1][1] == "a\ufffdb\ufffd[31mred\ufffd"
    assert "at most 1e+12 are taken" in text[2][1]
    assert "lead to no point in space" in text[3][1]


@given(
    st.lists(
        st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,60}", fullmatch=True), unique=True, max_size=6
    )
)
def test_every_name_has_an_id_of_its_own_on_a_page(names: list[str]) -> None:
    ids = [checked_slug(f"histogram-{id_of(name)}", name) for name in names]
    assert len(set(ids)) == len(ids)
    for name in ("fused", "thesis-published-homography"):
        assert id_of(name) == name, "links to a report's figures stay"


def test_detect_shows_the_last_words_of_a_program_that_gave_no_answer(
    tmp_path: Path, said: Said
) -> None:
    given = write_recording(tmp_path / "five"), f"exec:{sys.executable} {tmp_path / 'lost.py'}"
    first, second, *_ = said(3, "detect {} --detector {}", *given).out.splitlines()
    assert first.endswith("the detector failed: it ended with exit code 2 before it was ready")
    assert "can't open file" in second
    line, *_ = said(3, "detect {} --json --detector {}", *given).out.splitlines()
    assert "can't open file" in json.loads(line)["stderr"]


def test_a_file_that_was_meant_to_run_is_answered_with_how(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text("", encoding="utf-8")
    why = r"no detector 'mine.py'; to run that file, write exec:COMMAND \(there are: thesis"
    with pytest.raises(ConfigError, match=why):
        make_detectors(["mine.py"])
    if sys.platform != "win32":
        why = "'./mine.py' may not be run: make it executable, or name what runs it, as in python3"
        with pytest.raises(ConfigError, match=why):
            make_detectors(["exec:./mine.py"])
