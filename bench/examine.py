"""Runs a detector on a frame set and scores its answer, for runs and recordings alike.

A detector that fails, gives nonsense or is too slow is scored as what it did; it never stops a run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.scoring.scene import SceneScore, score_scene
from detector.calibration import Calibration
from detector.protocol import Detection, Detector, Frames
from instruments.clock import stopwatch_s

WORKING_VOLUME_MM = 2000.0  # no teat of any rig is further from the table's origin along an axis


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
