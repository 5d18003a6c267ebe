"""The console operator: prompts that a person understands, and an abort at each of them."""

from __future__ import annotations

import io
from collections.abc import Callable

import pytest

from instruments.operators.console import ConsoleOperator
from instruments.operators.operator import Arrangement, OperatorAbort

ASKED = Arrangement("overlapping", "overlapping", (), "Two teats touching.", 4)


def operator(answers: str) -> tuple[ConsoleOperator, io.StringIO]:
    out = io.StringIO()
    return ConsoleOperator(io.StringIO(answers), out), out


def test_it_says_what_to_do_and_waits_for_enter() -> None:
    person, out = operator("\n\n\n")
    person.confirm_homing("Put the stylus on its peg.")
    assert person.set_up(ASKED).visible == (True,) * 4
    person.touch(3, 4)
    said = out.getvalue()
    for words in ("Put the stylus on its peg.", "Two teats touching.", "teat 3 of 4", "a = abort"):
        assert words in said


def test_hidden_teats_are_told_by_number() -> None:
    person, _ = operator("2, 4\n")
    assert person.set_up(ASKED).visible == (True, False, True, False)


@pytest.mark.parametrize("wrong", ["5", "0", "two", "1 x", "-1"])
def test_nonsense_is_asked_again(wrong: str) -> None:
    person, out = operator(f"{wrong}\n1\n")
    assert person.set_up(ASKED).visible == (False, True, True, True)
    assert f"Not understood: '{wrong}'" in out.getvalue()


PROMPTS: tuple[Callable[[ConsoleOperator], object], ...] = (
    lambda person: person.confirm_homing("x"),
    lambda person: person.set_up(ASKED),
    lambda person: person.touch(1, 4),
)


@pytest.mark.parametrize("answer", ["a\n", "abort\n", "Q\n", ""])
@pytest.mark.parametrize("ask", PROMPTS)
def test_every_prompt_can_abort(ask: Callable[[ConsoleOperator], object], answer: str) -> None:
    person, _ = operator(answer)
    with pytest.raises(OperatorAbort):
        ask(person)
