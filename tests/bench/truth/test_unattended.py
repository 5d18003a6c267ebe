"""A night's run asks nobody where nothing has to be done: set-ups of carried trials pass without a
prompt.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from instruments.operators.operator import Arrangement, Prompt
from instruments.operators.prompted import PromptedOperator
from tests.bench.truth.touches import layout

ASKED = Arrangement("plane", layout("table-5-1"), (), "Teats as in table 5.1.")
CARRIED = replace(ASKED, unattended=True)


class Person(PromptedOperator):
    """Goes on at every prompt, and says at the first that the third end is hidden."""

    def __init__(self) -> None:
        self.prompts: list[Prompt] = []

    def answer(self, prompt: Prompt, check: Callable[[], None]) -> frozenset[int]:
        check()
        self.prompts.append(prompt)
        return frozenset({3}) if len(self.prompts) == 1 else frozenset()

    def say(self, text: str) -> None:
        raise AssertionError(f"nothing is to be said here: {text}")


def test_what_stands_as_asked_and_was_not_touched_needs_nobody() -> None:
    person = Person()
    operator = person
    seen = [operator.ask(one).visible for one in (ASKED, CARRIED, CARRIED)]
    assert len(person.prompts) == 1
    assert seen == [(True, True, False, True)] * 3, (
        "what was hidden when it was set up counts as hidden"
    )


def test_another_scene_and_an_attended_trial_are_asked_for() -> None:
    person = Person()
    operator = person
    operator.ask(CARRIED)
    operator.ask(ASKED)
    operator.ask(replace(CARRIED, objects=({"kind": "cold_teat"},)))
    operator.ask(replace(CARRIED, phantom=layout("overlapping")))
    assert len(person.prompts) == 4
