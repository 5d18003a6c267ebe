"""Moments that the table of kills has not: amid an operator's prompt, at `resume`, a second
instrument lost while the first is away, after the last trial, between two scripts of a queue. All
surfaces say the same of a run then, with the same ages.
"""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from bench.console import watching
from bench.record.reader import read_run
from bench.record.writer import Store
from bench.report import summary
from bench.report.page import write_run_report
from bench.report.runs import list_runs, write_queue_page
from bench.results.exports import drop_report
from bench.results.queue import queues
from bench.results.status import LinkState, RunStatus, Safe, read_status
from bench.rig.loading import load_rig
from bench.rig.model import Rig
from bench.run import start as run_start
from bench.run.events import Events, read_events
from bench.run.start import RunOptions, resume_run, run_queue
from bench.safety.bath_monitor import PERIOD_S
from bench.script.model import LoadedScript, load_script
from instruments.operators.emulated import EmulatedOperator
from instruments.operators.operator import KIND_OF, Answer, Request
from tests.bench.killed_runs import Person
from tests.bench.operated_runs import CHECK_POINT, SCRIPT, STAGE, files
from tests.bench.run.test_kills import (
    BACK_S,
    INSTRUMENTS,
    LIMITS,
    Watch,
    compare_the_surfaces,
    same,
    seen,
)

pytestmark = pytest.mark.slow

ASK = EmulatedOperator.ask
LONG_S, SHORT_S = 1800.0, 30.0  # that the operator takes for one prompt
LOOK_S = 3.0  # and what is back is seen by then
EACH_S = 300.0  # all surfaces are compared so often, and at each change of a link


@dataclass
class Moment(Watch):
    """Compares all surfaces; the operator takes ``long_s`` for the first prompt of ``kind``. The
    instrument is lost then, or where ``kind`` is empty in the state ``at``, and ``second`` once the
    first is away.
    """

    kind: str = ""
    long_s: float = SHORT_S
    second: str = ""
    lost: bool = True
    compared: list[RunStatus] = field(default_factory=list)
    times: list[tuple[float, RunStatus]] = field(default_factory=list)
    next_s: float = 0.0
    links: tuple[LinkState, ...] = ()
    asked: bool = False
    is_open: bool = False  # the rig, as the first status says

    def wants(self, status: RunStatus) -> bool:
        self.is_open = True
        return self.lost or self.compares(status)

    def published(self, folder: Path, status: RunStatus) -> None:
        if self.lost:
            super().published(folder, status)
        if rig := self.rig or self.twin:
            self.times.append((rig._clock.now(), status))
        if self.compares(status):
            self.next_s, self.links = self.times[-1][0] + EACH_S, links_of(status)
            self.compared.append(status)
            all_say(folder, status)

    def compares(self, status: RunStatus) -> bool:
        """Whether all surfaces are compared now."""
        rig = self.rig or self.twin
        return rig is not None and (
            rig._clock.now() >= self.next_s or links_of(status) != self.links
        )

    def event(self, kind: str, text: str) -> None:
        super().event(kind, text)
        if kind == "dropped out" and self.second and self.rig:
            self.rig.listeners[self.second].close()
            self.second = ""

    def takes_long(self, operator: EmulatedOperator, request: Request, *more: Any) -> Answer:
        if self.asked or KIND_OF.get(type(request)) != self.kind:
            return ASK(operator, request, *more)
        self.asked, operator._prompt_s = True, self.long_s
        if self.lost:
            self.bring()
        try:
            return ASK(operator, request, *more)
        finally:
            operator._prompt_s = 0.0


def all_say(folder: Path, status: RunStatus) -> None:
    """The same, of a run under way."""
    listed = next(one for one in list_runs(folder.parent).runs if one.folder == folder)
    cards = {card["name"]: card for card in watching.listed(folder.parent)}
    written = write_run_report(folder)
    report = folder / "report"
    of_report = json.loads((report / "run.json").read_text(encoding="utf-8"))["status"]
    shown = {
        "console": watching.status(folder),
        "console's list": cards[folder.name]["status"],
        "console's page": watching.snapshot(folder)["status"],
        "record": read_status(folder).as_dict(),
        "runs": listed.status,
        "report": written.status.as_dict(),
        "run.json": of_report,
    }
    for name, one in shown.items():
        assert same(one) == same(status.as_dict()), name
    page = html.unescape((report / "index.html").read_text(encoding="utf-8"))
    junit = html.unescape((report / "junit.xml").read_text(encoding="utf-8"))
    in_ci = re.sub(r"\\(.)", r"\1", summary.of_run(written))
    assert f">{status.word}<" in page
    assert "trial not judged: bench" not in " ".join(page.split()), "they come yet"
    for where, text in {"page": page, "junit": junit, "summary": in_ci}.items():
        words = " ".join(text.split())
        assert status.trials in words, where
        assert all(" ".join(line.split()) in words for line in status.next), (where, status.next)
    assert status.headline in in_ci
    drop_report(folder)


def links_of(status: RunStatus) -> tuple[LinkState, ...]:
    return tuple(one.link for one in status.instruments)


def lost(status: RunStatus, name: str) -> bool:
    return next(one for one in status.instruments if one.name == name).trouble


@contextmanager
def seen_by_a_person(watch: Moment) -> Iterator[Events]:
    """As `seen`, and once the rig is open a person answers, in virtual time all the same."""
    with (
        seen(watch) as progress,
        patch.object(EmulatedOperator, "ask", lambda *asked: watch.takes_long(*asked)),
        patch.object(Rig, "by_person", property(lambda _: watch.is_open)),
    ):
        yield progress


