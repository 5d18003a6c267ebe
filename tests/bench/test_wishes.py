"""What somebody wants of a run under way, by a file or typed: pause, go on, skip, repeat, abort."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.cli import main
from bench.config import ConfigError
from bench.jobs import run_script
from bench.record import RunRecord, read_run
from bench.rig import load_rig
from bench.running.run_state import EVENT
from bench.running.wishes import FILE, Wishes, leave_wish, read_wish
from bench.script import load_script
from instruments.operators.operator import OperatorAbort, OperatorRepeat, OperatorSkip
from tests.bench.killed_runs import Silent
from tests.bench.operated_runs import files


class Person(Silent):
    """Types ``lines`` one by one, the first once trial ``at`` is next, another at each look after it."""

    def __init__(self, at: str, lines: list[str]) -> None:
        super().__init__()
        self._at, self._lines, self._there = at, lines, False

    def trial(self, done: int, total: int, name: str) -> None:
        self._there = self._there or name == self._at

    def typed(self) -> str | None:
        return self._lines.pop(0) if self._there and self._lines else None


def run_with(person: Person, folder: Path) -> RunRecord:
    files(folder, emulation="prompt_s = 5.0")
    rig = load_rig(folder / "rig.toml")
    out, _ = run_script(rig, load_script(folder / "script.toml"), folder / "runs", person, typed=person.typed)
    return read_run(out)


def test_a_pause_lasts_until_somebody_says_to_go_on(tmp_path: Path) -> None:
    person = Person("place-2", ["p", *[""] * 30, "go on"])
    run = run_with(person, tmp_path)
    assert (run.ending, len(run.trials)) == ("finished", 3)
    states = [(event["text"], event["t_s"]) for event in run.events if event["kind"] == EVENT]
    (at,) = [index for index, (name, _) in enumerate(states) if name == "paused"]
    assert states[at + 1][0] == "running"
    assert states[at + 1][1] - states[at][1] >= 14.0, "the bath is watched for as long as it takes"
    assert any("teatbench tell" in text for text in person.warned)


def test_a_trial_is_repeated_whole_and_another_skipped_each_with_its_reason(tmp_path: Path) -> None:
    run = run_with(Person("place-2", ["", "repeat the plate was touched", "", "", "", "", "", "skip it leaks"]), tmp_path)
    assert run.ending == "finished"
    told = {event["kind"]: event["text"] for event in run.events}
    assert told["repeated"].endswith("the operator asked for it again from its set-up: the plate was touched")
    assert [row["reason"] for row in run.skipped] == ["it leaks"]
    assert len(run.trials) == 2


def test_an_abort_goes_to_safe(tmp_path: Path) -> None:
    run = run_with(Person("place-2", ["abort"]), tmp_path)
    assert run.ending == "aborted"
    assert any(event["text"] == "bath is safe" for event in run.events)


def test_a_wish_left_in_the_folder_is_taken_once(tmp_path: Path) -> None:
    wishes = Wishes(tmp_path, lambda: None, lambda _: None)
    states = []
    for words in ("p", "go on"):
        leave_wish(tmp_path, words)
        wishes.look()
        states.append(wishes.paused)
        assert not (tmp_path / FILE).exists()
    assert states == [True, False]
    for words, raised in (("skip a b", OperatorSkip), ("r because", OperatorRepeat), ("abort", OperatorAbort)):
        leave_wish(tmp_path, words)
        with pytest.raises(raised):
            wishes.look()
        wishes.look()


@pytest.mark.parametrize(
    ("words", "meant"), [("P", ("pause", "")), ("go", ("go on", "")), ("s  a  b", ("skip", "a b")), ("a", ("abort", ""))]
)
def test_words(words: str, meant: tuple[str, str]) -> None:
    assert read_wish(words) == meant


def test_words_that_mean_nothing_are_told_and_change_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told: list[str] = []
    lines = ["hallo", "skip"]
    wishes = Wishes(tmp_path, lambda: lines.pop(0), told.append)
    wishes.look()
    wishes.look()
    assert told[0].startswith("not understood: 'hallo'. There are: pause, go on")
    assert told[1].startswith("skip needs a reason")
    with pytest.raises(ConfigError, match="repeat needs a reason"):
        leave_wish(tmp_path, "repeat")
    ended = read_run(run_with(Person("", []), tmp_path).folder)
    assert main(["tell", str(ended.folder), "pause"]) == 2
    assert "has ended (finished)" in capsys.readouterr().out
