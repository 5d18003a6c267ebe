"""Writes a recording while a run goes on: frames, calibration and touched truth that `teatbench score` reads to the same scores."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench.config import ConfigError, read_text
from bench.detecting.examine import TruthRow
from instruments.camera.frame import FrameSet
from instruments.camera.recording import RecordingWriter
from instruments.camera.recording import TruthRow as RecordedTruth


class Recorder:
    """A new recording in ``folder``, which must be empty or not there. Raises ConfigError."""

    def __init__(self, folder: Path, calibration: Path) -> None:
        if folder.exists() and any(folder.iterdir()):
            raise ConfigError.plain(f"--record {folder}: the folder is not empty. Name a new one.")
        self._writer = RecordingWriter(folder)
        self._writer.add_calibration(read_text(calibration))
        self._open: dict[str, list[RecordedTruth]] = {}

    def trial(self, trial_id: str, situation: str, frames: FrameSet, truth: Sequence[TruthRow], *, confirmed: bool) -> None:
        """Add a trial's frame set with its truth; truth that isn't confirmed waits for `settled`, the frames stay without until then."""
        self._writer.add(trial_id, frames)
        rows = [RecordedTruth(situation, row.teat, row.point_mm, row.visible, row.u_mm) for row in truth]
        if confirmed:
            self._writer.add_truth(trial_id, rows)
        else:
            self._open[trial_id] = rows

    def settled(self, trials: Sequence[str], good: bool) -> None:
        """The truth of these trials holds, or it doesn't and is dropped."""
        for trial in trials:
            rows = self._open.pop(trial, None)
            if good and rows is not None:
                self._writer.add_truth(trial, rows)
