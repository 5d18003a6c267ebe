"""A script of answers: each at its place, and a clear error where script and run don't fit each
other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from instruments.errors import ProtocolError
from instruments.operators import operator as op
from instruments.operators.prompted import ScriptedAnswer, ScriptedAnswers, check_answer
from instruments.world.boards import Pattern
from tests.instruments.operators.people import arrangement


def scripted(
    *answers: ScriptedAnswer, otherwise: Mapping[op.Kind, str] | None = None
) -> tuple[ScriptedAnswers, list[str]]:
    shown: list[str] = []
    return ScriptedAnswers(answers, otherwise or {}, "answers.toml", show=shown.append), shown


def test_answers_come_in_their_order() -> None:
    who, shown = scripted(
        ScriptedAnswer("homing", "go"),
        ScriptedAnswer("check point", "", times=2),
        ScriptedAnswer("set up", "hidden 2 4"),
        ScriptedAnswer("touch", "repeat"),
        ScriptedAnswer("touch", "s the teat came off"),
        ScriptedAnswer("touch", "abort"),
        ScriptedAnswer("board", "enough", says="view 3"),
    )
    who.ask(op.Homing("On its peg."))
    who.ask(op.CheckPoint(1, 2))
    who.ask(op.CheckPoint(2, 2))
    assert who.ask(arrangement()).visible == (True, False, True, False)
    with pytest.raises(op.OperatorRepeat):
        who.ask(op.Touch(1, 4))
    with pytest.raises(op.OperatorSkip, match="the teat came off"):
        who.ask(op.Touch(1, 4))
    with pytest.raises(op.OperatorAbort):
        who.ask(op.Touch(1, 4))
    with pytest.raises(op.OperatorEnough):
        who.ask(op.BoardPose(Pattern(), "Hold it.", 3))
    who.ask(op.Finish())
    assert shown[0] == "On its peg. > go"
    assert len(shown) == 9, "each answer, and which ends are hidden"


def test_an_answer_waits_for_the_prompt_that_it_is_for() -> None:
    skip = ScriptedAnswer("touch", "skip worn", says="trial 2 of 3, TEAT 3")
    who, _ = scripted(skip, otherwise={"touch": "go", "set up": "go"})
    for trial in (1, 2):
        who.ask(op.NextTrial(trial, 3))
        who.ask(arrangement())
        who.ask(op.Touch(1, 4))
        if trial == 1:
            who.ask(op.Touch(3, 4))
    with pytest.raises(op.OperatorSkip, match="worn"):
        who.ask(op.Touch(3, 4))
    who.ask(op.Finish())


def test_an_unexpected_prompt_says_what_was_asked_and_what_is_next() -> None:
    who, _ = scripted(ScriptedAnswer("set up", "go", says="overlapping", where="line 7"))
    who.ask(op.NextTrial(1, 6))
    with pytest.raises(ProtocolError) as error:
        who.ask(arrangement())
    for words in (
        "answers.toml has no answer",
        "set up: [trial 1 of 6] Situation ideal",
        "'overlapping' (line 7)",
        'to = "set up"',
    ):
        assert words in str(error.value)
    who, _ = scripted()
    with pytest.raises(ProtocolError, match="got no further answer"):
        who.ask(op.Touch(1, 4))
    bare = replace(arrangement(), phantom=replace(arrangement().phantom, name=""))  # a family's
    with pytest.raises(ProtocolError, match="Situation ideal:\n"):
        who.ask(bare)


def test_answers_to_no_question_are_an_error_at_the_end() -> None:
    who, _ = scripted(
        ScriptedAnswer("homing", "go"), ScriptedAnswer("touch", "go", times=12, where="answer 2")
    )
    who.ask(op.Homing("On its peg."))
    who.ask(op.Touch(1, 4))
    with pytest.raises(
        ProtocolError,
        match=r"11 answers of answers.toml were never asked for; the first is 'go' .*answer 2",
    ):
        who.ask(op.Finish())


def test_a_teat_that_is_not_there_can_not_be_hidden() -> None:
    who, _ = scripted(ScriptedAnswer("set up", "hidden 5"))
    with pytest.raises(ProtocolError, match="There are 4 teats here"):
        who.ask(arrangement())


@pytest.mark.parametrize(
    ("to", "answer", "words"),
    [
        ("touch", "skip", "needs a reason"),
        ("corner", "enough", 'to a prompt of the kind "corner" there are "go", "abort"'),
        ("touch", "2", 'there are "go", "skip REASON", "repeat", "abort"'),
        ("homing", "skip it", 'there are "go", "abort"'),
        ("check point", "repeat", 'there are "go", "abort"'),
        ("set up", "hidden", '"hidden 2 4"'),
    ],
)
def test_an_answer_that_fits_no_such_prompt_is_refused_at_once(
    to: op.Kind, answer: str, words: str
) -> None:
    with pytest.raises(ValueError, match=r".") as error:
        check_answer(to, answer)
    assert words in str(error.value)
