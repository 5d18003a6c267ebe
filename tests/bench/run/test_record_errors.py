"""Disk full, folder read-only, clock set, a watcher that fails: the bench goes to safe or goes on,
and nothing finished is lost.
"""

from __future__ import annotations

import errno
import re
import shutil
import sqlite3
import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from io import FileIO
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from bench.config import ConfigError
from bench.record.check import check_record
from bench.record.reader import read_run
from bench.record.schema import DATABASE
from bench.record.state import RESERVE
from bench.record.writer import FolderGoneError, Store
from bench.results.status import read_status
from bench.run.events import EVENTS_FILE, Events, RunState, event_lines, read_events
from instruments.clock import stopwatch_s
from instruments.operators.emulated import EmulatedOperator
from instruments.operators.operator import Arrangement
from tests.bench.commands import Said
from tests.bench.killed_runs import Silent, only_run, resume, start
from tests.bench.operated_runs import files, texts
from tests.examples import few

FULL = [
    OSError(errno.ENOSPC, "No space left on device"),
    sqlite3.OperationalError("database or disk is full"),
]


class FullDisk:
    """The store's ``method`` raises ``error`` from the second trial's frames on: once, or ever."""

    def __init__(self, method: str, error: Exception, *, for_good: bool) -> None:
        self._method, self._error, self._for_good = method, error, for_good
        self._trials, self._struck = 0, False

    def put_into(self, patch: pytest.MonkeyPatch) -> None:
        frames, own = Store.frames, getattr(Store, self._method)

        def counted(*arguments: Any, **more: Any) -> Any:
            self._trials += 1
            return (failing if self._method == "frames" else frames)(*arguments, **more)

        def failing(*arguments: Any, **more: Any) -> Any:
            if self._trials >= 2 and (self._for_good or not self._struck):
                self._struck = True
                raise self._error
            return own(*arguments, **more)

        patch.setattr(Store, self._method, failing)
        patch.setattr(Store, "frames", counted)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "for_good"),
    few([(FULL[1], True), (FULL[0], False), (FULL[1], False)], 3),
    ids=["database, for good", "frames, once", "bath's row, once"],
)
def test_a_full_disk_ends_safely_and_the_run_goes_on_where_there_is_room_again(
    error: Exception, for_good: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files(tmp_path)
    method = "frames" if isinstance(error, OSError) else "_write" if for_good else "bath"
    fails = FullDisk(method, error, for_good=for_good)
    progress = Silent()
    with monkeypatch.context() as patch:
        fails.put_into(patch)
        assert start(tmp_path, progress=progress)[1] is RunState.FAULTED
    run = read_run(only_run(tmp_path, "runs"))
    assert run.ending == "faulted"
    kept = [trial.id for trial in run.trials]
    note = [text for text in progress.warned if "the record could not be written" in text]
    assert any("teatbench resume" in text for text in note)
    status = read_status(run.folder)
    assert status.headline.startswith("faulted")
    why = "trials: the record could not be written: the disk is full."
    assert status.why.endswith(f"{why} All instruments are safe.")
    assert status.next[-1].startswith(f"Make room in {run.folder}, then resume: teatbench res")
    assert (run.folder / RESERVE).exists() == for_good, "its end is there, for want of room"
    said = [(event["session"], event["kind"], event["text"]) for event in run.events]
    reason = "the record could not be written: the disk is full"
    assert said.count((1, "fault", reason)) == 1
    assert said[-1] == (1, "end", "faulted")
    assert resume(tmp_path, "runs")[1] is RunState.FINISHED
    whole = read_run(only_run(tmp_path, "runs"))
    of_both = [(event["session"], event["kind"], event["text"]) for event in whole.events]
    assert of_both[: len(said)] == said, "what there was no room for is in the record, once"
    assert {session for session, *_ in of_both[len(said) :]} == {2}
    assert check_record(run.folder).whole
    assert [trial.id for trial in whole.trials][: len(kept)] == kept
    assert len(whole.trials) == 3
    assert not (run.folder / RESERVE).exists()


def replaced(run: Path) -> None:
    shutil.copytree(run.rename(run.with_name("elsewhere")), run)


def another_database(run: Path) -> None:
    (run / DATABASE).rename(run / "old.sqlite")
    shutil.copy(run / "old.sqlite", run / DATABASE)


ASK = EmulatedOperator.ask


class Tampering(Silent):
    """``what`` is done with the run's folder as its second trial begins, or in its capture."""

    def __init__(self, what: Callable[[Path], object], folder: Path, at: str) -> None:
        super().__init__()
        self._what, self._folder, self._at, self._second = what, folder, at, False

    def trial(self, done: int, total: int, name: str) -> None:
        self._second = self._second or done == 1
        self._now("trial")

    def state(self, text: str) -> None:
        self._now(text)

    def _now(self, text: str) -> None:
        if self._second and self._at and self._at in text:
            self._at = ""
            self._what(only_run(self._folder, "runs"))


@pytest.mark.slow
@pytest.mark.skipif(
    sys.platform == "win32", reason="Windows neither deletes nor moves what is open"
)
@pytest.mark.parametrize(
    ("what", "at", "touched"),
    [
        (shutil.rmtree, "capturing", 2),
        (replaced, "capturing", 2),
        (another_database, "trial", 1),
    ],
)
def test_a_folder_that_is_gone_is_noticed_in_the_trial_in_which_it_went(
    what: Callable[[Path], object], at: str, touched: int, tmp_path: Path
) -> None:
    """Not at the end: SQLite goes on writing into a file that has no name any more."""
    files(tmp_path)
    progress, why = (
        Tampering(what, tmp_path, at),
        "was deleted, moved or replaced: .* teatbench resume",
    )
    with (
        patch.object(EmulatedOperator, "ask", autospec=True, side_effect=ASK) as ask,
        pytest.raises(FolderGoneError, match=why),
    ):
        start(tmp_path, progress=progress)
    asked = [call for call in ask.call_args_list if isinstance(call.args[1], Arrangement)]
    assert len(asked) == touched, "nobody sets up a trial that can't be kept"
    if what is shutil.rmtree:
        assert not list((tmp_path / "runs").glob("*/frames")), "the folder isn't made anew"


@pytest.mark.slow
def test_a_folder_that_is_gone_is_reported_by_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    own = Store.frames

    def gone(store: Store, *given: Any, **more: Any) -> Any:
        store._place = ()  # as if it were another one
        return own(store, *given, **more)

    monkeypatch.setattr(Store, "frames", gone)
    note = said(3, "{}", files(tmp_path)).err
    assert "was deleted, moved or replaced" in note
    assert "disk full" not in note
    run = read_run(only_run(tmp_path, "runs"))
    assert run.ending == "faulted"
    assert any(event["kind"] == "safe" or "standby" in event["text"] for event in run.events)


def test_a_folder_that_may_not_be_written_is_reported_before_anything_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    def refused(*_: Any, **__: Any) -> Any:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Store, "create", refused)
    assert "a run can't be kept in" in said(2, "{}", files(tmp_path)).err


