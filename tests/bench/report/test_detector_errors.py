"""Detectors that nobody here wrote: whatever they raise, say and leave behind is scored as what it
is and told in one line.
"""

from __future__ import annotations

import asyncio
import json
import sqlite3
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.config import ConfigError, read_calibration
from bench.report.wording import id_of
from bench.results.answers import MOST_STAGES, Answer, examine
from bench.rig.loading import RIGS
from bench.run.rows import detection_rows, stage_pictures
from bench.script.detectors import make_detectors
from detector.calibration import Calibration
from detector.protocol import Detection, Frames, Outcome, Stage, Teat
from instruments.camera.frame import FrameSet
from reports.trust import checked_slug
from tests.bench.commands import Said
from tests.bench.small_recording import write_recording

FRAMES = FrameSet(np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.uint8))
HERE = np.array([1.0, 2.0, 3.0])
MASK = np.ones((9, 4), bool)


@dataclass(frozen=True)
class Strange:
    """A detector that does what a function says."""

    does: Callable[[Calibration], Any]
    name: str = "strange"
    version: str = "1"

    @property
    def parameters(self) -> Mapping[str, Any]:
        return {}

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        found: Detection = self.does(calibration)
        return found


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return read_calibration(RIGS / "calibration.toml")


def asked(does: Callable[[], Any], calibration: Calibration) -> Answer:
    """The answer, held to be one that record and report can take."""
    answer = examine(Strange(lambda _: does()), FRAMES, calibration)
    head, _ = detection_rows("t", answer)
    (str(head["reason"]) + str(head["trace"])).encode("utf-8")
    assert answer.detection.reason is None or answer.detection.reason.isprintable()
    assert all(min(picture.shape) > 0 for picture in stage_pictures([answer]).values())
    return answer


class PanicException(BaseException):
    """As a library in Rust raises it."""


class SpeechlessError(Exception):
    def __str__(self) -> str:
        raise ZeroDivisionError


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (PanicException("index out of bounds"), "PanicException: index out of bounds"),
        (asyncio.CancelledError(), "CancelledError:"),
        (GeneratorExit(), "GeneratorExit:"),
        (SpeechlessError(), "SpeechlessError"),
        (RuntimeError("no \ud800 such\x1b[31m"), "RuntimeError: no \N{REPLACEMENT CHARACTER} such"),
    ],
)
def test_whatever_it_raises_is_a_failure(
    calibration: Calibration, error: BaseException, text: str
) -> None:
    def fails() -> Any:
        raise error

    answer = asked(fails, calibration)
    assert answer.outcome is Outcome.FAILED
    assert str(answer.detection.reason).startswith(f"the detector failed: {text}")


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (Detection(None), "the teats of its answer are a NoneType, not a tuple of Teat"),  # type: ignore[arg-type]
        (Detection(iter(())), "the teats of its answer are a tuple_iterator"),  # type: ignore[arg-type]
        (
            Detection((Teat(np.array(["1", "2", "3"])),)),
            "teat 1 of its answer is ['1', '2', '3'], not three finite numbers",
        ),
        (Detection((Teat(np.array([True, False, True])),)), "not three finite numbers"),
        (Detection((Teat(HERE + 1j),)), "not three finite numbers"),  # type: ignore[arg-type]
        (
            Detection((Teat(np.ma.masked_array(HERE, [True, False, False])),)),
            "not three finite numbers",
        ),
        (
            Detection((Teat(HERE, np.eye(3) * 1e308),)),
            "the covariance of teat 1 has an entry of 1e+308 mm2; at most 1e+12 are taken",
        ),
        (
            Detection((Teat(HERE, np.eye(3) * 1e-300),)),
            "claims a standard deviation of 1e-150 mm; at least 1e-06 mm are taken",
        ),
        (
            Detection((Teat(np.full(3, np.nan), left_px=np.array([np.nan, 1])),)),
            "left_px of teat 1 is [nan, 1.0]",
        ),
    ],
)
def test_values_that_are_no_answer_are_refused_in_a_sentence(
    calibration: Calibration, given: Detection, text: str
) -> None:
    answer = asked(lambda: given, calibration)
    assert (answer.outcome, answer.detection.teats) == (Outcome.FAILED, ())
    assert text in str(answer.detection.reason)


@pytest.mark.parametrize(
    "stage",
    [
        Stage("fine", None),  # type: ignore[arg-type]
        Stage("a" * 1000, {"mask": MASK}),
        Stage("empty", {"mask": MASK[:0]}),
        Stage("long", {"mask": np.ones((1, 100_000), bool)}),
        Stage("text", {"said": np.array(["\ud800"])}),
        Stage("key", {"\ud800": HERE}),
        Stage("GOOD", {"mask": MASK}),
    ],
)
def test_a_stage_that_cannot_be_kept_costs_no_answer(
    calibration: Calibration, stage: Stage
) -> None:
    good = Stage("good", {"mask": MASK})
    answer = asked(lambda: Detection((Teat(HERE),), trace=(good, stage)), calibration)
    assert answer.outcome is Outcome.ANSWERED
    assert [kept.name for kept in answer.detection.trace] == ["good"], (
        "and of two that would be one file, the first"
    )
    assert "1 of its stages can't be kept" in str(answer.detection.reason)


def test_a_trace_without_end_is_cut_and_prints_are_not_the_benchs_output(
    calibration: Calibration, capsys: pytest.CaptureFixture[str]
) -> None:
    stages = tuple(Stage(f"s{number}", {"mask": MASK}) for number in range(500))
    answer = asked(lambda: (print("debug"), Detection((), trace=stages))[1], calibration)
    assert len(answer.detection.trace) == MOST_STAGES
    assert f"{500 - MOST_STAGES} of its stages" in str(answer.detection.reason)
    assert capsys.readouterr() == ("", "debug\n")


def test_no_detector_can_change_the_calibration_under_the_others(calibration: Calibration) -> None:
    before = calibration.homographies.left.copy()

    def scales(given: Calibration) -> Detection:
        for matrix in (given.right_from_left.R, given.homographies.left):
            with pytest.raises(ValueError, match="read-only"):
                matrix /= 2.0
        return Detection()

    assert examine(Strange(scales), FRAMES, calibration).outcome is Outcome.ANSWERED
    assert np.array_equal(calibration.homographies.left, before)


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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
