"""All runs in a folder, read as they are now: each detector's verdict and figures, and the page
over them with the frames of each run's worst trial.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np

from bench.config import ConfigError, read_calibration
from bench.record.check import NOT_AS_WRITTEN, checked_first, shortened
from bench.record.reader import RunRecord, database_in, read_run
from bench.record.schema import DATABASE, SCRIPT
from bench.report.page import REPORT, stored_rules
from bench.report.trials import frames_of, round_teats, worst_trials
from bench.report.wording import number
from bench.results.verdicts import judge, scored
from bench.scoring.rates import plural
from bench.script.pixel_offsets import is_offset_script
from reports.page import Kind, Verdict
from reports.runs import History, Result, RunCard, RunsPage, Step, write_runs

PAGE = "index.html"
THUMBNAIL_PX = (200, 150)
QUALITY = 70


@dataclass(frozen=True, slots=True)
class DetectorResult:
    """One detector in one run. ``verdict`` is "aborted" in an unfinished run, "no verdict" where
    nothing was scored or the record is damaged; errors are None where nothing was found.
    """

    detector: str
    version: str
    verdict: Verdict
    visible: int
    found: int
    false: int
    median_error_mm: float | None
    max_error_mm: float | None

    @property
    def share(self) -> str:
        """``97 %`` of the visible teats found; a dash where none was visible."""
        return f"{100 * self.found // self.visible} %" if self.visible else "–"

    @property
    def text(self) -> str:
        """Its figures in a sentence."""
        if not self.visible:
            return "No visible teat was scored."
        text = f"{self.found} of {self.visible} visible teats found, {self.false} false"
        if self.max_error_mm is None:
            return f"{text}."
        median, most = (number(mm, "mm") for mm in (self.median_error_mm, self.max_error_mm))
        return f"{text}; error {median} in the median, {most} at most."


@dataclass(frozen=True, slots=True)
class ListedRun:
    """A run that could be read; ``damage`` says what isn't as it was written."""

    folder: Path
    started: str
    title: str
    script: str
    kind: Kind
    ending: str
    trials: int
    planned: int | None
    results: tuple[DetectorResult, ...]
    damage: tuple[str, ...]
    thumbnails: tuple[tuple[str, str], ...]

    @property
    def date(self) -> str:
        """``2026-11-22 14:05``."""
        return datetime.fromisoformat(self.started).strftime("%Y-%m-%d %H:%M")

    @property
    def report(self) -> str:
        """Its report's path from the folder of runs; empty where there is none."""
        there = self.folder / REPORT / PAGE
        return f"{self.folder.name}/{REPORT}/{PAGE}" if there.is_file() else ""

    @property
    def note(self) -> str:
        """What holds it back; empty for a whole and finished run."""
        if self.damage:
            return f"{NOT_AS_WRITTEN}: {shortened(self.damage)}"
        if self.ending == "finished":
            return ""
        ending = "interrupted, or still under way" if self.ending == "interrupted" else self.ending
        return f"{ending[0].upper()}{ending[1:]}: {self.trials} of {self.planned or '?'} trials."

    def as_dict(self) -> dict[str, Any]:
        """As JSON takes it."""
        shown = asdict(replace(self, thumbnails=()))
        del shown["thumbnails"]
        return shown | {"folder": str(self.folder), "report": self.report}


@dataclass(frozen=True, slots=True)
class RunList:
    """The runs in ``folder``, newest first, and the other folders with why they are no run."""

    folder: Path
    runs: tuple[ListedRun, ...]
    others: tuple[tuple[str, str], ...]

    def histories(self) -> Mapping[tuple[str, str], Sequence[tuple[ListedRun, DetectorResult]]]:
        """Detector and script with their runs, oldest first."""
        found: dict[tuple[str, str], list[tuple[ListedRun, DetectorResult]]] = {}
        for run in reversed(self.runs):
            for result in run.results:
                found.setdefault((result.detector, run.script), []).append((run, result))
        return dict(sorted(found.items()))


def list_runs(folder: Path) -> RunList:
    """Checks and reads each run in ``folder``. Raises ConfigError where there is no such folder."""
    if not folder.is_dir():
        raise ConfigError.plain(
            f"{folder}: no such folder. Give the folder that holds the runs; 'teatbench run' makes"
            " runs/."
        )
    if (folder / DATABASE).is_file():
        raise ConfigError.plain(
            f"{folder} is one run. Give the folder that holds it: {folder.resolve().parent}"
        )
    runs: list[ListedRun] = []
    others: list[tuple[str, str]] = []
    there = (one for one in folder.iterdir() if one.is_dir() and not one.name.startswith("."))
    for one in sorted(there):
        try:
            runs.append(_listed(one))
        except (ConfigError, OSError) as error:
            others.append((one.name, _why(one, error)))
    runs.sort(key=lambda run: (run.started, run.folder.name), reverse=True)
    return RunList(folder, tuple(runs), tuple(others))