@pytest.mark.slow
@pytest.mark.parametrize("by_s", few([-3600.0, 86400.0], 2))
def test_a_clock_that_is_set_amid_a_run_is_noted_and_changes_nothing_else(
    by_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files(tmp_path)
    looks = count(1)

    def stepping() -> datetime:
        return datetime.now(UTC) + (next(looks) > 12) * timedelta(seconds=by_s)

    monkeypatch.setattr("bench.run.context.wall_time", stepping)
    folder, ending = start(tmp_path)
    run = read_run(folder)
    assert (ending, len(run.trials)) == (RunState.FINISHED, 3)
    (note,) = texts(run, "clock")
    assert note.startswith(f"the computer's clock was set {by_s:+.0f} s")
    times = [event["t_s"] for event in run.events if event["t_s"] is not None]
    assert times == sorted(times), "the bench's own time goes on"


@pytest.mark.slow
def test_a_busy_computer_is_no_clock_that_is_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody else may run for seconds between two looks at two clocks."""
    files(tmp_path)
    asleep_s, looks = 0.0, 0

    def late() -> datetime:
        nonlocal asleep_s, looks
        looks += 1
        note = datetime.now(UTC) + timedelta(seconds=asleep_s)
        asleep_s += 20.0 if looks == 11 else 0.0  # the first of an event: its look at both clocks
        return note

    monkeypatch.setattr("bench.run.context.wall_time", late)
    monkeypatch.setattr("bench.run.context.stopwatch_s", lambda: stopwatch_s() + asleep_s)
    run = read_run(start(tmp_path)[0])
    assert looks > 12
    assert texts(run, "clock") == []


def test_a_file_for_lines_that_fails_ends_nothing_and_has_no_half_line(tmp_path: Path) -> None:
    class Full(FileIO):
        def write(self, data: Any) -> int:
            return super().write(bytes(data)[:40])  # what still had room

    with FileIO(tmp_path / "e", "a") as closed:
        pass
    (tmp_path / EVENTS_FILE).write_bytes(b'{"number": 7}\n')
    events = Events(shown := Silent(), closed)
    with patch("bench.run.events.FileIO", Full), events.kept_in(tmp_path):
        for text in ("preparing", "capturing"):
            events.state(text)
    told = [f"{name}: no further lines" for name in ("--events", EVENTS_FILE)]
    assert [": ".join(said.split(": ")[:2]) for said in shown.warned] == told, "each once"
    assert [line["number"] for line in read_events(tmp_path)] == [7]


@pytest.mark.slow
@pytest.mark.parametrize("for_good", [True, False])
def test_events_that_a_full_disk_did_not_take_are_in_their_file_in_the_end(
    for_good: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the record, which may have them by the reserve alone; lost lines are said to be so."""
    files(tmp_path)

    class Refusing(FileIO):
        full = False

        def write(self, data: Any) -> int:
            if Refusing.full or b'"trial", "done": 1' in bytes(data):
                Refusing.full = for_good
                raise OSError(errno.ENOSPC, "No space left on device")
            return super().write(data)

    with monkeypatch.context() as patch:
        patch.setattr("bench.run.events.FileIO", Refusing)
        if for_good:  # the record's database has no room either
            FullDisk("_write", FULL[1], for_good=True).put_into(patch)
        ending = RunState.FAULTED if for_good else RunState.FINISHED
        assert start(tmp_path)[1] is ending
    before = list(read_events(only_run(tmp_path, "runs")))
    if for_good:
        assert resume(tmp_path, "runs")[1] is RunState.FINISHED
    run = read_run(only_run(tmp_path, "runs"))
    lines = list(read_events(run.folder))
    numbers = [line["number"] for line in lines]
    assert numbers == sorted(set(numbers))
    said = [(line["kind"], line["text"]) for line in lines if line["what"] == "event"]
    assert said == [(event["kind"], event["text"]) for event in run.events]
    (at,) = [i for i, line in enumerate(lines) if "are missing here" in line.get("text", "")]
    told = re.match(r"Lines since (\S+) are missing here\. .* (\d+) follow\.", lines[at]["text"])
    assert told
    follow = lines[at + 1 : at + 1 + int(told[2])]
    assert told[1] == follow[0]["wall_time"]
    kinds = [line["kind"] for line in follow]
    assert (kinds[0], kinds[-1]) == ("not shown", "end")
    assert not for_good or (lines[: len(before)] == before and "fault" in kinds)


def test_a_file_for_lines_that_cannot_be_opened_is_wrong_use(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="it can't be opened"), event_lines(tmp_path / "no" / "e"):
        pass
