"""Figures that a process beside the report's draws are the figures that are drawn without one."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import pytest

from bench.report import beside
from bench.report.beside import FigureProcess, drawn_beside
from bench.report.growing import TrialParts
from bench.report.page import write_run_report
from reports.figures import drawing
from reports.figures.course import found_bars, latency_strip
from reports.page import Banner, Figure, Fold, Page, Part, Section
from tests.bench.small_run import KEPT

PATIENCE_S = 600.0
STRIP = ([0.1, 0.4, 0.2], [1.0, 2.0])
BARS = (["near", "far"], [4, 3], [4, 4], [None, 4])


def finished(parts: Iterable[Part], process: FigureProcess | None) -> Page:
    """The page of one section."""
    banner = Banner("emulated", "met", "", "", "", "")
    with drawn_beside(process) as whole:
        return whole(Page("", "", banner, (Section("figures", "", tuple(parts)),)))


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Iterator[FigureProcess]:
    """On a machine with much else to do it takes long to start."""
    monkeypatch.setattr(beside, "LIMIT_S", PATIENCE_S)
    made = FigureProcess()
    yield made
    made.end()


def test_it_draws_the_same(process: FigureProcess) -> None:
    assert process.draw(latency_strip, STRIP, {"who": 1}) == latency_strip(*STRIP, who=1)
    assert process.draw(found_bars, BARS, {}) == found_bars(*BARS)


def test_what_it_can_t_draw_is_raised_here(process: FigureProcess) -> None:
    wrong = ([float("nan")], [1.0])
    assert process.draw(latency_strip, wrong, {}) == ""
    with pytest.raises(ValueError, match="not finite"):
        finished((Figure(latency_strip(*wrong), "", "") for _ in range(1)), process)
    assert process.draw(latency_strip, STRIP, {}) == latency_strip(*STRIP), "it goes on"


def test_some_are_drawn_here_and_some_there(
    process: FigureProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first here waits until the process has begun; it waits with its second for that."""

    def chapter(first: int) -> Iterator[Part]:
        one, *inner, last = (
            Figure(latency_strip([0.1 * number], [1.0], name=f"strip-{number}"), "", "")
            for number in range(first, first + 4)
        )
        yield from (one, Fold("", (Fold("", tuple(inner)),)), last)

    alone = finished(chain(chapter(1), chapter(5)), None)
    begun, drew, asked = threading.Event(), threading.Event(), list[Any]()
    here, there = drawing.draw, process.draw

    def drawn_here(plot: drawing.Plot) -> str:
        assert begun.wait(PATIENCE_S)
        drew.set()
        return here(plot)

    def elsewhere(*figure: Any) -> str:
        asked.append(figure)
        begun.set()
        assert len(asked) == 1 or drew.wait(PATIENCE_S)
        return there(*figure)

    monkeypatch.setattr(drawing, "draw", drawn_here)
    monkeypatch.setattr(process, "draw", elsewhere)
    assert finished(chain(chapter(1), chapter(5)), process) == alone
    assert 0 < len(asked) < 8


@pytest.mark.parametrize("how", ["killed", "silent", "asked for what no pickle holds"])
def test_one_that_is_gone_is_done_without(
    process: FigureProcess, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if how == "killed":
        process.kill("by a test")
        process.process.wait()
    elif how != "silent":
        assert process.draw(latency_strip, STRIP, {"name": threading.Lock()}) == ""
    else:
        monkeypatch.setattr(process, "ask", lambda _: None)
        monkeypatch.setattr(beside, "LIMIT_S", 0.01)
    for _ in range(2):
        assert process.draw(latency_strip, STRIP, {}) == ""
    assert process.process.wait() is not None
    made = [finished(iter([Figure(latency_strip(*STRIP), "", "")]), one) for one in (process, None)]
    assert made[0] == made[1]


@pytest.mark.slow
def test_a_report_that_two_processes_draw_has_the_same_bytes(
    process: FigureProcess, tmp_path: Path
) -> None:
    folder, parts, written = Path(shutil.copytree(KEPT, tmp_path / "run")), TrialParts(), []
    for parts.figures in (None, process):
        write_run_report(folder, parts=parts)
        report = (folder / "report").rglob("*")
        written.append({path: path.read_bytes() for path in report if path.is_file()})
    assert written[0] == written[1]


@pytest.mark.parametrize(("planned", "processors", "there"), [(41, 2, 1), (40, 2, 0), (41, 1, 0)])
def test_a_short_run_and_a_single_processor_have_none(
    planned: int, processors: int, there: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = list[str]()

    class Noted:
        def __init__(self) -> None:
            made.append("")

        def end(self) -> None:
            made.append("ended")

    monkeypatch.setattr("bench.report.growing.FigureProcess", Noted)
    monkeypatch.setattr("bench.report.growing.processors", lambda: processors)
    parts = TrialParts()
    for _ in range(2):
        parts.begin(planned)
    for _ in range(2):
        parts.close()
    assert made == ["", "ended"] * there
