"""The trials' parts of a report with many trials, drawn while the run goes on.

A part is known by the SHA-256 of all that it is made from. The report takes what was drawn of the
same, and draws the rest: its bytes are the same either way. Parts wait, some 8 kB each, in this
process's memory: one that dies leaves none, and none is taken on another's word.
"""

from __future__ import annotations

import hashlib
import io
import math
import pickle
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from itertools import takewhile
from pathlib import Path

import numpy as np

from bench.config import read_calibration
from bench.files import sha256_of
from bench.record.reader import ALL, RunRecord, TrialRecord, read_trials
from bench.report.bath import AROUND_S, readings_at
from bench.report.beside import FigureProcess
from bench.report.glossary import terms
from bench.report.trials import trial_part
from bench.workers import processors
from detector.calibration import Calibration
from reports.page import TrialPart
from reports.render import TrialRenderer, in_page

MOST_MORE = 20  # trials at once beside the last: a fraction of a second
REPORT, CALIBRATION = "report", "calibration.toml"


class TrialParts:
    """Of the runs of one process; ``warn`` gets why those of a run grow no more."""

    def __init__(self, warn: Callable[[str], None] = lambda _: None) -> None:
        self._warn = warn
        self._next: dict[Path, int] = {}  # number of the first trial that is not drawn
        self._kept: dict[str, bytes] = {}
        self.figures: FigureProcess | None = None

    def close(self) -> None:
        """End the process that draws figures; once more is no error."""
        if self.figures:
            self.figures.end()
        self.figures = None

    def begin(self, planned: int) -> None:
        """Start the process that draws figures of a report of so many trials, where a second
        processor is there for it.
        """
        if self.figures is None and not in_page(planned, 1) and processors() > 1:
            with suppress(OSError, RuntimeError):  # no more processes or threads are to be had
                self.figures = FigureProcess()

    def wait(self) -> None:
        """Until nothing of it runs."""
        if self.figures:
            self.figures.wait()

    def grow(self, folder: Path, done: int, planned: int) -> None:
        """Draw trials of the run in ``folder``, where ``done`` of ``planned`` have passed: those
        about whose capture all is written, and of those that a session before left a share. Raises
        nothing, since the report draws what was not drawn.
        """
        first = self._next.get(folder, 1)
        more = max(0, done - first) // max(1, planned - done)
        last = min(done - 1, first + max(1, min(more, MOST_MORE)))
        if last < first:
            return
        try:
            run = read_trials(folder, first, last)
            # a reading that is still to come is at least as far from the last as that from the one
            # before
            times_s = run.bath[-2:, 0]
            until_s = times_s[-1] + np.ptp(times_s) - AROUND_S if len(times_s) else -math.inf
            there = takewhile(lambda trial: (trial.head["captured_s"] or 0.0) < until_s, run.trials)
            run = replace(run, trials=tuple(there))
            self._next[folder] = first + len(run.trials)
            self.draw(run, planned)
        except Exception as error:
            self._next[folder] = ALL[1]
            self._warn(f"The report of {folder} is drawn when the run has ended: {error}")

    def draw(self, run: RunRecord, planned: int) -> None:
        """Draw the trials of ``run``, which holds some of those ``planned``. Raises ConfigError."""
        if in_page(planned, len(run.detectors)):
            self._next[run.folder] = ALL[1]
            return
        sha256 = sha256_of(run.folder / CALIBRATION)
        calibration, press = _calibration(run.folder, sha256), _press(run.detectors)
        for trial in run.trials:
            part = _drawn(run, trial, calibration, run.folder / REPORT, press)
            self._kept[_digest(run, trial, sha256)] = zlib.compress(pickle.dumps(part), 1)

    def of(
        self, run: RunRecord, calibration: Calibration, folder: Path, copied: Collection[str] | None
    ) -> Iterator[TrialPart]:
        """Each trial's part for a page in ``folder``; images where ``copied``, or all for None."""
        press = TrialRenderer(run.detectors, terms())
        sha256 = sha256_of(run.folder / CALIBRATION) if self._kept else ""
        folder.mkdir(parents=True, exist_ok=True)  # images are found from it
        for trial in run.trials:
            if copied is None or trial.id in copied:
                yield trial_part(run, trial, calibration, folder, copied=copied)
                continue
            kept = self._found(_digest(run, trial, sha256), folder) if self._kept else None
            yield kept or _drawn(run, trial, calibration, folder, press)

    def _found(self, digest: str, folder: Path) -> TrialPart | None:
        """The part, where the images that it shows are still there."""
        if digest not in self._kept:
            return None
        part: TrialPart = pickle.loads(zlib.decompress(self._kept[digest]))  # noqa: S301 our own
        there = part.drawn and all((folder / one).is_file() for one in part.drawn.files)
        return part if there else None


@lru_cache(maxsize=1)
def _calibration(folder: Path, _sha256: str) -> Calibration:
    return read_calibration(folder / CALIBRATION, doubtful=True)


@lru_cache(maxsize=1)
def _press(detectors: tuple[str, ...]) -> TrialRenderer:
    return TrialRenderer(detectors, terms())


def _drawn(
    run: RunRecord, trial: TrialRecord, calibration: Calibration, folder: Path, press: TrialRenderer
) -> TrialPart:
    part = trial_part(run, trial, calibration, folder, copied=())
    return replace(part, images=(), summary=(), tables=(), notes=(), drawn=press(part))


def _digest(run: RunRecord, trial: TrialRecord, calibration_sha256: str) -> str:
    """Of all that a part is made from; of a picture its row has the SHA-256."""
    scores = [score.as_dict() for score in trial.scores.values()]
    rows = (trial.head, trial.frames, trial.truth, trial.detections, trial.found)
    of_run = (str(run.folder), run.detectors, run.facts.get("bath figures"), calibration_sha256)
    data = io.BytesIO()
    pickler = pickle.Pickler(data)  # takes an eighth of what the floats' decimals take
    pickler.fast = True  # by value, not by which of them are one object
    pickler.dump((of_run, rows, [*trial.scores], scores, readings_at(run, trial)))
    return hashlib.sha256(data.getvalue()).hexdigest()
