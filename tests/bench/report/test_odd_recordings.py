"""Recordings of frames that fit no calibration, and of any names: scored to the end, and names tell
a detector nothing.
"""

from __future__ import annotations

import json
import shutil
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from bench.report.trials import round_teats
from bench.rig.loading import find_rig, load_rig
from bench.rig.scenes import record_scenes as record
from tests.bench.commands import Said, teatbench

pytestmark = pytest.mark.slow

Answers = dict[tuple[str, str], Any]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of three scenes, without kelvin: those have to stay as the format says."""
    folder = tmp_path_factory.mktemp("recordings") / "three"
    list(record(load_rig(find_rig(None)), ("ideal",), range(3), folder, 1))
    for path in folder.glob("frames/*/*.png"):
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if picture is not None and picture.dtype != np.uint8:
            path.unlink()
    return folder


@pytest.fixture(scope="module")
def plain(recording: Path) -> Answers:
    return answers(recording, "thesis", "fused")


def rewritten(recording: Path, to: Path) -> Path:
    """A copy of the recording with one pixel of each picture."""
    shutil.copytree(recording, to)
    for path in to.glob("frames/*/*.png"):
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert picture is not None
        cv2.imwrite(str(path), picture[:1, :1])
    return to


def test_frames_of_another_size_are_charged_to_no_detector(
    recording: Path, tmp_path: Path, said: Said
) -> None:
    odd, text = rewritten(recording, tmp_path / "odd"), "left.png is 1 x 1 px"
    truth = odd / "truth.csv"
    named = truth.read_text(encoding="utf-8").replace(",ideal,", ",one|other,")
    truth.write_text(named, encoding="utf-8")
    score = "score {} --detector thesis --detector fused --out {}"
    assert text in " ".join(said(4, score, odd, tmp_path / "runs").out.split())
    (run,) = (tmp_path / "runs").iterdir()
    page = (run / "report" / "index.html").read_text(encoding="utf-8")
    assert f"{text} (and 2 more), the calibration is for 1360 x 1024" in page


def answers(recording: Path, *detectors: str) -> Answers:
    named = [word for name in detectors for word in ("--detector", name)]
    with redirect_stdout(StringIO()) as out:
        assert teatbench("detect {} --json {}", recording, named) == 0
    lines = [json.loads(line) for line in out.getvalue().splitlines()]
    return {
        (line["frame"], line["detector"]): (line["teats"], line["hidden"], line.get("reason"))
        for line in lines
    }


ECHO = r"""
import json, os, sys
from tests.examples import few
print(json.dumps({"ready": True}), flush=True)
for line in sys.stdin:
    asked = json.loads(line)
    names = sorted(os.path.basename(path) for key, path in asked.items() if key != "frame")
    print(json.dumps({"frame": asked["frame"], "teats": [], "reason": " ".join([asked["frame"], *names])}), flush=True)
"""


@pytest.mark.weekly
def test_shuffled_names_of_files_change_nothing(
    recording: Path, tmp_path: Path, plain: Answers
) -> None:
    """The same pictures in another order: each has its own answer, to the last digit."""
    names = sorted(path.name for path in (recording / "frames").iterdir())
    given = dict(zip(names, ("2-c", "0-a", "1-b"), strict=True))
    shuffled = tmp_path / "shuffled"
    shutil.copytree(recording, shuffled)
    for name in names:
        (shuffled / "frames" / name).rename(shuffled / "frames" / given[name])
    (shuffled / "truth.csv").unlink()
    mixed = answers(shuffled, "thesis", "fused")
    assert all(plain[name, "fused"][0] for name in names)
    assert mixed == {(given[name], detector): answer for (name, detector), answer in plain.items()}
    (tmp_path / "echo.py").write_text(ECHO, encoding="utf-8")
    echo = f"exec:{sys.executable} {tmp_path / 'echo.py'}"
    heard, again = (answers(one, echo) for one in (recording, shuffled))
    # a program of its own gets nothing of the recording's names
    assert list(heard.values()) == list(again.values())
    assert "1 1-left.png 1-right.png" in str(heard[names[0], "exec-echo"][2])


@pytest.mark.parametrize(
    ("points", "size", "view"),
    [
        ([[700.0, 500.0], [800.0, 520.0]], (1360, 1024), (610, 405, 280, 210)),
        ([[0.0, 0.0]], (1, 1), None),
        ([[2000.0, 500.0]], (1360, 1024), None),
        ([], (1360, 1024), None),
    ],
)
def test_the_part_of_a_frame_that_is_shown_first(
    points: list[list[float]], size: tuple[int, int], view: object
) -> None:
    assert round_teats(np.array(points).reshape(-1, 2), *size) == view