def _why(folder: Path, error: Exception) -> str:
    if (folder / DATABASE).is_file():
        return str(error)
    with suppress(ConfigError, OSError):
        if is_offset_script(folder / SCRIPT):
            return f"A calculation of pixel offsets, without trials: see {REPORT}/{PAGE} in it."
    return f"There is no {DATABASE} in it."


def _listed(folder: Path) -> ListedRun:
    database_in(folder)
    with checked_first([folder], despite_damage=True) as damage:
        run = read_run(folder, damage)
        facts, kind = run.facts, str(run.facts["kind"])
        return ListedRun(
            folder=folder,
            started=str(facts["wall_started"]),
            title=str(facts["title"]),
            script=str(facts.get("script") or facts["title"]),
            kind=next(known for known in get_args(Kind) if known == kind),
            ending=run.ending,
            trials=len(run.trials),
            planned=facts.get("planned"),
            results=tuple(_results(run)),
            damage=damage,
            thumbnails=tuple(run_thumbnails(run)),
        )


def _results(run: RunRecord) -> Iterator[DetectorResult]:
    verdicts: dict[str, Verdict] = {}
    if not run.damage and run.ending != "finished":
        verdicts = dict.fromkeys(run.detectors, "aborted")
    elif not run.damage and any(trial.scores for trial in run.trials):
        verdicts = {one.detector: one.verdict.value for one in judge(run, stored_rules(run.folder))}
    for name in run.detectors:
        pool, item = scored(run, name), run.facts["items"].get(name, {})
        radial = np.linalg.norm(pool.errors_mm, axis=1)
        yield DetectorResult(
            detector=name,
            version=str(item.get("version", "")),
            verdict=verdicts.get(name, "no verdict"),
            visible=pool.counts.visible,
            found=pool.counts.matched,
            false=pool.counts.false,
            median_error_mm=float(np.median(radial)) if len(radial) else None,
            max_error_mm=float(radial.max()) if len(radial) else None,
        )


def run_thumbnails(run: RunRecord) -> Iterator[tuple[str, str]]:
    """The views of the worst trial, or of the first where none failed, cut to the teats."""
    trials = (*worst_trials(run), *run.trials)
    if not trials:
        return
    calibration = read_calibration(run.folder / "calibration.toml")
    for camera, image, points in frames_of(run, trials[0], calibration):
        if cut := None if camera == "thermal" else round_teats(points, *image.shape[::-1]):
            x, y, width, height = cut
            image = image[y : y + height, x : x + width]
        small = cv2.resize(image, THUMBNAIL_PX, interpolation=cv2.INTER_AREA)
        _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        yield f"{camera}, trial {trials[0].id}", base64.b64encode(bytes(data)).decode("ascii")


def write_runs_page(found: RunList) -> Path:
    """Writes the page into the folder of the runs; gives back its path. Raises OSError."""
    cards = tuple(
        RunCard(
            name=run.folder.name,
            href=run.report,
            date=run.date,
            title=run.title,
            script=run.script,
            kind=run.kind,
            note=run.note,
            results=tuple(Result(one.detector, one.verdict, one.text) for one in run.results),
            thumbnails=run.thumbnails,
        )
        for run in found.runs
    )
    histories = tuple(
        History(detector, script, tuple(_step(*pair) for pair in pairs))
        for (detector, script), pairs in found.histories().items()
    )
    summary = f"{found.folder.resolve()}: {counted(found)}"
    page = RunsPage("Runs", summary, cards, histories, found.others)
    return write_runs(page, found.folder / PAGE)


def _step(run: ListedRun, result: DetectorResult) -> Step:
    version = f" {result.version}" if result.version else ""
    hint = f"{run.date}, {result.detector}{version}: {result.verdict}. {result.text}"
    return Step(result.verdict, result.share, run.report, hint)


def counted(found: RunList) -> str:
    """How many there are, and what could not be read."""
    text = plural(len(found.runs), "run")
    if found.runs:
        text += f", {found.runs[-1].date[:10]} to {found.runs[0].date[:10]}"
    held = sum(bool(run.damage) for run in found.runs)
    text += f"; not as written: {held}" if held else ""
    return text + (f"; {plural(len(found.others), 'other folder')}." if found.others else ".")
