"""Detectors of every manner: what they do is scored as what it is."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from bench.examine import TruthRow, examine, score_answer
from bench.rig import RIGS, read_calibration
from bench.rows import detection_rows, score_row, stage_pictures
from bench.scoring.scene import scene_from_dict
from detector.calibration import Calibration
from detector.protocol import Detection, Frames, Stage, Teat
from instruments.camera.frame import FrameSet

TRUTH = [TruthRow("1", (0.0, 0.0, 100.0), True, 0.2), TruthRow("2", (50.0, 0.0, 100.0), True, 0.2)]
FRAMES = FrameSet(np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.uint8))


@dataclass(frozen=True)
class Scripted:
    """A detector that does what a function says."""

    does: Callable[[], Detection]
    name: str = "scripted"
    version: str = "1"

    @property
    def parameters(self) -> Mapping[str, Any]:
        return {}

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        return self.does()


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return read_calibration(RIGS / "calibration.toml")


def teat(*xyz: float) -> Teat:
    return Teat(np.array(xyz))


def test_a_good_answer_is_scored_and_stored(calibration: Calibration) -> None:
    answer = examine(Scripted(lambda: Detection((teat(1, 0, 100), teat(50, 2, 100)), 0)), FRAMES, calibration)
    score = score_answer(answer, TRUTH, limit_mm=5.0, time_limit_s=2.0)
    assert score.success
    assert sorted(score.radial_mm) == [1.0, 2.0]
    row = score_row("t", "scripted", score)
    assert "seconds" not in json.loads(str(row["score"]))
    again = scene_from_dict({**json.loads(str(row["score"])), **json.loads(str(row["wall_score"]))})
    assert again.as_dict() == score.as_dict()


def crash() -> Detection:
    raise RuntimeError("out of cheese")


@pytest.mark.parametrize(
    ("does", "teats", "reason"),
    [
        (crash, 0, "the detector failed: RuntimeError: out of cheese"),
        (lambda: Detection((teat(1, 2),), 0), 0, "not three finite numbers"),
        (lambda: Detection((teat(1, 2, np.nan),), 0), 0, "not three finite numbers"),
        (lambda: Detection((teat(1, 2, 3), teat(0, 0, 1e9)), 0), 1, "outside the working volume"),
        (lambda: None, 0, "the detector failed"),
    ],
)
def test_a_bad_answer_is_told_and_stops_nothing(calibration: Calibration, does: Callable[[], Detection], teats: int, reason: str) -> None:
    answer = examine(Scripted(does), FRAMES, calibration)
    assert len(answer.detection.teats) == teats
    assert reason in str(answer.detection.reason)
    assert answer.seconds > 0
    assert not score_answer(answer, TRUTH, limit_mm=5.0, time_limit_s=2.0).success


def test_stages_are_kept_points_in_the_record_and_masks_as_pictures(calibration: Calibration) -> None:
    mask = np.eye(30, dtype=bool)
    stages = (Stage("edges", {"mask": mask}), Stage("teat ends", {"points_px": np.array([[1.5, 2.5]])}))
    answer = examine(Scripted(lambda: Detection((), 2, None, stages)), FRAMES, calibration)
    head, found = detection_rows("t", answer)
    trace = json.loads(str(head["trace"]))
    assert trace["teat ends"]["points_px"] == [[1.5, 2.5]]
    assert trace["edges"]["mask"]["shape"] == [30, 30]
    assert found == []
    pictures = stage_pictures(answer)
    assert list(pictures) == ["scripted-edges"]
    assert (pictures["scripted-edges"] == mask * np.uint8(255)).all()
