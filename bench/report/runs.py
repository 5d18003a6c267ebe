"""All runs in a folder, read as they are now: each detector's verdict and figures, and the page
over them with the frames of each run's worst trial.
"""

from __future__ import annotations

import base64
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from bench.config import ConfigError, read_calibration
from bench.record.check import checked_first
from bench.record.reader import RunRecord, read_run
from bench.record.schema import DATABASE
from bench.report.growing import REPORT
from bench.report.trials import round_teats, shown, views_of, worst_trials
from bench.results.exports import has_report, write_queue_errors
from bench.results.health import charts, history
from bench.results.queue import NAME, QueueStatus, queues
from bench.results.status import RunStatus, status_of
from bench.results.verdicts import judge, scored, stored_rules
from bench.scoring.control_chart import BASE
from reports.figures.course import control_chart
from reports.page import Figure, Verdict
from reports.runs import PAGE, DetectorResult, Run, Runs, write_runs
from textfiles.text import plural, range_text, sentence

THUMBNAIL_PX = (200, 150)
QUALITY = 70


def list_runs(folder: Path | str = "runs") -> Runs:
    """Checks and reads each run in ``folder``. Raises ConfigError where there is no such folder."""
    folder = Path(folder)
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
    there = (one for one in folder.iterdir() if one.is_dir() and not _is_apart(one))
    for one in sorted(there):
        try:
            runs.append(_listed(one))
        except (ConfigError, OSError) as error:
            others.append((one.name, _unread(error)))
    runs.sort(key=lambda run: (run.started, run.folder.name), reverse=True)
    whole = {run.folder.name for run in runs if not run.damage}
    drawn = list(charts([one for one in history(folder) if one.run in whole]))
    health: dict[str, list[Figure]] = {}
    for number, chart in enumerate(drawn, 1):
        limits = (chart.limits.centre, chart.limits.sigma) if chart.limits else None
        first, last, broken = chart.dates[0], chart.dates[-1], [bool(rule) for rule in chart.rules]
        one_day = first[:10] == last[:10]  # named once, below the time at both ends
        ends = (f"{first[11:]}\n{first[:10]}", last[11:]) if one_day else (first[:10], last[:10])
        of = {"unit": chart.unit, "name": f"health-{number}"}
        svg = control_chart(chart.values, limits, broken, BASE, ends, **of)
        many = plural(len(chart.values), "run")
        health.setdefault(chart.rig, []).append(
            Figure(svg, chart.warning or chart.last, f"{chart.name}, {many}: {chart.last}")
        )
    warned = [chart.warning for chart in drawn if chart.warning]
    return Runs(folder, tuple(runs), tuple(others), health, warned)


def _is_apart(folder: Path) -> bool:
    """Whether it is no run by its name: hidden, or what a queue of runs has for CI services."""
    of_queue = folder.name.startswith(NAME.format("")) and not (folder / DATABASE).is_file()
    return of_queue or folder.name.startswith(".")


def _unread(error: Exception) -> str:
    """Why a run is not shown."""
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename} can't be read: {error.strerror}"
    return str(error)


def _listed(folder: Path) -> Run:
    if not (folder / DATABASE).is_file():
        raise ConfigError.plain(f"There is no {DATABASE} in it.")
    with checked_first([folder], despite_damage=True) as damage:
        run = read_run(folder, damage)
        scored_too = not run.damage and any(trial.scores for trial in run.trials)
        status = status_of(run, judge(run, stored_rules(folder)) if scored_too else ())
        facts = run.facts
        # what holds it back
        how = status.why if status.damage else sentence(status.headline)
        return Run(
            folder=folder,
            started=str(facts["wall_started"]),
            title=str(facts["title"]),
            script=str(facts.get("script") or facts["title"]),
            kind=facts["kind"],
            ending=run.ending,
            status=status.as_dict(),
            results=tuple(_results(run, status)),
            damage=damage,
            report=f"{folder.name}/{REPORT}/{PAGE}" if has_report(folder, damage) else "",
            note="" if status.decided else "\n".join((*status.unsafe, how, *status.then)),
            thumbnails=tuple(run_thumbnails(run)),
        )


