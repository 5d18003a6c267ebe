"""When the ends are touched, carried and checked, and which trials lose their truth: the sources
against a stage that can slip. Set-ups of carried trials pass without a prompt.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from bench.record.reader import RunRecord, TrialRecord
from bench.record.schema import Row
from bench.record.writer import Store
from bench.truth.carrying import REFERENCE_FACT, UNCONFIRMED_FACT, CarriedTruth, CarryState, resumed
from bench.truth.registration import Registration
from bench.truth.touching import ExpectedScene, NoTruthError, Toucher, TrialTruth
from bench.truth.uncertainty import Triple, TruthMethod, triple
from instruments.operators.operator import Arrangement, Prompt
from instruments.operators.prompted import PromptedOperator
from tests.bench.truth.touches import (
    ENDS_MM,
    Hand,
    layout,
    registered,
    stage_of,
    table_5_1,
    toucher,
)

HOME = np.array([-150.0, -137.5, -1.0])


@dataclass
class Bench:
    """A stage that is told where it is, may have slipped by ``slip_mm``, and a hand that touches
    where the ends then are.
    """

    at_mm: np.ndarray = field(default_factory=lambda: HOME.copy())
    slip_mm: np.ndarray = field(default_factory=lambda: np.zeros(3))
    every: int = 3
    facts: dict[str, object] = field(default_factory=dict)
    checks: list[Row] = field(default_factory=list)
    confirmed: list[str] = field(default_factory=list)
    invalid: dict[str, str] = field(default_factory=dict)
    note: list[tuple[str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(1)
        stage = stage_of(rng)
        self.stage = type(stage)(np.eye(3), np.zeros((3, 3)))
        self.hand = Hand(ENDS_MM.copy())
        self.source = self.new_source()
        self.source.begin()

    def new_source(
        self, state: CarryState | None = None, hand: Toucher | None = None
    ) -> CarriedTruth:
        return CarriedTruth(
            hand or toucher(self.hand, readings=1),
            self.stands,
            self.registration,
            cast("Store", self),
            self.settled,
            self.tell,
            lambda: 7.0,
            every=self.every,
            limit_mm=1.5,
            state=state or CarryState(),
        )

    def registration(self) -> Registration:
        return registered(self.stage, np.random.default_rng(2), u_mm=1e-3)

    def stands(self) -> Triple:
        return triple(self.at_mm)

    def fact(self, key: str, value: object) -> None:
        self.facts[key] = value

    def checked(self, touches: Sequence[Row], invalid: Sequence[str], reason: str) -> None:
        self.checks += touches
        self.invalid |= dict.fromkeys(invalid, reason)

    def settled(self, trials: Sequence[str], good: bool) -> None:
        self.confirmed += trials if good else ()

    def tell(self, kind: str, text: str) -> None:
        self.note.append((kind, text))

    def trial(self, number: int, x_mm: float, fixed: str = "one") -> TrialTruth:
        shown = ExpectedScene(f"{number:03d}", table_5_1(), fixed)
        self.source.before(shown)
        self.at_mm = HOME + np.array([x_mm, 0.0, 0.0])
        self.hand.ends = ENDS_MM + self.at_mm - HOME + self.slip_mm
        truth = self.source.of_trial(shown)
        self.source.stored(shown.trial, truth)
        return truth


def test_good_checks_confirm_every_n_carried_trials_and_at_the_end() -> None:
    bench = Bench()
    for number in range(6):
        bench.trial(number, 10.0 * number)
    assert [row["after_trial"] for row in bench.checks] == ["003"] * 4
    bench.source.end()
    assert {row["number"]: row["after_trial"] for row in bench.checks} == {1: "003", 2: "005"}
    assert all(row["held"] for row in bench.checks)
    assert bench.confirmed == ["001", "002", "003", "004", "005"]
    assert bench.invalid == {}
    bench.source.end()
    assert len(bench.checks) == 8, "nothing is left to check"


def test_a_slip_so_wide_that_teats_are_mistaken_invalidates_too() -> None:
    bench = Bench()
    for number in range(4):
        bench.trial(number, 10.0 * number)
    bench.hand.ends = ENDS_MM[[1, 2, 3, 0]]
    truth = bench.trial(4, 40.0)
    assert list(bench.invalid) == ["001", "002", "003"]
    assert "could not be used" in bench.invalid["001"]
    assert truth.how is TruthMethod.TOUCHED, "there is no reference any more"


def test_another_phantom_or_a_trial_done_again_is_checked_before_and_touched_anew() -> None:
    bench = Bench(every=0)
    bench.trial(0, 0.0)
    bench.trial(1, 10.0)
    other = bench.trial(2, 20.0, fixed="two")
    assert bench.confirmed == ["001"], "checked while it still stood"
    assert other.how is TruthMethod.TOUCHED
    back = bench.trial(3, 30.0, fixed="one")
    assert back.how is TruthMethod.TOUCHED, "what was taken away is not where it was"
    bench.trial(4, 40.0)
    bench.source.before(ExpectedScene("005", table_5_1(), "one"))
    # and then the operator wanted it again: what went wrong, nobody can tell
    assert bench.trial(5, 50.0).how is TruthMethod.TOUCHED
    assert bench.confirmed == ["001", "004"]


def test_a_person_is_needed_only_where_something_was_touched() -> None:
    bench = Bench(every=2)
    asked = []
    for number in range(6):
        shown = ExpectedScene(f"{number:03d}", table_5_1(), "one")
        bench.source.before(shown)
        asked.append(not bench.source.unattended(shown))
        bench.source.stored(shown.trial, bench.source.of_trial(shown))
    # to touch, to put the arm away, and the same after each check
    assert asked == [True, True, False, True, False, True]


def test_a_check_that_is_skipped_is_asked_for_again_and_the_last_leaves_trials_unconfirmed() -> (
    None
):
    bench = Bench(every=1)
    bench.trial(0, 0.0)
    bench.trial(1, 10.0)
    bench.hand.skips = 1
    assert bench.trial(2, 20.0).how is TruthMethod.CARRIED
    why = "check touch 1 was skipped: tired. 1 trial is unconfirmed so far"
    assert bench.note[-1] == ("check touch", why)
    bench.trial(3, 30.0)
    assert bench.confirmed == ["001", "002"]
    bench.hand.skips = 1
    bench.source.end()
    assert bench.invalid == {}
    assert bench.facts[UNCONFIRMED_FACT] == ["003"]


def test_what_was_taken_away_unchecked_is_never_confirmed_by_a_later_check() -> None:
    bench = Bench(every=0)
    bench.trial(0, 0.0)
    bench.trial(1, 10.0)
    bench.hand.skips = 1
    hows = {f"{k:03d}": bench.trial(k, 10.0 * k, fixed="two").how for k in (2, 3)}
    bench.source.end()
    assert bench.confirmed == ["003"]
    state = resumed(record(bench, {"000": TruthMethod.TOUCHED, "001": TruthMethod.CARRIED, **hows}))
    assert (state.unconfirmed, state.since) == (["001"], [])


def test_no_truth_is_not_carried_on() -> None:
    bench = Bench()
    bench.hand.places = [ENDS_MM[1]] * 20
    with pytest.raises(NoTruthError):
        bench.trial(0, 0.0)
    bench.hand.places, bench.hand._next = (), None
    assert bench.trial(1, 10.0).how is TruthMethod.TOUCHED


def test_what_speaks_against_the_registration_is_reported_at_once() -> None:
    bench = Bench()
    bench.stage = type(bench.stage)(np.eye(3), np.diag([0.01, 0.0, 0.0]))
    bench.new_source().begin()
    assert bench.note[-1][0] == "registration"
    assert "scale x" in bench.note[-1][1]


def record(bench: Bench, hows: dict[str, TruthMethod]) -> RunRecord:
    """What a stopped run left: facts, checks and trials, as `read_run` gives them."""
    trials = tuple(
        TrialRecord({"id": name, "invalid": bench.invalid.get(name)}, truth=({"how": how.value},))
        for name, how in hows.items()
    )
    return RunRecord(Path(), bench.facts, trials, checks=tuple(bench.checks))


def test_a_stopped_run_goes_on_from_what_is_in_the_store() -> None:
    bench = Bench()
    hows = {f"{number:03d}": bench.trial(number, 10.0 * number).how for number in range(6)}
    state = resumed(record(bench, hows))
    assert state.since == ["004", "005"]
    assert state.checks == 1
    assert REFERENCE_FACT in bench.facts
    bench.source = bench.new_source(state)
    bench.source.begin()
    assert bench.trial(6, 60.0).how is TruthMethod.CARRIED
    bench.source.end()
    assert bench.confirmed == ["001", "002", "003", "004", "005", "006"]


ASKED = Arrangement("plane", layout("table-5-1"), (), "Teats as in table 5.1.")
CARRIED = replace(ASKED, unattended=True)


class Person(PromptedOperator):
    """Goes on at every prompt, and says at the first that the third end is hidden."""

    def __init__(self) -> None:
        self.prompts: list[Prompt] = []
        self.said: list[str] = []

    def answer(self, prompt: Prompt, check: Callable[[], None]) -> str:
        check()
        self.prompts.append(prompt)
        return "3" if len(self.prompts) == 1 else "go"

    def say(self, text: str) -> None:
        self.said.append(text)


def test_only_what_stands_as_asked_and_was_not_touched_needs_no_operator() -> None:
    person = Person()
    seen = [person.ask(one).visible for one in (ASKED, CARRIED, CARRIED)]
    assert len(person.prompts) == 1
    # what was hidden when it was set up counts as hidden
    assert seen == [(True, True, False, True)] * 3
    cold_teat = replace(CARRIED, objects=({"kind": "cold_teat"},))
    for asked in (ASKED, cold_teat, replace(CARRIED, phantom=layout("overlapping"))):
        person.ask(asked)
    assert len(person.prompts) == 4
    assert person.said == ["Hidden: teat end 3."]
