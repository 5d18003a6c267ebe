"""What somebody wants of a run under way, by a file or typed: pause, go on, skip, repeat, abort."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from bench.cli.run import typed_lines
from bench.config import ConfigError
from bench.record.reader import RunRecord
from bench.rig.loading import load_rig
from bench.run.requests import FILE, Requests, leave_wish, read_wish, was_taken
from bench.run.start import RunOptions, run_script
from bench.run.states import EVENT
from bench.script.model import load_script
from instruments.clock import VirtualClock
from instruments.operators.operator import OperatorAbort, OperatorRepeat, OperatorSkip
from tests.bench.calibrate.arm_terminal import at_terminal
from tests.bench.commands import Said
from tests.bench.killed_runs import Silent, only_run
from tests.bench.operated_runs import files, run_of, texts


class Person(Silent):
    """Types ``lines`` one by one, the first once trial ``at`` is next, another at each look after
    it.
    """

    def __init__(self, at: str, lines: list[str]) -> None:
        super().__init__()
        self._at, self._lines, self._there = at, lines, False
        self.states: list[str] = []

    def state(self, text: str) -> None:
        self.states.append(text)

    def trial(self, done: int, total: int, name: str) -> None:
        self._there = self._there or name == self._at

    def typed(self) -> str | None:
        return self._lines.pop(0) if self._there and self._lines else None


def run_with(person: Person, folder: Path) -> RunRecord:
    files(folder, emulation="prompt_s = 5.0")
    rig, script = load_rig(folder / "rig.toml"), load_script(folder / "script.toml")
    run_script(rig, script, folder / "runs", person, RunOptions(typed=person.typed))
    return run_of(folder)


@pytest.mark.slow
def test_a_pause_lasts_until_somebody_says_to_go_on(tmp_path: Path) -> None:
    person = Person("place-2", ["p", *[""] * 30, "go on"])
    run = run_with(person, tmp_path)
    assert (run.ending, len(run.trials)) == ("finished", 3)
    states = [(event["text"], event["t_s"]) for event in run.events if event["kind"] == EVENT]
    (at,) = [index for index, (name, _) in enumerate(states) if name == "paused"]
    assert states[at + 1][0] == "running"
    assert states[at + 1][1] - states[at][1] >= 14.0, "the bath is watched for as long as it takes"
    assert any("teatbench control" in text for text in person.warned)


@pytest.mark.slow
def test_while_it_is_paused_the_line_says_so_and_a_trial_that_is_not_there_cannot_be_skipped(
    tmp_path: Path,
) -> None:
    person = Person("place-2", ["p", "", "skip it leaks", "repeat it moved", "", "g"])
    run = run_with(person, tmp_path)
    assert (run.ending, len(run.trials), len(run.skipped)) == ("finished", 3, 0)
    assert any("paused, as asked" in text for text in person.states)
    assert person.warned[0] == "The run pauses before its next trial."
    none = "No trial is in flight just now"
    assert [text for text in person.warned if text.startswith(none)] == [
        f"{none}, so nothing is done about: skip it leaks",
        f"{none}, so nothing is done about: repeat it moved",
    ]


@pytest.mark.slow
def test_a_trial_is_repeated_whole_and_another_skipped_each_with_its_reason(tmp_path: Path) -> None:
    lines = ["", "repeat the plate was touched", *[""] * 5, "skip it leaks"]
    run = run_with(Person("place-2", lines), tmp_path)
    assert run.ending == "finished"
    again = "the operator asked for it again from its set-up: the plate was touched"
    assert texts(run, "repeated")[-1].endswith(again)
    assert [row["reason"] for row in run.skipped] == ["it leaks"]
    assert len(run.trials) == 2


def test_an_abort_is_heard_before_the_first_trial_too(tmp_path: Path) -> None:
    class Impatient(Person):
        def typed(self) -> str | None:
            return self._lines.pop(0) if self._lines else None

    run = run_with(Impatient("", ["", "", "abort"]), tmp_path)
    assert (run.ending, len(run.trials)) == ("aborted", 0)
    assert texts(run, EVENT) == ["preparing", "safing", "aborted"]


@pytest.mark.slow
def test_an_abort_goes_to_safe(tmp_path: Path) -> None:
    run = run_with(Person("place-2", ["abort"]), tmp_path)
    assert run.ending == "aborted"
    assert "bath is safe" in texts(run, "safe")


def test_a_wish_left_in_the_folder_is_taken_once(tmp_path: Path) -> None:
    wishes = Requests(tmp_path, lambda: None, lambda _: None)
    states = []
    for words in ("p", "go on"):
        leave_wish(tmp_path, words)
        wishes.look()
        states.append(wishes.paused)
        assert not (tmp_path / FILE).exists()
    assert states == [True, False]
    for words, raised in (
        ("skip a b", OperatorSkip),
        ("r because", OperatorRepeat),
        ("abort", OperatorAbort),
    ):
        leave_wish(tmp_path, words)
        with pytest.raises(raised):
            wishes.look()
        wishes.look()


def test_what_was_left_for_a_bench_that_died_counts_no_more(tmp_path: Path) -> None:
    told: list[str] = []
    leave_wish(tmp_path, "abort")
    wishes = Requests(tmp_path, lambda: None, told.append)
    wishes.forget()
    wishes.look()
    assert told == ["Nobody took this in the last session, and it counts no more: abort"]
    wishes.forget()
    assert len(told) == 1


def test_words() -> None:
    meant = [("pause", ""), ("go on", ""), ("skip", "a b"), ("abort", "")]
    assert [read_wish(words) for words in ("P", "go", "s  a  b", "a")] == meant


@pytest.mark.slow
def test_words_that_mean_nothing_are_told_and_change_nothing(tmp_path: Path, said: Said) -> None:
    told: list[str] = []
    lines = ["hallo", "skip"]
    wishes = Requests(tmp_path, lambda: lines.pop(0), told.append)
    wishes.look()
    wishes.look()
    assert told[0].startswith("not understood: 'hallo'. There are: pause, go on")
    assert told[1].startswith("skip needs a reason")
    with pytest.raises(ConfigError, match="repeat needs a reason"):
        leave_wish(tmp_path, "repeat")
    ended = run_with(Person("", []), tmp_path).folder
    assert "has ended (finished)" in said(2, "tell {} pause", ended).out


TERMINAL = pytest.mark.skipif(
    sys.platform == "win32", reason="needs a pseudo-terminal, which Windows has not"
)


@pytest.mark.slow
@TERMINAL
def test_a_run_that_waits_at_a_prompt_hears_what_another_terminal_says(
    tmp_path: Path, said: Said
) -> None:
    with at_terminal(files(tmp_path, operator="console:")) as terminal:
        terminal.expect("on its peg")
        terminal.expect("abort the run): ")
        terminal.type("")
        terminal.expect("[trial 1 of 3")
        terminal.expect("abort the run): ")
        run = only_run(tmp_path, "runs")
        assert "request accepted" in said(0, "control {} skip the hose leaks", run).out
        terminal.expect("As told: skip the hose leaks")
        terminal.expect("[trial 2 of 3")
        terminal.expect("abort the run): ")
        said(0, "tell {} abort", run)
        assert terminal.code() == 3
    record = run_of(tmp_path)
    assert record.ending == "aborted"
    assert [row["reason"] for row in record.skipped] == ["the hose leaks"]


@TERMINAL
def test_a_bench_in_the_background_reads_nothing_of_what_is_typed_to_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The system stops whoever does, and a bench that stands still is taken for dead."""
    import pty

    person, terminal = pty.openpty()
    with (
        os.fdopen(terminal, encoding="utf-8") as stream,
        os.fdopen(person, "wb", buffering=0) as keys,
    ):
        monkeypatch.setattr("sys.stdin", stream)
        typed = typed_lines("emulator:")
        keys.write(b"abort\n")
        monkeypatch.setattr("os.tcgetpgrp", lambda _: os.getpgrp() + 1)
        assert typed() is None
        monkeypatch.setattr("os.tcgetpgrp", lambda _: os.getpgrp())
        assert typed() == "abort\n"


def test_who_tells_a_bench_that_has_died_is_told_that_nobody_took_it(tmp_path: Path) -> None:
    leave_wish(tmp_path, "pause")
    clock = VirtualClock()
    assert not was_taken(tmp_path, clock, 10.0)
    assert clock.now() == pytest.approx(10.0, abs=0.2)
    Requests(tmp_path, lambda: None, lambda _: None).look()
    assert was_taken(tmp_path, clock, 10.0)
