"""Recordings: written while a run goes on (frames, calibration and touched truth that `teatbench
score` reads to the same scores), and looked at by detectors alone.

Where a recording can't be written any more, that is warned of once, and the run goes on without. A
resumed run first puts in what its folder has and the recording lacks.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from bench.config import ConfigError, read_calibration, read_text
from bench.record.reader import RunRecord
from bench.record.recording import Recording, RecordingError, RecordingWriter, TruthRow
from bench.results.answers import Answer, Examiner, close_detectors, one_line
from bench.results.cameras_agree import truth_rows
from bench.script.detectors import make_detectors, refusals
from bench.truth.carrying import resumed
from bench.truth.uncertainty import How
from detector.protocol import Detection, Outcome
from instruments.camera.frame import FrameSet

RECORDED = "recorded to"  # fact: the recording's folder
SHOWN_LINES = 5


class Recorder:
    """A recording in the new or empty ``folder``, or what the run ``before`` has recorded. ``warn``
    is called where it can't be written any more. Raises ConfigError.
    """

    def __init__(
        self,
        folder: Path,
        calibration: Path,
        warn: Callable[[str], None],
        before: RunRecord | None = None,
    ) -> None:
        self._folder = folder
        self._warn = warn
        self._broken = False
        self._open: dict[str, Sequence[TruthRow]] = {}
        try:
            if before is None and folder.exists() and any(folder.iterdir()):
                why = f"--record {folder}: the folder is not empty. Name a new one."
                raise ConfigError.plain(why)
            known = {trial.id for trial in before.trials} if before else set()
            if others := _has(folder)[0] - known:
                why = f"--record {folder}: has frames of another run, {min(others)} for one."
                raise ConfigError.plain(why)
            for unfinished in folder.glob("making *"):
                shutil.rmtree(unfinished)
            self._writer = RecordingWriter(folder)
            self._writer.add_calibration(read_text(calibration))
            if before:
                self._catch_up(before)
        except (OSError, RecordingError) as error:
            raise ConfigError.plain(f"--record {folder}: {error}.") from error

    def trial(
        self, trial_id: str, frames: FrameSet, truth: Sequence[TruthRow], *, confirmed: bool
    ) -> None:
        """Add a trial's frames and truth; truth that isn't ``confirmed`` waits for `settled`."""
        if self._broken:  # a recording with holes would be taken for a whole one
            return
        with self._watched():
            self._writer.add(trial_id, frames)
            if confirmed:
                self._writer.add_truth(trial_id, truth)
            else:
                self._open[trial_id] = truth

    def settled(self, trials: Sequence[str], good: bool) -> None:
        """The truth of these trials holds, or it doesn't and is dropped."""
        rows = {trial: self._open.pop(trial) for trial in trials if trial in self._open}
        with self._watched():
            for trial in rows if good and not self._broken else ():
                self._writer.add_truth(trial, rows[trial])

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except (OSError, RecordingError) as error:
            self._broken = True
            text = f"the recording in {self._folder} ends here: {error}"
            self._warn(f"{text}. The run goes on, and its own folder has all")

    def _catch_up(self, run: RunRecord) -> None:
        """Put in what was written down but not yet recorded, and remember whose truth is open."""
        has_frames, has_truth = _has(self._folder)
        carried = resumed(run)
        for trial in run.trials:
            if trial.id not in has_frames:
                self._writer.add(trial.id, Recording(run.folder).load(trial.id))
            if trial.id in has_truth | set(carried.unconfirmed) or trial.invalid is not None:
                continue
            if trial.how == How.CARRIED and trial.id in carried.since:
                self._open[trial.id] = truth_rows(trial)
            else:
                self._writer.add_truth(trial.id, truth_rows(trial))


def recorder_again(
    run: RunRecord, calibration: Path, warn: Callable[[str], None]
) -> Recorder | None:
    """The recording of a run that goes on; None, with a warning, where it can't go on."""
    where = run.facts.get(RECORDED)
    if where is None:
        return None
    try:
        return Recorder(Path(where), calibration, warn, run)
    except ConfigError as error:
        warn(f"{error} The run goes on without a recording.")
        return None


def _has(folder: Path) -> tuple[set[str], set[str]]:
    """Trials with frames, and with truth."""
    frames = {path.name for path in (folder / "frames").glob("*")}
    return frames, set(Recording(folder).truth) if frames else set()


def detect_lines(path: Path, names: Sequence[str]) -> Iterator[tuple[dict[str, Any], str]]:
    """For each frame and detector the JSON line of the recording format, and a sentence."""
    detectors = make_detectors(names)
    recording = Recording(path)
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
    head = f"{frame} {answer.detector}: {len(detection.teats)} teats, {detection.hidden} hidden"
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
