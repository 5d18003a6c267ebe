"""What detectors say of a recording's frames, without a run: a line and a sentence for each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.config import ConfigError, read_calibration
from bench.record.recording import Recording, RecordingError
from bench.results.answers import Answer, Examiner, close_detectors, one_line
from bench.script.detectors import make_detectors, refusals
from detector.protocol import Detection, Detector, Outcome
from instruments.camera.frame import FrameSet
from textfiles.text import plural

SHOWN_LINES = 5


def detect_recording(
    path: Path | str, names: Sequence[str | Detector]
) -> Iterator[tuple[dict[str, Any], str]]:
    """For each frame and detector the JSON line of the recording format, and a sentence."""
    detectors = make_detectors(names)
    recording = Recording(Path(path))
    calibration = read_calibration(recording.calibration_path)
    if faults := list(refusals(detectors, calibration)):
        raise ConfigError.plain("\n".join(faults))
    examiner = Examiner(calibration)
    try:
        for frame in recording.frames:
            frames: FrameSet | None = None
            try:
                frames = recording.load(frame)
            except RecordingError as error:
                unread = Detection((), 0, str(error))
            for detector in detectors:
                if frames is None:
                    answer = Answer(detector.name, unread, 0.0, Outcome.FAILED)
                else:
                    answer = examiner.ask(detector, frames)
                yield _json_line(frame, answer), _sentence(frame, answer)
    finally:
        close_detectors(detectors)


def _json_line(frame: str, answer: Answer) -> dict[str, Any]:
    """The recording format's Detections; ``outcome``, ``stderr``, ``cold`` where they apply."""
    detection = answer.detection
    line: dict[str, Any] = {
        "frame": frame,
        "detector": answer.detector,
        "teats": [
            {"world_mm": _list(teat.world_mm), "covariance_mm2": _list(teat.covariance_mm2)}
            for teat in detection.teats
        ],
        "hidden": detection.hidden,
        "seconds": round(answer.seconds, 6),
    }
    if detection.reason is not None:
        line["reason"] = detection.reason
    if answer.outcome is not Outcome.ANSWERED:
        line["outcome"] = answer.outcome.value
    if words := _last_words(answer):
        line["stderr"] = "\n".join(words)
    return {**line, "cold": True} if answer.cold else line


def _sentence(frame: str, answer: Answer) -> str:
    detection = answer.detection
    places = "; ".join(", ".join(f"{v:.1f}" for v in teat.world_mm) for teat in detection.teats)
    head = f"{frame} {answer.detector}: {plural(len(detection.teats), 'teat')}"
    head += f", {detection.hidden} hidden"
    head += f"{f': {places} mm' if places else ''} ({answer.seconds:.3f} s)"
    head += f" - {detection.reason}" if detection.reason else ""
    return "\n    ".join([head, *_last_words(answer)])


def _last_words(answer: Answer) -> list[str]:
    """The last lines that a program without an answer wrote to its standard error."""
    lines = map(one_line, answer.stderr.splitlines())
    shown = [line for line in lines if line and answer.outcome is not Outcome.ANSWERED]
    return shown[-SHOWN_LINES:]


def _list(value: Any) -> Any:
    return None if value is None else np.asarray(value).tolist()
