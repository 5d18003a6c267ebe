"""A trial as often as the operator wants it, and how long the rest of the run takes by what the
trials took so far.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from bench.record.writer import Store
from bench.run.context import RunContext
from bench.run.trial import Attempts
from bench.script.model import find_script, load_script
from bench.script.planned_trials import PlannedTrial
from instruments.clock import VirtualClock
from instruments.operators.operator import (
    DONE,
    Answer,
    NextTrial,
    OperatorAbort,
    OperatorRepeat,
    OperatorSkip,
    Request,
)

PLANNED = load_script(find_script(None)).planned[:5]


class Context:
    """What of a run's context is used: notes what the operator is told, and the events."""

    def __init__(self, folder: Path) -> None:
        self.clock = VirtualClock()
        self.store = Store.create(folder / "run", {})
        self.script = SimpleNamespace(planned=PLANNED)
        self.states = SimpleNamespace(away_s=0.0)
        self.trials: list[tuple[int, int, float | None]] = []
        self.events: list[str] = []

    def ask(self, request: Request) -> Answer:
        assert isinstance(request, NextTrial)
        self.trials.append((request.number, request.of, request.left_s))
        return DONE

    def event(self, kind: str, text: str) -> None:
        self.events.append(f"{kind} {text}")


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Context]:
    context = Context(tmp_path)
    with closing(context.store):
        yield context


def attempts(
    told: Context, once: Callable[[PlannedTrial], None], each_s: float | None = None
) -> Attempts:
    return Attempts(cast(RunContext, told), once, each_s=each_s)


@pytest.mark.parametrize(
    ("takes_s", "expected_s", "left_s"),
    [
        ([3600.0, 60.0, 120.0, 60.0, 60.0], None, [None, None, 180.0, 180.0, 80.0]),
        ([60.0] * 5, 100.0, [500.0, 400.0, 180.0, 120.0, 60.0]),
    ],
    ids=["the first waits for the bath to heat up", "until then by what was expected"],
)
def test_the_time_left_is_told_from_the_third_trial_on(
    takes_s: list[float], expected_s: float | None, left_s: list[float | None], told: Context
) -> None:
    takes = iter(takes_s)
    all_of = attempts(told, lambda _: told.clock.sleep(next(takes)), expected_s)
    for trial in PLANNED:
        all_of.run(trial)
    assert told.trials == [(number, 5, left) for number, left in enumerate(left_s, 1)]


def test_time_that_was_no_work_is_kept_out_of_the_time_left(told: Context) -> None:
    """A pause, or a suspension: it says nothing of the trials to come."""

    def once(_: PlannedTrial) -> None:
        told.clock.sleep(60.0)
        told.clock.sleep(1000.0)
        told.states.away_s += 1000.0

    all_of = attempts(told, once)
    for trial in PLANNED:
        all_of.run(trial)
    assert [left_s for _, _, left_s in told.trials[2:]] == [180.0, 120.0, 60.0]


def test_again_and_again_until_it_is_done(told: Context) -> None:
    wishes: list[Exception | None] = [OperatorRepeat(), OperatorRepeat(), None]

    def once(_: PlannedTrial) -> None:
        if wish := wishes.pop(0):
            raise wish

    all_of = attempts(told, once)
    all_of.run(PLANNED[0])
    assert not wishes
    assert told.trials == [(1, 5, None)]
    assert [event.split()[0] for event in told.events] == ["repeated", "repeated"]


def test_a_skip_is_kept_and_an_abort_goes_on_its_way(told: Context) -> None:
    wishes: list[Exception] = [
        OperatorRepeat(),
        OperatorSkip("the hose leaks"),
        OperatorAbort("enough"),
    ]

    def once(_: PlannedTrial) -> None:
        raise wishes.pop(0)

    all_of = attempts(told, once)
    all_of.run(PLANNED[0])
    with pytest.raises(OperatorAbort, match="enough"):
        all_of.run(PLANNED[1])
    assert told.events[-1] == f"skipped {PLANNED[0].id}: the operator skipped it: the hose leaks"
