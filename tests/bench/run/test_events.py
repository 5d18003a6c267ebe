"""The state table, walked for every pair, and the page that draws it; and listeners of the events,
which may fail in any way: the run goes on, the others still get all, and it is named once.
"""

from __future__ import annotations

import json
import re
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from bench.record.reader import read_run
from bench.record.state import State
from bench.results.status import InstrumentStatus, LinkState, RunStatus, Safe, read_status
from bench.rig.reconnecting import GARBLED, GONE, POLICIES, REFUSES
from bench.run import trial as run_trial
from bench.run.events import (
    AWAY,
    BACK,
    EVENT,
    EVENTS_FILE,
    TABLE,
    Events,
    RunState,
    RunStates,
    SafeProgress,
    event_lines,
    read_events,
)
from tests.bench.commands import teatbench
from tests.bench.forked import begin
from tests.bench.killed_runs import Person, Silent, killed_while, only_run, resume, start
from tests.bench.operated_runs import files, run_of, texts
from tests.conftest import ROOT

PAGE = ROOT / "docs" / "runs.md"
S = RunState
# Typed from issue and design, not from the table: what may follow what.
MAY_FOLLOW = {
    "planned": "preparing safing aborted faulted",
    "preparing": "settling running paused safing",
    "settling": "running paused safing",
    "running": "settling paused safing",
    "paused": "preparing settling running safing",
    "safing": "finished aborted faulted tripped",
    "finished": "",
    "aborted": "",
    **dict.fromkeys(("faulted", "tripped"), ""),
}


def in_state(state: RunState) -> tuple[RunStates, list[RunState]]:
    note: list[RunState] = []
    states = RunStates(note.append, lambda: 0.0)
    states.current = state
    return states, note


def test_every_pair() -> None:
    """Staying is no change."""
    for before, after in product(RunState, RunState):
        states, note = in_state(before)
        if after is before:
            states.to(after)
            assert (states.current, note) == (before, [])
        elif after.value in MAY_FOLLOW[before.value].split():
            states.to(after)
            assert (states.current, note) == (after, [after])
        else:
            with pytest.raises(ValueError, match=f"a run that is {before} can't be {after} next"):
                states.to(after)
            assert (states.current, note) == (before, [])


def test_time_away_is_counted_and_only_that() -> None:
    clock = iter([0.0, 10.0, 25.0, 31.0, 40.0, 47.0, 100.0])
    states = RunStates(lambda _: None, lambda: next(clock))
    states.to(S.PREPARING)  # at 10 s
    states.to(S.SETTLING)  # at 25 s
    assert states.away_s == 6.0  # looked at 31 s
    assert {S.PAUSED, S.SETTLING} == AWAY


def test_a_pause_goes_back_to_where_it_was_and_stays_where_it_is_given_up() -> None:
    states, note = in_state(S.RUNNING)
    with states.during(S.PAUSED):
        assert states.current is S.PAUSED
    assert note == [S.PAUSED, S.RUNNING]
    with pytest.raises(OSError, match="gone"), states.during(S.PAUSED):
        raise OSError("gone")
    assert states.current is S.PAUSED


def test_the_page_lists_the_table_as_it_is() -> None:
    page = PAGE.read_text(encoding="utf-8")
    after = {state: [to for to in RunState if to in TABLE[state]] for state in RunState}
    listed = re.findall(r"^\| (\w+) \| [^|]+ \| ([^|]+) \|$", page, re.MULTILINE)
    assert [(str(state), ", ".join(after[state]) or "-") for state in RunState] == listed[1:]


def test_the_page_lists_what_is_tried_again() -> None:
    means = {
        GONE: "doesn't answer, link broken",
        GARBLED: "answers nonsense",
        REFUSES: "says no, or gives nothing usable",
    }
    who = list(dict.fromkeys(who for who, _ in POLICIES))
    times = {key: str(policy.times) for key, policy in POLICIES.items()}
    rows = [["tries in a trial", *who]]
    rows += [[text, *(times.get((one, kind), "-") for one in who)] for kind, text in means.items()]
    head, *lines = (f"| {' | '.join(row)} |" for row in rows)
    assert "\n".join([head, "|" + "---|" * 5, *lines]) in PAGE.read_text(encoding="utf-8")


class Gone(Silent):
    """A screen that fails at everything from its ``after``-th word on, as rich does where the
    reader of its output has gone.
    """

    def __init__(self, error: BaseException, after: int = 0) -> None:
        super().__init__()
        self._error, self._left = error, after
        self.tried = 0

    def state(self, text: str) -> None:
        self._word()

    def trial(self, done: int, total: int, name: str) -> None:
        self._word()

    def warn(self, text: str) -> None:
        self._word()
        super().warn(text)

    @contextmanager
    def aside(self) -> Iterator[None]:  # type: ignore[override]
        self._word()
        yield
        self._word()

    def _word(self) -> None:
        self.tried += 1
        if self.tried > self._left:
            raise self._error


