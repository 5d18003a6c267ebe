"""Detections only: what each detector finds in the frames of a recording, as lines for people and for programs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.examine import Answer, examine
from bench.jobs import make_detectors
from bench.rig import read_calibration
from instruments.camera.recording import Recording, RecordingError


def detect_lines(path: Path, names: Sequence[str]) -> Iterator[tuple[dict[str, Any], str]]:
    """For each frame and detector the JSON line of the recording format, and a sentence. A frame that can't be read is a line too."""
    detectors = make_detectors(names)
    recording = Recording(path)
    calibration = read_calibration(recording.calibration_path)
    for frame in recording.frames:
        try:
            frames = recording.load(frame)
        except RecordingError as error:
            for detector in detectors:
                yield (
                    {"frame": frame, "detector": detector.name, "teats": [], "hidden": 0, "seconds": 0.0, "reason": str(error)},
                    str(error),
                )
            continue
        for detector in detectors:
            answer = examine(detector, frames, calibration)
            yield json_line(frame, answer), sentence(frame, answer)


def json_line(frame: str, answer: Answer) -> dict[str, Any]:
    """One line of `teatbench detect --json` (the recording format, Detections)."""
    detection = answer.detection
    teats = [{"world_mm": _list(teat.world_mm), "covariance_mm2": _list(teat.covariance_mm2)} for teat in detection.teats]
    line = {"frame": frame, "detector": answer.detector, "teats": teats, "hidden": detection.hidden, "seconds": round(answer.seconds, 6)}
    return line if detection.reason is None else {**line, "reason": detection.reason}


def sentence(frame: str, answer: Answer) -> str:
    """The same for a person."""
    detection = answer.detection
    places = "; ".join(", ".join(f"{v:.1f}" for v in teat.world_mm) for teat in detection.teats)
    found = f"{len(detection.teats)} teats, {detection.hidden} hidden" + (f": {places} mm" if places else "")
    return f"{frame} {answer.detector}: {found} ({answer.seconds:.3f} s)" + (f" - {detection.reason}" if detection.reason else "")


def _list(value: Any) -> Any:
    return None if value is None else np.asarray(value).tolist()
