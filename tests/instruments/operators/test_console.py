"""The console operator: prompts that a person understands, and an abort at each of them."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from instruments.clock import VirtualClock
from instruments.operators import operator as op
from instruments.operators.console import Console
from instruments.world.boards import Pattern
from tests.instruments.operators.people import arrangement, person

ASKED = arrangement("overlapping")
PROMPTS: dict[str, op.Awaited] = {
    "homing": op.Homing("x"),
    "check point": op.CheckPoint(1, 5),
    "set up": ASKED,
    "touch": op.Touch(1, 4),
    "board": op.BoardPose(Pattern(), "Hold the board. Missing: left: tilt the board.", 3),
    "fixed board": op.BoardPose(Pattern(), "Fix the board.", 1, fixed=True),
    "corner": op.BoardTouch(0, "Touch point 1."),
}
IN_TRIALS = ("set up", "touch")


def asked(answers: str) -> tuple[Console, io.StringIO]:
    out = io.StringIO()
    return person(answers, out), out


def test_one_prompt_asks_for_all_touches_of_a_teat_end() -> None:
    who, out = asked("\n\n\n\ns loose\n")
    who.ask(op.NextTrial(3, 18))
    who.ask(ASKED)
    for number in (1, 2):
        who.ask(op.Touch(2, 4, number, 3))
    who.ask(op.Touch(2, 4, 2, 3, again="It moved."))
    with pytest.raises(op.OperatorSkip, match="loose"):
        who.ask(op.Touch(2, 4, 3, 3))
    said = out.getvalue()
    assert (
        "[trial 3 of 18, teat 2 of 4, 9 of 12 touches left] Touch the end of teat 2, right rear (RR),"
        in said
    )
    assert "hold it still: 3 touches, lifted in between.\nEnter to go on\n(s REASON" in said
    press = (
        "] Lift the tip, then touch the same end again.\nEnter to go on (s, r, ? or a as before): "
    )
    for number, left in ((2, 8), (3, 7)):
        assert f"[press {number} of 3, {left} of 12 left{press}" in said
    assert said.count("s REASON") == 3, "the set-up, the teat, and the touch that was refused"
    once = "[trial 3 of 18, teat 2 of 4, 8 of 12 touches left] Once more: touch the end of"
    assert f"It moved.\n\n{once}" in said


def test_it_says_how_far_the_run_is() -> None:
    who, out = asked("\n" * 5)
    who.ask(op.NextTrial(3, 18, lambda: 754.0))
    who.ask(ASKED)
    who.ask(op.Touch(2, 4, number=1, numbers=3))
    who.ask(op.CheckPoint(4, 5))
    said = out.getvalue()
    assert "[trial 3 of 18; about 13 min left] Situation ideal, layout overlapping:" in said
    touch = "[trial 3 of 18, teat 2 of 4, 9 of 12 touches left; about 13 min left]"
    assert f"{touch} Touch the end of teat 2, right rear (RR), with" in said
    assert "[touch 4 of 5] Arm check" in said

    who.ask(op.NextTrial(1, 18))
    who.ask(ASKED)
    unknown = out.getvalue().removeprefix(said)
    assert "[trial 1 of 18] " in unknown
    assert "left" not in unknown
    assert op.time_left(0.0) == op.time_left(59.0) == "less than a minute left"
    assert op.time_left(9000.0) == "about 2.5 h left"


def test_teats_are_reported_by_their_names_where_they_have_some() -> None:
    who, out = asked("\n\n")
    called = zip(ASKED.phantom.teats, ("LF", "RF", "LR", "RR"), strict=True)
    named = tuple(replace(teat, name=name) for teat, name in called)
    who.ask(replace(ASKED, phantom=replace(ASKED.phantom, teats=named)))
    who.ask(op.Touch(3, 4))
    assert "Touch the end of teat 3, left rear (LR), with" in out.getvalue()


@pytest.mark.parametrize(
    ("request_", "text"),
    [
        (op.Touch(2, 4, again="Not there."), "Once more: touch the end of teat 2 with"),
        (op.BoardTouch(0, "Touch point 1.", again="Not there."), "Touch point 1."),
    ],
)
def test_a_touch_that_is_asked_for_again_says_why(
    request_: op.Touch | op.BoardTouch, text: str
) -> None:
    who, out = asked("\n")
    who.ask(request_)
    assert out.getvalue().index("Not there.") < out.getvalue().index(text)


def test_boards_may_be_enough_but_for_one_that_is_to_be_touched() -> None:
    who, out = asked("Enough\n")
    with pytest.raises(op.OperatorEnough, match="has shown enough"):
        who.ask(PROMPTS["board"])
    assert "[view 3] Hold the board. Missing: left: tilt the board." in out.getvalue()
    assert "e = enough, go on with what there is" in out.getvalue()
    who, out = asked("enough\n\n")
    who.ask(PROMPTS["fixed board"])
    assert "Not understood: 'enough'." in out.getvalue()
    assert "[position 1] Fix the board." in out.getvalue()


@pytest.mark.parametrize("answer", ["2,4", "2 and 4", "hidden 4 2", "2 2 4"])
def test_hidden_teats_are_reported_by_number_and_confirmed(answer: str) -> None:
    who, out = asked(f"{answer}\n")
    assert who.ask(ASKED).visible == (True, False, True, False)
    assert "Hidden: teat ends 2 and 4.\n" in out.getvalue()


@pytest.mark.parametrize("wrong", ["5", "and", "0", "1 x", "-1", "³"])
def test_nonsense_is_asked_again(wrong: str) -> None:
    who, out = asked(f"{wrong}\n1\n")
    assert who.ask(ASKED).visible == (False, True, True, True)
    allowed = 'There are Enter, the hidden ends\' numbers, 1 to 4: "2 4", s REASON, r, ? and a.'
    assert f"Not understood: '{wrong}'. {allowed}" in out.getvalue()


@pytest.mark.parametrize(
    ("teats", "words"),
    [
        (1, '1 where the end is hidden: "1"'),
        (2, 'the hidden ends\' numbers, 1 to 2: "2"'),
        (5, 'the hidden ends\' numbers, 1 to 5: "2 4"'),
    ],
)
def test_what_may_be_answered_is_an_example_of_this_phantom(teats: int, words: str) -> None:
    prompt = op.Prompt("set up", "", hidden_to=teats)
    assert prompt.allowed.startswith(f"There are Enter, {words}, ")
    example = re.findall('"(.*)"', words)[0]
    assert op.understood(example, prompt) == frozenset(map(int, example.split()))


@pytest.mark.parametrize("typed", ["s hose\x1b[Dleaks\n", "s\nhose\x1b[Dleaks\n"])
def test_arrow_keys_put_nothing_into_the_record(typed: str) -> None:
    who, out = asked(f"{typed}s the hose leaks\n")
    with pytest.raises(op.OperatorSkip) as skip:
        who.ask(ASKED)
    assert skip.value.reason == "the hose leaks"
    assert "Arrow keys edit nothing here; backspace does." in out.getvalue()


@pytest.mark.parametrize("answer", ["a\n", " Q \n", ""])
@pytest.mark.parametrize("prompt", PROMPTS)
def test_every_prompt_can_abort_and_says_how(prompt: str, answer: str) -> None:
    who, out = asked(answer)
    why = "aborted the run" if answer else "the terminal gives no more input"
    with pytest.raises(op.OperatorAbort, match=why):
        who.ask(PROMPTS[prompt])
    assert "a = abort the run" in out.getvalue()
    who, out = asked(f"?\nr\ns\n{answer}")
    who.in_run = False
    with pytest.raises(op.OperatorAbort, match="aborted$" if answer else why):
        who.ask(PROMPTS[prompt])
    assert not re.search(r"the run|the trial|Skip:|the bath|s REASON", out.getvalue())


@pytest.mark.parametrize("prompt", PROMPTS)
def test_every_prompt_is_explained_and_only_a_trial_can_be_skipped_or_repeated(prompt: str) -> None:
    who, out = asked("?\n\n")
    who.ask(PROMPTS[prompt])
    explained = out.getvalue().rsplit(": \n", 2)[1]
    assert ("Skip: " in explained) is (prompt in IN_TRIALS)
    assert "Abort: " in explained
    assert out.getvalue().count("? = explain") == 2
    who, out = asked("s the teat came off\na\n")
    with pytest.raises(op.OperatorSkip if prompt in IN_TRIALS else op.OperatorAbort) as wish:
        who.ask(PROMPTS[prompt])
    assert ("s REASON" in out.getvalue()) is (prompt in IN_TRIALS)
    if isinstance(wish.value, op.OperatorSkip):
        assert wish.value.reason == "the teat came off"
    who, out = asked("r\na\n")
    with pytest.raises(op.OperatorRepeat if prompt in IN_TRIALS else op.OperatorAbort):
        who.ask(PROMPTS[prompt])


def test_a_skip_without_a_reason_is_asked_for_one_and_without_it_there_is_none() -> None:
    who, out = asked("skip\n\ns\n the hose leaks \n")
    with pytest.raises(op.OperatorSkip) as skip:
        who.ask(op.Touch(1, 4))
    assert skip.value.reason == "the hose leaks"
    assert out.getvalue().count("Why?") == out.getvalue().count("Enter to go on") == 2


@pytest.mark.parametrize("key", ["r", "Q"])
def test_a_key_is_no_reason_and_does_what_it_does_at_the_question(key: str) -> None:
    for answers in (f"s\n{key}\n", f"s {key}\n{key}\n", f"s\n?\n{key}\n", f"s\ns\n{key}\n"):
        with pytest.raises(op.OperatorRepeat if key == "r" else op.OperatorAbort):
            asked(answers)[0].ask(op.Touch(1, 4))
    with pytest.raises(ValueError, match="needs a reason"):
        op.check_words(f"skip {key}", op.Prompt("touch", "x"))  # a browser's


def test_without_a_terminal_the_pedals_are_not_read() -> None:
    """Answers from a file or a pipe: the pedals are not even polled."""

    def never() -> Callable[[float], bool]:
        raise AssertionError("the pedals were watched")

    out = io.StringIO()
    who = Console(io.StringIO("\n" * 6 + "a\n"), out, VirtualClock(), watch=never)
    for touch in range(1, 7):
        who.ask(op.CheckPoint(touch, 6))
    assert "pedal" not in out.getvalue()
    leans = re.findall(r"the stylus ([a-z ]+),", out.getvalue())
    assert len(set(leans[:5])) == 5
    assert leans[5] == leans[0]
    with pytest.raises(op.OperatorAbort):
        who.ask(op.CheckPoint(1, 6))


def test_a_closed_output_is_a_terminal_that_has_gone() -> None:
    out = io.StringIO()
    out.close()
    with pytest.raises(op.OperatorAbort, match="the terminal gives no more input"):
        person("\n", out).ask(op.Touch(1, 4))


@pytest.mark.parametrize("columns", [40, 80, 100])
@pytest.mark.parametrize("prompt", PROMPTS)
def test_prompts_are_wrapped_between_words_and_keys_have_lines_of_their_own(
    prompt: str, columns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, narrow = io.StringIO(), io.StringIO()
    person("?\n\n", whole).ask(PROMPTS[prompt])
    size = os.terminal_size((columns, 24))
    monkeypatch.setattr(os, "get_terminal_size", lambda _: size)
    monkeypatch.setattr(narrow, "fileno", lambda: 1)
    person("?\n\n", narrow).ask(PROMPTS[prompt])
    lines = narrow.getvalue().splitlines()
    assert all(len(line) < columns for line in lines), "a line more where the cursor wraps"
    assert narrow.getvalue().split() == whole.getvalue().split(), "no word is broken"
    keys = next(i for i, line in enumerate(lines) if "a = abort" in line)
    enter = next(i for i, line in enumerate(lines) if line.startswith("Enter"))
    assert 0 < enter <= keys, "what is asked stands above, and ends before"


def test_the_screen_is_cleared_for_each_prompt_and_given_back() -> None:
    course: list[str] = []

    @contextmanager
    def screen() -> Iterator[None]:
        course.append("aside")
        yield
        course.append("back")

    Console(io.StringIO("\n"), io.StringIO(), VirtualClock(), screen=screen).ask(op.Task("x"))
    assert course == ["aside", "back"]
