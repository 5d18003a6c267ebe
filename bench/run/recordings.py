"""Detections only: what each detector finds in the frames of a recording, as lines for people and
for programs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.config import read_calibration
from bench.results.answers import Answer, Examiner, close_detectors, one_line
from bench.script.detectors import make_detectors
from detector.protocol import Detection, Detector, Outcome
from instruments.camera.recording import Recording, RecordingError

SHOWN_LINES = 5


def detect_lines(path: Path, names: Sequence[str]) -> Iterator[tuple[dict[str, Any], str]]:
    """For each frame and detector the JSON line of the recording format, and a sentence. A frame
    that can't be read is a line too.
    """
    detectors = make_detectors(names)
    recording = Recording(path)
    examiner = Examiner(read_calibration(recording.calibration_path))
    try:
        for frame in recording.frames:
            for answer in _answers(recording, frame, detectors, examiner):
                yield json_line(frame, answer), sentence(frame, answer)
    finally:
        close_detectors(detectors)


def _answers(
    recording: Recording, frame: str, detectors: Sequence[Detector], examiner: Examiner
) -> Iterator[Answer]:
    try:
        frames = recording.load(frame)
    except RecordingError as error:
        for detector in detectors:
            yield Answer(detector.name, Detection((), 0, str(error)), 0.0, Outcome.FAILED)
        return
    for detector in detectors:
        yield examiner.ask(detector, frames)


def json_line(frame: str, answer: Answer) -> dict[str, Any]:
    """One line of `teatbench detect --json` (the recording format, Detections); ``outcome``,
    ``stderr``, ``cold`` where they apply.
    """
    detection = answer.detection
    teats = [
        {"world_mm": _list(teat.world_mm), "covariance_mm2": _list(teat.covariance_mm2)}
        for teat in detection.teats
    ]
    line = {
        "frame": frame,
        "detector": answer.detector,
        "teats": teats,
        "hidden": detection.hidden,
        "seconds": round(answer.seconds, 6),
    }
    reason = {} if detection.reason is None else {"reason": detection.reason}
    outcome = {} if answer.outcome is Outcome.ANSWERED else {"outcome": answer.outcome.value}
    said = {"stderr": "\n".join(_last_words(answer))} if _last_words(answer) else {}
    return {**line, **reason, **outcome, **said, **({"cold": True} if answer.cold else {})}


def sentence(frame: str, answer: Answer) -> str:
    """The same for a person."""
    detection = answer.detection
    places = "; ".join(", ".join(f"{v:.1f}" for v in teat.world_mm) for teat in detection.teats)
    found = f"{len(detection.teats)} teats, {detection.hidden} hidden" + (
        f": {places} mm" if places else ""
    )
    head = f"{frame} {answer.detector}: {found} ({answer.seconds:.3f} s)" + (
        f" - {detection.reason}" if detection.reason else ""
    )
    return "\n    ".join([head, *_last_words(answer)])


def _last_words(answer: Answer) -> list[str]:
    """The last lines of what a program wrote to its standard error, where it gave no answer: they
    may say why.
    """
    lines = [one_line(line) for line in answer.stderr.splitlines()]
    return (
        []
        if answer.outcome is Outcome.ANSWERED
        else [line for line in lines if line][-SHOWN_LINES:]
    )


def _list(value: Any) -> Any:
    return None if value is None else np.asarray(value).tolist()