@pytest.mark.slow
def test_a_screen_that_fails_ends_neither_the_run_nor_the_lines(tmp_path: Path) -> None:
    files(tmp_path)
    error = SystemExit(1)
    path = tmp_path / "events.jsonl"
    with event_lines(path) as lines:
        screen = Gone(error, after=3)
        assert start(tmp_path, progress=Events(screen, lines))[1] is RunState.FINISHED
    assert screen.tried == 4, "once it has failed it is left alone"
    note = list(map(json.loads, path.read_bytes().splitlines()))
    trials = [line["name"] for line in note if line["what"] == "trial"]
    assert trials == ["place-1", "place-2", "place-3", ""]
    why = [f"the screen shows nothing any more: {type(error).__name__}: {error}"]
    assert [line["text"] for line in note if line["what"] == "warning"] == why
    assert texts(run_of(tmp_path), "not shown") == why


def test_the_line_has_trial_state_bath_time_left_and_the_last_error() -> None:
    screen = Person("", ())
    shown, progress = screen.states, Events(screen)
    progress.state("preparing")
    bath = InstrumentStatus("bath", LinkState.ANSWERS, Safe.IN_USE, last="33.02 degC, stable")

    def status() -> RunStatus:
        words: dict[str, Any] = {
            "doing": progress.doing,
            "pose": progress.pose,
            "last_error": progress.error,
        }
        now = RunStatus("run", "Short", State.RUNNING, "running", instruments=(bath,), left_s=720.0)
        return replace(now, **words)

    progress.status = status
    progress.trial(1, 3, "place-2")
    progress.event("state", "no error")
    progress.state("capturing")
    progress.event("camera", "left: late. " * 20)
    progress.state("capturing")
    assert shown[:2] == [
        "preparing",
        "place-2; capturing; bath 33.02 degC, stable; about 12 min left",
    ]
    assert shown[2] == f"{shown[1]}; last error: {'left: late. ' * 4}left: …"
    progress.event(BACK, "the cameras are back after 2.0 s")
    progress.state("capturing")
    assert shown[3] == shown[1]


@pytest.mark.slow
def test_the_line_follows_the_bath_while_one_thing_takes_long(tmp_path: Path) -> None:
    files(tmp_path, emulation="prompt_s = 10.0")
    screen = Person("", ())
    assert start(tmp_path, progress=Events(screen))[1] is RunState.FINISHED
    touching = [text for text in screen.states if text.startswith("place-2; taking the truth")]
    assert len(touching) >= 40, "four touches of ten seconds, a look at the bath each second"
    assert len(set(touching)) > 1


def test_a_line_that_cannot_be_made_is_no_trouble_of_the_baths() -> None:
    """It is made on the watch's own thread."""

    def fails() -> None:
        raise RuntimeError("a bug in the line")

    progress = Events(Silent())
    progress.status = fails
    progress.refresh()
    with pytest.raises(RuntimeError, match="a bug in the line"):
        progress.state("capturing")


def test_what_a_person_has_to_see_is_tried_again_all_the_same() -> None:
    note, error = list[str](), SystemExit(1)
    screen = Gone(error)
    shown = SafeProgress(screen, note.append)
    shown.state("moving")
    shown.state("capturing")
    shown.warn("NOT SAFE")
    with shown.aside():
        pass
    screen.__init__(OSError(), after=9)  # type: ignore[misc]
    shown.warn("NOT SAFE: bath")
    assert screen.warned == ["NOT SAFE: bath"]
    assert note == [f"the screen shows nothing any more: {type(error).__name__}: {error}"]


def test_what_is_asked_amid_a_question_is_not_swallowed() -> None:
    with pytest.raises(KeyboardInterrupt), SafeProgress(Silent()).aside():
        raise KeyboardInterrupt


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="closes a pipe as a POSIX shell does")
def test_a_reader_of_the_output_that_has_gone_ends_no_run(tmp_path: Path) -> None:
    """`teatbench run | head -1`."""
    with begin(files(tmp_path), stderr=subprocess.PIPE) as bench:
        assert bench.stdout is not None
        assert bench.stderr is not None
        assert bench.stdout.readline().startswith("3 trials, ")
        bench.stdout.close()
        complaints = bench.stderr.read()
        assert bench.wait() == 0, complaints
    assert complaints == ""
    run = run_of(tmp_path)
    assert (run.ending, len(run.trials)) == ("finished", 3)
    assert (run.folder / "report" / "index.html").is_file()
    assert (run.folder / "times.json").is_file(), "what comes after the table is done too"