def short(folder: Path, names: Sequence[str] = ("script",)) -> list[LoadedScript]:
    """A rig and scripts of two trials in ``folder``."""
    script = SCRIPT.replace(", {}]", "]")
    files(folder, stage=STAGE, check_point=CHECK_POINT, emulation=LIMITS, script=script)
    for name in names:
        (folder / f"{name}.toml").write_text(script, encoding="utf-8")
    return [load_script(folder / f"{name}.toml") for name in names]


def began(folder: Path, watch: Person, names: Sequence[str] = ("script",)) -> list[Path]:
    scripts, rig = short(folder, names), load_rig(folder / "rig.toml")
    how = RunOptions(typed=watch.typed)
    with (
        seen_by_a_person(watch)
        if isinstance(watch, Moment)
        else nullcontext(Events(watch)) as progress
    ):
        return [run for run, _ in run_queue(rig, scripts, folder / "runs", progress, how)]


@pytest.mark.parametrize("kind", ["touch", "set up"])
@pytest.mark.parametrize("instrument", INSTRUMENTS)
def test_an_instrument_that_comes_back_amid_a_prompt(
    instrument: str, kind: str, tmp_path: Path
) -> None:
    watch = Moment(instrument, "returning", "never", kind=kind)
    (run,) = began(tmp_path, watch)
    assert watch.rig
    assert read_status(run).state == "finished", read_status(run).why
    back_s = watch.dead_s + BACK_S[instrument] + LOOK_S
    assert back_s < watch.dead_s + SHORT_S, "before the answer"
    since = [one for at_s, one in watch.times if at_s >= back_s]
    assert since
    assert not any(one.trouble for status in since for one in status.instruments)


def test_a_prompt_of_half_an_hour(tmp_path: Path) -> None:
    watch = Moment("arm", "", "never", kind="touch", long_s=LONG_S, lost=False)
    began(tmp_path, watch)
    assert len(watch.compared) > 5
    waiting = [one for _, one in watch.times if one.asked and one.asked.waited_s > 60.0]
    assert len(waiting) > LONG_S * 0.9
    for status in waiting:
        assert status.asked
        minutes = int(status.asked.waited_s / 60.0)
        assert status.waiting == f"waiting for an answer at its terminal for {minutes} min: touch"
        assert f"; {status.waiting}; bath" in status.line
        assert status.next == ("Answer what is asked: touch.",)
        bath = next(one for one in status.instruments if one.name == "bath")
        assert bath.age_s is not None
        assert bath.age_s <= 2 * PERIOD_S


@pytest.mark.parametrize(
    ("instrument", "second"),
    [("arm", "stage"), ("stage", "arm"), ("arm", "bath"), ("stage", "bath"), ("cameras", "bath")],
)
def test_a_second_instrument_is_lost_while_the_first_is_opened_again(
    instrument: str, second: str, tmp_path: Path
) -> None:
    watch = Moment(instrument, "killed", "running", second=second)
    (run,) = began(tmp_path, watch)
    paused = [one for one in watch.samples if one.step == "paused"]
    both = [one for one in paused if lost(one, instrument) and lost(one, second)]
    assert bool(both) == (second == "bath"), "of the others it is known once they are asked"
    for status in both:
        first, then = status.next
        assert first.startswith("Check the bath's power and its cable.")
        assert instrument.removesuffix("s") in then
    status = read_status(run)
    assert status.state == ("tripped" if second == "bath" else "faulted")
    compare_the_surfaces(run, status, watch)


@pytest.mark.parametrize("instrument", INSTRUMENTS)
def test_an_instrument_is_lost_as_a_resumed_run_is_set_up(instrument: str, tmp_path: Path) -> None:
    stopped = Person("place-2", ["abort"])
    (run,) = began(tmp_path, stopped)
    assert read_status(run).state == "aborted"
    watch = Moment(instrument, "killed", "preparing")
    with seen_by_a_person(watch) as progress:
        resume_run(run, progress, RunOptions(typed=watch.typed))
    status = read_status(run)
    assert watch.compared
    assert status.state == ("tripped" if instrument == "bath" else "faulted")
    compare_the_surfaces(run, status, watch)
    said = [(one["kind"], one["text"]) for one in read_events(run) if one["what"] == "event"]
    assert said == [(one["kind"], one["text"]) for one in read_run(run).events]


def test_between_the_last_trial_and_the_report_and_between_two_scripts(tmp_path: Path) -> None:
    """The first run has ended, its report isn't written, and the bath stays warm for the second."""
    moments, own = [], run_start._begun

    def begun(*arguments: Any) -> Store:
        runs = sorted((tmp_path / "runs").iterdir()) if (tmp_path / "runs").is_dir() else []
        if folders := [one for one in runs if one.is_dir()]:
            (first,) = folders
            status, (queue,) = read_status(first), queues(first.parent)
            (listed,), (card,) = list_runs(first.parent).runs, watching.listed(first.parent)
            for shown in (card["status"], listed.status, queue.as_dict()["scripts"][0]["status"]):
                assert json.loads(json.dumps(shown)) == json.loads(json.dumps(status.as_dict()))
            page = html.unescape(write_queue_page(first.parent)[1].read_text(encoding="utf-8"))
            page = " ".join(page.split())
            assert queue.under_way
            assert queue.headline in page
            assert "✓ met" in page
            assert not (first / "report").exists()
            moments.append((first, status, queue))
        return own(*arguments)

    with patch.object(run_start, "_begun", begun):
        first, _ = began(tmp_path, Person("", ()), ("one", "two"))
    ((folder, status, queue),) = moments
    assert folder == first
    assert queue.headline == "script 1 of 2 has ended, next: two"
    of_bath = next(one for one in status.at_end if one.name == "bath")
    assert of_bath.safe is Safe.IN_USE, "it stays warm"
    written = write_run_report(first)
    assert written.status == status
