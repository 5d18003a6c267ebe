"""Prompts and answers as files: of several answers one holds, and both ends know which."""

from __future__ import annotations

import errno
import io
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest

from instruments.clock import RealClock
from instruments.operators import operator as op
from instruments.operators.console import Console
from instruments.operators.mailbox import (
    AlreadyAnsweredError,
    Mailbox,
    NotOpenError,
    give_answer,
    read_answer,
    read_prompt,
)

PROMPT = op.Prompt("touch", "Touch the end of teat 1.", pedal=True)
PAIRS = 200


@pytest.mark.slow
def test_of_many_pairs_of_answers_each_time_exactly_one_is_taken(tmp_path: Path) -> None:
    mailbox, outcomes = Mailbox(tmp_path), []
    barrier = threading.Barrier(3)

    def answer(name: str) -> None:
        for number in range(1, PAIRS + 1):
            barrier.wait()
            try:
                outcomes.append((number, give_answer(tmp_path, number, "go", name).by))
            except AlreadyAnsweredError as error:
                outcomes.append((number, f"not: {error.by}"))
            barrier.wait()

    threads = [threading.Thread(target=answer, args=(name,)) for name in ("left", "right")]
    for thread in threads:
        thread.start()
    for number in range(1, PAIRS + 1):
        mailbox.open(PROMPT)
        barrier.wait()
        barrier.wait()
        given = mailbox.close("", "the terminal")
        assert given.number == number
        assert (number, given.by) in outcomes
        assert (number, f"not: {given.by}") in outcomes
    for thread in threads:
        thread.join()
    assert len(outcomes) == 2 * PAIRS


def test_on_a_file_system_without_links_too_one_answer_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise PermissionError(errno.EPERM, "no links on FAT")

    def answer(name: str, number: int) -> bool:
        barrier.wait()
        with suppress(AlreadyAnsweredError):
            return give_answer(tmp_path, number, "go", name).by == name
        return False

    monkeypatch.setattr("os.link", refused)
    mailbox, barrier = Mailbox(tmp_path), threading.Barrier(2)
    with ThreadPoolExecutor(2) as threads:
        for number in range(1, 21):
            mailbox.open(PROMPT)
            taken = list(threads.map(answer, ("left", "right"), (number, number)))
            assert sorted(taken) == [False, True]
            assert mailbox.close("", "the terminal").by == ("left" if taken[0] else "right")
    names = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert names == {"prompt.json", *(f"{number}.json" for number in range(1, 21))}


@pytest.mark.parametrize(
    ("number", "words", "error"),
    [
        (2, "go", NotOpenError),  # not yet
        (1, "hidden 3", ValueError),  # not of a touch
        (1, "skip", ValueError),  # without a reason
        (1, "../../etc", ValueError),
    ],
)
def test_an_answer_that_does_not_fit_is_refused(
    number: int, words: str, error: type[Exception], tmp_path: Path
) -> None:
    Mailbox(tmp_path).open(PROMPT)
    with pytest.raises(error):
        give_answer(tmp_path, number, words, "a browser")
    assert read_answer(tmp_path, number) is None


def test_numbers_go_on_after_a_session_that_was_killed(tmp_path: Path) -> None:
    first = Mailbox(tmp_path)
    first.open(PROMPT)
    give_answer(tmp_path, 1, "go", "a browser")
    first.open(PROMPT)  # and no word from it any more
    second = Mailbox(tmp_path)
    with pytest.raises(NotOpenError):
        give_answer(tmp_path, 2, "go", "a browser that still shows it")
    second.open(PROMPT)
    prompt = read_prompt(tmp_path)
    assert prompt is not None
    assert (prompt["number"], prompt["open"]) == (3, True)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("repeat the plate moved", op.OperatorRepeat),
        ("skip the teat came off", op.OperatorSkip),
        ("abort", op.OperatorAbort),
    ],
)
def test_a_browser_s_words_mean_what_they_mean_at_the_terminal(
    words: str, expected: type[Exception], tmp_path: Path
) -> None:
    operator = Console(io.StringIO(), io.StringIO(), RealClock(), mailbox=Mailbox(tmp_path))
    caller = threading.Timer(0.0, lambda: _once_open(tmp_path, words))
    caller.start()
    with pytest.raises(expected):
        operator.ask(op.Touch(1, 4))
    caller.join()


def _once_open(folder: Path, words: str) -> None:
    while not (prompt := read_prompt(folder)) or not prompt["open"]:
        threading.Event().wait(0.01)
    give_answer(folder, prompt["number"], words, "a browser")


def test_what_ends_a_prompt_without_an_answer_closes_it(tmp_path: Path) -> None:
    class TripError(Exception):
        pass

    def check() -> None:
        raise TripError("too hot")

    operator = Console(io.StringIO(), io.StringIO(), RealClock(), mailbox=Mailbox(tmp_path))
    with pytest.raises(TripError):
        operator.ask(op.Touch(1, 4), check)
    with pytest.raises(AlreadyAnsweredError, match="the bench"):
        give_answer(tmp_path, 1, "go", "a browser")