@pytest.mark.slow
def test_a_trip_is_among_the_lines(tmp_path: Path) -> None:
    """On the watch's own thread; who reads the lines has to hear of it all the same."""
    low = '[[emulation.faults]]\ninstrument = "bath"\nname = "low level"\nat_s = 3.0'
    files(tmp_path, emulation=low)
    path = tmp_path / "events.jsonl"
    with event_lines(path) as lines:
        assert start(tmp_path, progress=Events(Silent(), lines))[1] is RunState.FAULTED
    note = [*map(json.loads, path.read_bytes().splitlines())]
    assert {line["what"] for line in note} >= {"doing", "asked", "event"}
    assert any("bath" in line for line in note if line["what"] == "doing")
    (trip,) = [line["text"] for line in note if line.get("kind") == "trip"]
    assert trip.startswith("interlock controller alarm")
    record = run_of(tmp_path)
    assert trip in [event["text"] for event in record.events]
    for of in (note, record.events):  # the word of all surfaces, here too
        word = {one["kind"]: one["text"] for one in of if one.get("kind") in ("end", EVENT)}
        assert word == dict.fromkeys(("end", EVENT), read_status(record.folder).state)
    doing = [line["text"] for line in note if line["what"] == "doing"]
    assert doing[-1] == "all instruments are safe"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="kills a process as POSIX does")
def test_the_run_keeps_its_events_and_a_killed_one_goes_on_with_their_numbers(
    tmp_path: Path,
) -> None:
    files(tmp_path)
    assert killed_while("'002-place-2-1'", "write_trial", run_trial, lambda: start(tmp_path))
    run = only_run(tmp_path, "runs")
    before = list(read_events(run))
    assert [line["number"] for line in before] == list(range(1, len(before) + 1))
    with (run / EVENTS_FILE).open("ab") as torn:
        torn.write(b'{"number": 999, "what": "do')  # of a machine that lost its power
    assert resume(tmp_path, "runs")[1] is RunState.FINISHED
    lines = list(read_events(run))
    assert lines[: len(before)] == before
    assert [line["number"] for line in lines] == list(range(1, len(lines) + 1))
    names = [line["name"] for line in lines if line["what"] == "trial"]
    assert names == ["place-1", "place-2", "place-2", "place-3", ""], (
        "what is gone through again is not said again"
    )
    record = [event["text"] for event in read_run(run).events]
    assert [line["text"] for line in lines if line["what"] == "event"] == record
    assert teatbench("store check {}", run) == 0, "it is no part of the checked record"


def test_a_file_of_events_of_a_killed_bench_goes_on_with_whole_lines(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    path.write_bytes(b'{"number": 7, "what": "doing"}\n{"number": 8, "wh')
    with event_lines(path) as lines:
        Events(Silent(), lines).state("capturing")
    assert [json.loads(line)["what"] for line in path.read_text().splitlines()] == ["doing"] * 2


def test_events_are_put_in_behind_damaged_lines_and_a_record_that_fails_ends_nothing(
    tmp_path: Path,
) -> None:
    last = {"number": 7, "what": "event", "kind": "arm", "text": "checked"}
    before = b"no JSON\n[]\n" + json.dumps(last).encode() + b"\n"
    (tmp_path / EVENTS_FILE).write_bytes(before)
    rows = [
        {"kind": kind, "text": "checked", "t_s": 1.5, "wall_time": "2026-06-01T12:00:00"}
        for kind in ("stage", "arm", "arm", "end")
    ]
    with Events(Silent()).kept_in(tmp_path, lambda: rows):
        pass
    added = (tmp_path / EVENTS_FILE).read_bytes().removeprefix(before).splitlines()
    said = [(line["number"], line["what"], line.get("kind")) for line in map(json.loads, added)]
    assert said == [(8, "warning", None), (9, "event", "arm"), (10, "event", "end")]
    screen = Silent()

    def gone() -> list[dict[str, Any]]:
        raise sqlite3.DatabaseError("file is not a database")

    with Events(screen).kept_in(tmp_path, gone):
        pass
    assert screen.warned == [f"{EVENTS_FILE}: no further lines: file is not a database."]


def test_a_folder_that_takes_no_events_is_named_once_and_ends_no_run(tmp_path: Path) -> None:
    files(tmp_path)
    screen, run = Silent(), tmp_path / "run"
    run.mkdir()
    (run / EVENTS_FILE).mkdir()
    events = Events(screen)
    with events.kept_in(run):
        events.state("capturing")
    assert [text.split(": ")[0] for text in screen.warned] == [EVENTS_FILE]
