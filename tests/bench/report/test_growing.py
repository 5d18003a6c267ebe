"""A report that grows with its run has the bytes of one that is made afterwards."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bench
from bench.cli.main import main
from bench.config import read_calibration
from bench.record.reader import RunRecord, read_run
from bench.record.schema import DATABASE
from bench.report import growing
from bench.report.bath import readings_at
from bench.report.growing import TrialParts
from bench.report.page import write_run_report
from tests.bench.killed_runs import Silent
from tests.bench.operated_runs import SCRIPT, files, run_of
from tests.bench.small_run import KEPT

POSES = ", ".join(f"{{ x_mm = {x}.0 }}" for x in range(8))
EIGHT = SCRIPT[: SCRIPT.index("poses =")] + f"poses = [{POSES}]\n"


class Stopped(Silent):
    """Ctrl-C before the sixth trial."""

    def trial(self, done: int, total: int, name: str) -> None:
        if done == 5:
            raise KeyboardInterrupt


@pytest.fixture(autouse=True)
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The trials that are drawn; each has a file of its own."""
    monkeypatch.setattr("reports.render.IN_PAGE", 0)
    draw, seen = growing._drawn, list[str]()

    def noted(run: RunRecord, trial: Any, *more: Any) -> Any:
        seen.append(trial.id)
        return draw(run, trial, *more)

    monkeypatch.setattr(growing, "_drawn", noted)
    return seen


def bytes_of(folder: Path) -> Mapping[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_it_grows_with_a_run_and_with_what_resumes_it(
    tmp_path: Path, drawn: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = list[str]()

    class Noted:
        """The process that draws figures: it can't draw any."""

        def __init__(self) -> None:
            assert not drawn, "it is there before the first trial is drawn"
            figures.append("begun")

        def wait(self) -> None:
            assert not drawn, "and sleeps by then"
            figures.append("waited for")

        def draw(self, *_: object) -> str:
            return ""

        def end(self) -> None:
            assert [*tmp_path.rglob("report/index.html")]
            figures.append("ended")

    monkeypatch.setattr(growing, "FigureProcess", Noted)
    monkeypatch.setattr(growing, "processors", lambda: 2)
    _, script, _, rig, _, out = files(tmp_path, script=EIGHT)
    for grown in (2, 6):
        if grown == 2:
            bench.run_script(script, rig, out=out, progress=Stopped())
        else:
            assert main(["resume", str(run_of(tmp_path).folder)]) in (0, 1, 4)
        assert figures == ["begun", "waited for", "ended"]
        figures.clear()
        run = run_of(tmp_path)
        names = [trial.id for trial in run.trials]
        assert drawn[:grown] == names[:grown]
        assert len(set(drawn)) == len(drawn), "each is drawn once"
        assert len([*run.folder.glob("report/trials/*.html")]) == len(names)
        written = bytes_of(run.folder / "report")
        write_run_report(run.folder)
        assert bytes_of(run.folder / "report") == written
        drawn.clear()


def changed(run: RunRecord, **rows: Any) -> RunRecord:
    return replace(run, trials=(replace(run.trials[0], **rows), *run.trials[1:]))


@pytest.mark.slow
def test_what_is_drawn_of_something_else_is_not_taken(drawn: list[str], tmp_path: Path) -> None:
    folder = Path(shutil.copytree(KEPT, tmp_path / "run"))
    parts, run = TrialParts(), read_run(folder)
    parts.draw(run, 100)
    calibration = read_calibration(folder / "calibration.toml")
    one = run.trials[0]
    near = np.vstack([[one.head["captured_s"], 20.0, 0.0], run.bath])
    others = [
        changed(run, head={**one.head, "invalid": "the check said so"}),
        changed(run, truth=[{**row, "x_mm": row["x_mm"] + 1.0} for row in one.truth]),
        changed(run, detections=[{**row, "trace": "{}"} for row in one.detections]),
        changed(run, found=[{**row, "z_mm": row["z_mm"] + 1.0} for row in one.found]),
        changed(run, scores={}),
        changed(run, frames=[{**row, "path": "gone.png"} for row in one.frames]),
        replace(run, bath=near, external_c=np.append(np.nan, run.external_c)),
        replace(run, facts={**run.facts, "bath figures": None}),
    ]
    elsewhere = replace(others[6], bath_sessions=(2, *run.bath_sessions))
    assert readings_at(elsewhere, one) == readings_at(run, one) != readings_at(others[6], one)
    for other in (run, *others):
        drawn.clear()
        taken = [*parts.of(other, calibration, folder / "report", ())]
        assert (one.id in drawn) == (other is not run)
        assert taken == [*TrialParts().of(other, calibration, folder / "report", ())]


@pytest.mark.parametrize(("later_s", "there"), [(4.0, 0), (5.0, 1)])
def test_a_trial_is_drawn_once_all_readings_about_its_capture_are_written(
    drawn: list[str], tmp_path: Path, later_s: float, there: int
) -> None:
    """They come every second, and those within five belong to it."""
    folder = Path(shutil.copytree(KEPT, tmp_path / "run"))
    one = read_run(folder).trials[0]
    with closing(sqlite3.connect(folder / DATABASE)) as db, db:
        db.execute("UPDATE trials SET captured_s = 10.5")
        db.execute("DELETE FROM bath WHERE t_s > ?", (10.5 + later_s,))
    parts = TrialParts()
    parts.grow(folder, 2, 100)
    assert drawn == [one.id][:there]
    parts.grow(folder, 2, 100)
    assert drawn == [one.id][:there]


def test_what_can_t_be_drawn_is_said_once(tmp_path: Path) -> None:
    said = list[str]()
    parts = TrialParts(said.append)
    for done in (2, 3, 4):
        parts.grow(tmp_path, done, 100)
    (text,) = said
    assert text.startswith(f"The report of {tmp_path} is drawn when the run has ended: ")
