"""Detectors in processes of their own: every fault has its outcome, none hangs, none is left; and a
detector in Python behind the protocol gives the same answers as without it.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.external import ExternalDetector
from detector.external.serve import Pictures, main, read_pictures, serve
from detector.protocol import DetectionFailure, Detector, DetectorProcess, Outcome
from detector.registry import create
from tests.conftest import ROOT
from tests.detector.children import (
    GOOD,
    NO_TEATS,
    PICTURES,
    Start,
    answering,
    ask,
    failure,
    installed,
    start,
)
from tests.detector.conftest import Draw
from tests.waiting import PATIENCE_S

__all__ = ["start"]


def test_it_answers_and_its_start_stands_apart(start: Start, rig: Calibration) -> None:
    detector = start(GOOD)
    assert isinstance(detector, DetectorProcess)
    as_any: Detector = detector
    assert as_any.parameters["command"][0] == sys.executable
    assert len(as_any.version) == 12
    detector.prepare(PICTURES, rig)
    assert detector.start_up_s is not None
    assert detector.start_up_s > 0
    found = detector.detect(PICTURES, rig)
    assert (found.hidden, found.teats[0].world_mm.tolist()) == (1, [1, 2, 3])
    detector.prepare(PICTURES, rig)
    assert detector.start_up_s is None, "it runs already"


@pytest.mark.slow
def test_it_says_what_it_is_before_the_first_call(start: Start, rig: Calibration) -> None:
    """Its start-up stays apart from the first call, and is told with it."""
    ready = 'say({"ready": True, "device": "CUDA:0", "trained_on": {"ideal": [[0, 9]]}})'
    detector = start(answering(NO_TEATS, ready))
    assert (detector.device, detector.trained_on) == ("", {})
    detector.introduce()
    assert (detector.device, detector.trained_on) == ("CUDA:0", {"ideal": ((0, 9),)})
    detector.prepare(PICTURES, rig)
    assert detector.start_up_s is not None
    broken = start(answering(NO_TEATS, "sys.exit(3)"))
    for _ in range(2):  # started once: the fault is the first call's, and counts once
        broken.introduce()
    assert "exit code 3 before it was ready" in str(failure(broken, rig))


def test_it_gets_pictures_and_calibration(start: Start, rig: Calibration, tmp_path: Path) -> None:
    kept = tmp_path / "seen"
    kept.mkdir()
    copies = f"[shutil.copy(p, {str(kept)!r}) for k, p in asked.items() if k != 'frame']"
    ask(start(answering(f"import shutil\n{copies}\n{NO_TEATS}")), rig)
    names = ("depth", "depth_amplitude", "left", "right", "thermal_radiometric")
    seen = {name: str(kept / f"1-{name}.png") for name in names}
    assert sorted(map(str, kept.iterdir())) == [*seen.values(), str(kept / "calibration.toml")]
    tenths, kelvin = (
        cv2.imread(seen[name], cv2.IMREAD_UNCHANGED) for name in ("depth", "thermal_radiometric")
    )
    assert np.asarray(tenths).tolist() == [[0, 10763]]
    assert np.asarray(kelvin).dtype == np.uint16
    assert (np.asarray(kelvin) == 30515).all()
    again = read_pictures(seen)
    for field in fields(again):
        one, other = getattr(again, field.name), getattr(PICTURES, field.name)
        assert (
            np.array_equal(one, other, equal_nan=True) if field.name != "thermal" else one is None
        )
    Path(seen["left"]).write_bytes(b"no picture")
    with pytest.raises(ValueError, match="is no picture"):
        read_pictures(seen)


@pytest.mark.parametrize(
    "deed", ["shutil.rmtree(os.path.dirname(asked['left']))", "os.unlink(asked['calibration'])"]
)
def test_what_a_program_removes_it_gets_again(start: Start, rig: Calibration, deed: str) -> None:
    there = "all(os.path.isfile(p) for k, p in asked.items() if k != 'frame')"
    says = 'say({"frame": asked["frame"], "teats": [], "hidden": int(there)})'
    detector = start(answering(f"import shutil\nthere = {there}\n{deed}\n{says}"))
    assert [ask(detector, rig).hidden for _ in range(3)] == [1, 1, 1]


def test_a_full_disk(start: Start, rig: Calibration, monkeypatch: pytest.MonkeyPatch) -> None:
    detector = start(GOOD)

    def full(*_: object, **__: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        assert "its pictures can't be put into" in (text := str(failure(detector, rig)))
        assert text.endswith(": No space left on device")
    assert ask(detector, rig).hidden == 1


SILENT, PARTIAL = "time.sleep(60)", 'print("{\\"frame\\": ", end="", flush=True)\ntime.sleep(60)'
CUT = 'print("{\\"fra", end="", flush=True)\nsys.exit(1)'
FLOOD = 'print("{}\\n" * 500, flush=True)'


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "outcome", "text"),
    [
        (SILENT, Outcome.TIMEOUT, "it gave no answer within 1.5 s"),
        (PARTIAL, Outcome.TIMEOUT, 'stuck in the middle of a line that begins "{"frame":"'),
        ("sys.exit(3)", Outcome.FAILED, "it ended with exit code 3"),
        (CUT, Outcome.FAILED, 'exit code 1 in the middle of a line that begins "{"fra"'),
        ("os.kill(os.getpid(), 11)", Outcome.FAILED, "it was ended by signal 11"),
        ("os.close(1)\ntime.sleep(60)", Outcome.FAILED, "it closed its output"),
        ('print("debug: here", flush=True)', Outcome.FAILED, 'its line is not JSON: "debug: here"'),
        ('say({"frame": "0", "teats": []})', Outcome.FAILED, "it was asked about frame"),
        ('say({"frame": asked["frame"], "teats": 4})', Outcome.FAILED, 'no list "teats"'),
        ('print("x" * (1 << 21), flush=True)', Outcome.FAILED, "wrote a line of more than"),
        (FLOOD, Outcome.FAILED, "it was asked about frame|without being asked"),
    ],
)
def test_a_bad_call_is_what_it_is(
    start: Start, rig: Calibration, what: str, outcome: Outcome, text: str
) -> None:
    if os.name == "nt" and "kill" in what:
        pytest.skip("no such signal")
    answer_s = 1.5 if outcome is Outcome.TIMEOUT else 60.0
    found = failure(start(answering(what), answer_s=answer_s), rig)
    assert found.outcome is outcome
    assert any(part in str(found) for part in text.split("|")), found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ready", "outcome", "text"),
    [
        ("time.sleep(60)", Outcome.TIMEOUT, "it was not ready within 0.5 s of its start"),
        ("sys.exit(2)", Outcome.FAILED, "exit code 2 before it was ready"),
        ('print("hello", flush=True)', Outcome.FAILED, "not JSON"),
        ('say({"frame": "1"})', Outcome.FAILED, "its first line must be"),
    ],
)
def test_a_bad_start_is_what_it_is(
    start: Start, rig: Calibration, ready: str, outcome: Outcome, text: str
) -> None:
    detector = start(answering("pass", ready), start_s=0.5 if outcome is Outcome.TIMEOUT else 30.0)
    found = failure(detector, rig)
    assert (found.outcome, text in str(found)) == (outcome, True), found
    assert detector.start_up_s is None


def test_a_program_that_is_not_there(rig: Calibration) -> None:
    detector = ExternalDetector("none", ["/no/such/program"], time.perf_counter)
    assert "exit code 127" in str(failure(detector, rig)) or os.name == "nt"
    assert "can't be started: No such file" in detector.said() or os.name == "nt"
    detector.close()


def test_it_is_given_up_in_the_end_with_a_sentence(start: Start, rig: Calibration) -> None:
    detector = start(answering("sys.exit(1)"), in_a_row=2)
    assert "switched off" not in str(failure(detector, rig))
    why, given_up = "2 faults in a row", "switched off for the rest of the run"
    assert f"exit code 1. After {why} it is {given_up}" in str(failure(detector, rig))
    for _ in range(2):
        off = failure(detector, rig)
        assert off.outcome is Outcome.OFF
        assert str(off) == f"{given_up} after {why}; the last: it ended with exit code 1"


@pytest.mark.slow
def test_starts_are_bounded_also_with_answers_between(start: Start, rig: Calibration) -> None:
    detector = start(answering(f"{NO_TEATS}\nsys.exit(0)"), restarts=1)
    ask(detector, rig)
    failure(detector, rig)
    ask(detector, rig)
    assert "After 2 starts it is switched off" in str(failure(detector, rig))


def test_wrong_values_cost_the_answer_but_not_the_process(start: Start, rig: Calibration) -> None:
    teats = '4 if asked["frame"] == "1" else []'
    detector = start(answering(f'say({{"frame": asked["frame"], "teats": {teats}}})'))
    failure(detector, rig)
    ask(detector, rig)
    assert detector.start_up_s is None, "it was not started again"


@pytest.mark.slow
def test_standard_error_is_kept_within_bounds(start: Start, rig: Calibration) -> None:
    writes = 'print("seen", asked["frame"], file=sys.stderr, flush=True)'
    fails = 'if asked["frame"] == "2": raise ValueError("no teat")'
    detector = start(answering(f"{writes}\n{fails}\n{NO_TEATS}"))
    ask(detector, rig)
    failure(detector, rig)
    said = detector.said()
    assert "seen 2" in said
    assert said.endswith("ValueError: no teat")
    assert detector.said() == ""
    noisy = start(answering('sys.stderr.write("x" * 200_000)\nsys.stderr.flush()\nsys.exit(1)'))
    failure(noisy, rig)
    assert noisy.said().startswith("(183616 bytes before this are left out)")


# A detector in Python behind the protocol

SERVE = [sys.executable, "-m", "detector.external.serve"]


def served(name: str, environment: Sequence[str] = ()) -> ExternalDetector:
    return ExternalDetector(
        "there", [*SERVE, name], time.perf_counter, folder=ROOT, environment=environment
    )


@pytest.mark.slow
def test_thesis_in_a_process(draw: Draw, teats_mm: NDArray[np.float64], rig: Calibration) -> None:
    frames = draw(teats_mm)
    with closing(served("thesis")) as there:
        for _ in range(2):
            here, far = create("thesis").detect(frames, rig), there.detect(frames, rig)
            assert len(here.teats) == len(far.teats) == 4
            for one, other in zip(here.teats, far.teats, strict=True):
                # a calibration file has ten digits
                assert np.allclose(one.world_mm, other.world_mm, atol=1e-4)
    assert there.said() == ""


def test_it_says_ready_and_answers_every_line(tmp_path: Path, rig_file: Path) -> None:
    for name in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((4, 4), np.uint8))
    paths = {name: str(tmp_path / f"{name}.png") for name in ("left", "right")}
    asked = {"frame": "5", **paths, "calibration": str(rig_file)}
    answers = io.BytesIO()
    serve("thesis", io.BytesIO((json.dumps(asked) + "\n").encode() * 2), answers)
    ready, *lines = [json.loads(line) for line in answers.getvalue().splitlines()]
    assert ready == {"ready": True}
    assert [(line["frame"], line["teats"]) for line in lines] == [("5", [])] * 2
    assert "4 x 4" in lines[0]["reason"]


PRINTS = """
from detector.protocol import Detection
class Loud:
    def detect(self, frames, calibration):
        print("debug: here")
        return Detection((), 3)
"""


@pytest.mark.slow
def test_prints_are_kept(tmp_path: Path, rig: Calibration, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", installed(tmp_path, "loud", PRINTS, "loud = loud:Loud"))
    frames = Pictures(np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.uint8))
    with closing(served("loud", environment=["PYTHONPATH"])) as there:
        assert [there.detect(frames, rig).hidden for _ in range(2)] == [3, 3]
    assert there.said().splitlines() == ["debug: here", "debug: here"]


@pytest.mark.slow
def test_serving_without_a_detector_is_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "needs the name of one detector" in capsys.readouterr().err
    done = subprocess.run(
        [*SERVE, "fusde"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert "did you mean 'fused'" in done.stderr
    assert "Traceback" not in done.stderr


def test_pictures_that_png_cannot_hold_are_a_failure(rig: Calibration) -> None:
    detector = ExternalDetector("never", ["/no/such/program"], time.perf_counter)
    with pytest.raises(DetectionFailure, match=r"the left picture .* can't be written as PNG"):
        detector.prepare(Pictures(np.zeros((0, 3), np.uint8), np.zeros((2, 2), np.uint8)), rig)
    detector.close()