def _results(run: RunRecord, status: RunStatus) -> Iterator[DetectorResult]:
    for name in run.detectors:
        pool, item = scored(run, name), run.facts["items"].get(name, {})
        radial, counts = np.linalg.norm(pool.errors_mm, axis=1), pool.counts
        middle, largest = (float(f(radial)) if len(radial) else None for f in (np.median, np.max))
        verdict, version = cast(Verdict, status.verdicts[name]), str(item.get("version", ""))
        numbers = (counts.visible, counts.matched, counts.false if pool.answered else None)
        yield DetectorResult(name, version, verdict, *numbers, middle, largest)


def run_thumbnails(run: RunRecord) -> Iterator[tuple[str, str]]:
    """The views of the worst trial, or of the first where none failed, cut to the teats."""
    trials = (*worst_trials(run), *run.trials)
    if not trials:
        return
    calibration = read_calibration(run.folder / "calibration.toml", doubtful=True)
    for camera, path, points in views_of(run, trials[0], calibration):
        if (image := shown(camera, path)) is None:
            continue
        if camera == "thermal" and calibration.thermal.mirrored:
            image = np.ascontiguousarray(image[:, ::-1])
        if cut := None if camera == "thermal" else round_teats(points, *image.shape[::-1]):
            x, y, width, height = cut
            image = image[y : y + height, x : x + width]
        small = cv2.resize(image, THUMBNAIL_PX, interpolation=cv2.INTER_AREA)
        _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        yield f"{camera}, trial {trials[0].id}", base64.b64encode(bytes(data)).decode("ascii")


def write_runs_page(found: Runs) -> Path:
    """Writes the page into the folder of the runs; gives back its path. Raises OSError."""
    return write_runs(found, f"{found.folder.resolve()}: {counted(found)}")


def queue_headline(out: Path, reported: Collection[str]) -> str:
    """How the queue of these runs stands, also where its own file could not be written."""
    for queue in queues(out, 1):
        if {*reported} <= {one.run for one in queue.scripts}:
            return queue.headline
    return f"{plural(len(reported), 'report')} written; the disk has no room for more"


def write_queue_page(out: Path | str = "runs") -> tuple[QueueStatus, Path]:
    """The last queue in ``out``, and its page. Raises ConfigError where there is none, OSError."""
    folder = Path(out)
    if (queue := next(queues(folder), None)) is None:
        raise ConfigError.plain(f"{out}: no queue of scripts was run here")
    begun, runs = {one.run for one in queue.scripts if one.run}, list[Run]()
    others = [(one.script, one.text) for one in queue.scripts if not one.run]
    for name in sorted(begun, reverse=True):
        try:
            runs.append(_listed(folder / name))
        except (ConfigError, OSError) as error:
            others.append((name, _unread(error)))
    found = Runs(folder, tuple(runs), tuple(others))
    title = f"Queue of {plural(len(queue.scripts), 'script')}"
    now = queue.headline.removesuffix(".")
    summary = f"{queue.rig}, begun {queue.started[:16].replace('T', ' ')}; {now}."
    write_queue_errors(folder, queue)
    name = f"{queue.name}.html"
    return queue, write_runs(found, summary, name=name, title=title, rest="Not run")


def counted(found: Runs) -> str:
    """How many there are, and what could not be read."""
    text = plural(len(found.runs), "run")
    if found.runs:
        text += f", {range_text(found.runs[-1].date[:10], found.runs[0].date[:10])}"
    held = sum(bool(run.damage) for run in found.runs)
    text += f"; not as written: {held}" if held else ""
    return text + (f"; {plural(len(found.others), 'other folder')}." if found.others else ".")
