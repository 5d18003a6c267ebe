"""Recordings, written while a run goes on, which `teatbench score` reads to the same scores.

Where a recording can't be written any more, that is warned of once, and the run goes on without. A
resumed run first puts in what its folder has and the recording lacks.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from bench.config import ConfigError, read_text
from bench.record.reader import RunRecord
from bench.record.recording import Recording, RecordingError, RecordingWriter, TruthRow
from bench.results.cameras_agree import truth_rows
from bench.truth.carrying import resumed
from bench.truth.uncertainty import TruthMethod
from instruments.camera.frame import FrameSet
from textfiles.whole import new_folders, refusal

RECORDED = "recorded to"  # fact: the recording's folder


@dataclass(eq=False)
class Recorder:
    """A recording in the new or empty ``folder``, or what the run ``before`` has recorded. ``warn``
    is called where it can't be written any more. Raises ConfigError.
    """

    folder: Path
    calibration: Path
    warn: Callable[[str], None]
    before: RunRecord | None = None

    def __post_init__(self) -> None:
        folder, before = self.folder, self.before
        self._broken = False
        self._open: dict[str, Sequence[TruthRow]] = {}
        try:
            if before is None and folder.exists() and any(folder.iterdir()):
                why = f"`record` {folder}: the folder is not empty. Name a new one."
                raise ConfigError.plain(why)
            known = {trial.id for trial in before.trials} if before else set()
            if others := _has(folder)[0] - known:
                why = f"`record` {folder}: has frames of another run, {min(others)} for one."
                raise ConfigError.plain(why)
            for unfinished in folder.glob("making *"):
                shutil.rmtree(unfinished)
            with new_folders(folder / "frames"):
                self._writer = RecordingWriter(folder)
                self._writer.add_calibration(read_text(self.calibration))
            if before:
                self._catch_up(before)
        except (OSError, RecordingError) as error:
            raise ConfigError.plain(f"`record` {folder}: {refusal(error)}") from error

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
            text = f"the recording in {self.folder} ends here: {refusal(error)}"
            self.warn(f"{text} The run goes on, and its own folder has all.")

    def _catch_up(self, run: RunRecord) -> None:
        """Put in what was written down but not yet recorded, and remember whose truth is open."""
        has_frames, has_truth = _has(self.folder)
        carried = resumed(run)
        for trial in run.trials:
            if trial.id not in has_frames:
                self._writer.add(trial.id, Recording(run.folder).load(trial.id))
            if trial.id in has_truth | set(carried.unconfirmed) or trial.invalid is not None:
                continue
            if trial.how == TruthMethod.CARRIED and trial.id in carried.since:
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
