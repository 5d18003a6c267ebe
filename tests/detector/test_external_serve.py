"""A detector in Python behind the protocol: the same answers as without it."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.external import ExternalDetector
from detector.external.serve import Pictures, read_pictures, serve
from detector.protocol import DetectionFailure, depth_of
from detector.registry import create
from tests.conftest import ROOT
from tests.detector.children import installed
from tests.detector.conftest import Draw

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
    asked = {
        "frame": "5",
        "left": str(tmp_path / "left.png"),
        "right": str(tmp_path / "right.png"),
        "calibration": str(rig_file),
    }
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


@pytest.mark.parametrize(
    ("words", "note"), [([], "needs the name of one detector"), (["fusde"], "did you mean 'fused'")]
)
def test_serving_without_a_detector_is_a_sentence(words: list[str], note: str) -> None:
    done = subprocess.run(
        [*SERVE, *words], cwd=ROOT, capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert note in done.stderr
    assert "Traceback" not in done.stderr


def test_kelvin_come_as_hundredths_and_depth_as_tenths(tmp_path: Path) -> None:
    for name, picture in (
        ("left", np.zeros((2, 2), np.uint8)),
        ("thermal_radiometric", np.full((2, 2), 30515, np.uint16)),
    ):
        cv2.imwrite(str(tmp_path / f"{name}.png"), picture)
    for name in ("depth", "depth_amplitude"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.array([[0, 10763]], np.uint16))
    left, kelvin = str(tmp_path / "left.png"), str(tmp_path / "thermal_radiometric.png")
    found = read_pictures({"left": left, "right": left, "thermal_radiometric": kelvin})
    assert found.thermal is None
    assert found.thermal_k is not None
    assert found.thermal_k.tolist() == [[305.15, 305.15]] * 2
    assert depth_of(found) == (None, None)
    deep = {name: str(tmp_path / f"{name}.png") for name in ("depth", "depth_amplitude")}
    depth_mm, amplitude = map(
        np.asarray, depth_of(read_pictures({"left": left, "right": left} | deep))
    )
    assert np.array_equal(depth_mm, [[np.nan, 1076.3]], equal_nan=True)
    assert amplitude.tolist() == [[0, 10763]]
    (tmp_path / "left.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match="is no picture"):
        read_pictures({"left": str(tmp_path / "left.png")})


def test_pictures_that_png_cannot_hold_are_a_failure(
    rig: Calibration,
) -> None:
    detector = ExternalDetector("never", ["/no/such/program"], time.perf_counter)
    with pytest.raises(DetectionFailure, match=r"the left picture .* can't be written as PNG"):
        detector.prepare(Pictures(np.zeros((0, 3), np.uint8), np.zeros((2, 2), np.uint8)), rig)
    detector.close()
