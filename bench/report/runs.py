"""All runs in a folder, read as they are now: each detector's verdict and figures, and the page
over them with the frames of each run's worst trial.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from bench.config import ConfigError, read_calibration
from bench.record.check import NOT_AS_WRITTEN, checked_first, shortened
from bench.record.reader import RunRecord, database_in, read_run
from bench.record.schema import DATABASE
from bench.record.state import State
from bench.report.page import REPORT
from bench.report.trials import frames_of, round_teats, worst_trials
from bench.report.wording import STOPPED
from bench.results.exports import trial_text, trials_of
from bench.results.verdicts import judge, scored, stored_rules
from bench.scoring.rates import plural
from reports.page import Verdict
from reports.runs import PAGE, Result, Run, Runs, write_runs

THUMBNAIL_PX = (200, 150)
QUALITY = 70


def list_runs(folder: Path) -> Runs:
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
    runs: list[Run] = []
    others: list[tuple[str, str]] = []
    there = (one for one in folder.iterdir() if one.is_dir() and not one.name.startswith("."))
    for one in sorted(there):
        try:
            runs.append(_listed(one))
        except (ConfigError, OSError) as error:
            others.append((one.name, _why(one, error)))
    runs.sort(key=lambda run: (run.started, run.folder.name), reverse=True)
    return Runs(folder, tuple(runs), tuple(others))


def _why(folder: Path, error: Exception) -> str:
    if (folder / DATABASE).is_file():
        return str(error)
    return f"There is no {DATABASE} in it."


def _listed(folder: Path) -> Run:
    database_in(folder)
    with checked_first([folder], despite_damage=True) as damage:
        run = read_run(folder, damage)
        facts, report = run.facts, f"{REPORT}/{PAGE}"
        return Run(
            folder=folder,
            started=str(facts["wall_started"]),
            title=str(facts["title"]),
            script=str(facts.get("script") or facts["title"]),
            kind=facts["kind"],
            ending=run.ending,
            state=run.state.value,
            trials=len(run.trials),
            planned=facts.get("planned"),
            results=tuple(_results(run)),
            damage=damage,
            report=f"{folder.name}/{report}" if (folder / report).is_file() else "",
            note=_note(run),
            thumbnails=tuple(run_thumbnails(run)),
        )


def _note(run: RunRecord) -> str:
    """What holds it back; empty for a whole and finished run."""
    if run.damage:
        return f"{NOT_AS_WRITTEN}: {shortened(run.damage)}"
    if run.ending == "finished":
        return ""
    how = trial_text(run) if run.state is State.RUNNING else ""
    return f"{run.state.capitalize()}: {how or f'{len(run.trials)} of {trials_of(run.facts)}'}."


def _results(run: RunRecord) -> Iterator[Result]:
    verdicts: dict[str, Verdict] = {}
    if not run.damage and run.ending != "finished":
        verdicts = dict.fromkeys(run.detectors, STOPPED[run.state])
    elif not run.damage and any(trial.scores for trial in run.trials):
        verdicts = {one.detector: one.verdict.value for one in judge(run, stored_rules(run.folder))}
    for name in run.detectors:
        pool, item = scored(run, name), run.facts["items"].get(name, {})
        radial = np.linalg.norm(pool.errors_mm, axis=1)
        yield Result(
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
    calibration = read_calibration(run.folder / "calibration.toml", doubtful=True)
    for camera, image, points in frames_of(run, trials[0], calibration):
        if cut := None if camera == "thermal" else round_teats(points, *image.shape[::-1]):
            x, y, width, height = cut
            image = image[y : y + height, x : x + width]
        small = cv2.resize(image, THUMBNAIL_PX, interpolation=cv2.INTER_AREA)
        _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        yield f"{camera}, trial {trials[0].id}", base64.b64encode(bytes(data)).decode("ascii")


def write_runs_page(found: Runs) -> Path:
    """Writes the page into the folder of the runs; gives back its path. Raises OSError."""
    return write_runs(found, f"{found.folder.resolve()}: {counted(found)}")


def counted(found: Runs) -> str:
    """How many there are, and what could not be read."""
    text = plural(len(found.runs), "run")
    if found.runs:
        text += f", {found.runs[-1].date[:10]} to {found.runs[0].date[:10]}"
    held = sum(bool(run.damage) for run in found.runs)
    text += f"; not as written: {held}" if held else ""
    return text + (f"; {plural(len(found.others), 'other folder')}." if found.others else ".")
