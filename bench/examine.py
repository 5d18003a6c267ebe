"""Runs a detector on a frame set and scores its answer: the one way from frames to rows, for runs and recordings alike.

A detector that fails, gives nonsense or is too slow is scored as what it did; it never stops a run.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.scoring.scene import SceneScore, score_scene
from bench.store import Picture, Row
from detector.calibration import Calibration
from detector.protocol import Detection, Detector, Frames
from instruments.clock import stopwatch_s

WORKING_VOLUME_MM = 2000.0  # no teat of any rig is further from the table's origin along an axis
WALL_KEYS = ("seconds", "in_time", "success")  # parts of a score that depend on real time


@dataclass(frozen=True, slots=True)
class Answer:
    """What a detector said of one frame set, and how long it took (real seconds)."""

    detector: str
    detection: Detection
    seconds: float


@dataclass(frozen=True, slots=True)
class TruthRow:
    """One teat as the scorer takes it. ``u_mm`` is the standard uncertainty along an axis."""

    teat: str
    point_mm: tuple[float, float, float]
    visible: bool
    u_mm: float | None


def examine(detector: Detector, frames: Frames, calibration: Calibration) -> Answer:
    """Detect, timed. Any exception of the detector becomes an answer without teats that gives it as the reason."""
    start = stopwatch_s()
    try:
        detection = _checked(detector.detect(frames, calibration))
    except Exception as error:
        detection = Detection((), 0, f"the detector failed: {type(error).__name__}: {error}", ())
    return Answer(detector.name, detection, stopwatch_s() - start)


def _checked(detection: Detection) -> Detection:
    for number, teat in enumerate(detection.teats, 1):
        point = np.asarray(teat.world_mm, dtype=np.float64)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise ValueError(f"teat {number} of its answer is {point.tolist()}, not three finite numbers")
        if np.abs(point).max() > WORKING_VOLUME_MM:
            reason = f"teat {number} of its answer is {np.round(point).tolist()} mm, outside the working volume"
            kept = tuple(t for t in detection.teats if np.abs(t.world_mm).max() <= WORKING_VOLUME_MM)
            return Detection(kept, detection.hidden, detection.reason or reason, detection.trace)
    return detection


def score_answer(answer: Answer, truth: Sequence[TruthRow], *, limit_mm: float, time_limit_s: float) -> SceneScore:
    """The score of one answer against the teats of its scene."""
    known = [row.u_mm for row in truth if row.u_mm is not None]
    return score_scene(
        points_of(answer.detection),
        np.array([row.point_mm for row in truth]),
        np.array([row.visible for row in truth]),
        u_mm=max(known, default=0.0),
        seconds=answer.seconds,
        limit_mm=limit_mm,
        time_limit_s=time_limit_s,
        hidden_claimed=answer.detection.hidden,
    )


def points_of(detection: Detection) -> NDArray[np.float64]:
    """The teat ends (n, 3) in world mm."""
    return np.array([teat.world_mm for teat in detection.teats], dtype=np.float64).reshape(-1, 3)


def detection_rows(trial: str, answer: Answer) -> tuple[Row, list[Row]]:
    """The rows of the tables ``detections`` and ``found``."""
    detection = answer.detection
    head = {
        "trial": trial,
        "detector": answer.detector,
        "hidden": detection.hidden,
        "reason": detection.reason,
        "trace": json.dumps({stage.name: {key: _small(value) for key, value in stage.data.items()} for stage in detection.trace}),
        "wall_seconds": answer.seconds,
    }
    found: list[Row] = []
    for number, teat in enumerate(detection.teats, 1):
        x, y, z = (float(v) for v in teat.world_mm)
        places = {"covariance_mm2": _json(teat.covariance_mm2), "left_px": _json(teat.left_px), "right_px": _json(teat.right_px)}
        found.append({"trial": trial, "detector": answer.detector, "number": number, "x_mm": x, "y_mm": y, "z_mm": z, **places})
    return head, found


def stage_pictures(answer: Answer) -> dict[str, Picture]:
    """The two-dimensional masks among a detector's stages as 8-bit pictures, by ``detector-stage``."""
    return {
        f"{answer.detector}-{stage.name.replace(' ', '-')}": np.where(mask, np.uint8(255), np.uint8(0))
        for stage in answer.detection.trace
        for mask in stage.data.values()
        if mask.dtype == np.bool_ and mask.ndim == 2
    }


def score_row(trial: str, detector: str, score: SceneScore) -> Row:
    """The row of the table ``scores``: what depends on real time stands apart, so that the rest repeats with the seed."""
    whole = score.as_dict()
    wall = {key: whole.pop(key) for key in WALL_KEYS}
    return {"trial": trial, "detector": detector, "score": json.dumps(whole), "wall_score": json.dumps(wall)}


def _json(value: Any) -> str | None:
    return None if value is None else json.dumps(np.asarray(value).tolist())


def _small(value: Any) -> Any:
    """Points and figures go into the record; pictures are told by their shape (masks are kept as files of their own)."""
    array = np.asarray(value)
    return array.tolist() if array.size <= 400 else {"shape": list(array.shape), "type": str(array.dtype)}
