"""A trial as often as the operator wants it, and how long the rest of the run takes by what the
trials took so far.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import cast

import pytest

from bench.record.writer import Store
from bench.run.context import Attention
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
    no_check,
)

PLANNED = load_script(find_script(None)).planned[:5]


class Told:
    """Notes what the operator is told."""

    def __init__(self) -> None:
        self.trials: list[tuple[int, int, float | None]] = []
        self.events: list[str] = []

    def ask(self, request: Request, check: Callable[[], None] = no_check) -> Answer:
        assert isinstance(request, NextTrial)
        self.trials.append((request.number, request.of, request.left_s))
        return DONE

    def event(self, kind: str, text: str) -> None:
        self.events.append(f"{kind} {text}")


def attempts(
    once: Callable[[PlannedTrial], None], clock: VirtualClock, folder: Path
) -> tuple[Attempts, Told, Store]:
    told = Told()
    store = Store.create(folder / "run", {})
    return Attempts(once, len(PLANNED), told, clock, store, cast(Attention, told)), told, store


def test_the_time_left_is_told_from_the_third_trial_on(tmp_path: Path) -> None:
    """The first waits for the bath to heat up: it says nothing of the others."""
    clock = VirtualClock()
    takes_s = iter([3600.0, 60.0, 120.0, 60.0, 60.0])
    all_of, told, store = attempts(lambda _: clock.sleep(next(takes_s)), clock, tmp_path)
    for trial in PLANNED:
        all_of.run(trial)
    store.close()
    assert told.trials == [(1, 5, None), (2, 5, None), (3, 5, 180.0), (4, 5, 180.0), (5, 5, 80.0)]


def test_until_then_by_what_was_expected(tmp_path: Path) -> None:
    clock, told = VirtualClock(), Told()
    store = Store.create(tmp_path / "run", {})
    all_of = Attempts(
        lambda _: clock.sleep(60.0),
        len(PLANNED),
        told,
        clock,
        store,
        cast(Attention, told),
        each_s=100.0,
    )
    for trial in PLANNED:
        all_of.run(trial)
    store.close()
    assert [left_s for _, _, left_s in told.trials] == [500.0, 400.0, 180.0, 120.0, 60.0]


def test_time_that_was_no_work_is_kept_out_of_the_time_left(tmp_path: Path) -> None:
    """A pause, or a suspension: it says nothing of the trials to come."""
    clock, away_s = VirtualClock(), 0.0

    def once(_: PlannedTrial) -> None:
        nonlocal away_s
        clock.sleep(60.0)
        clock.sleep(1000.0)
        away_s += 1000.0

    store = Store.create(tmp_path / "run", {})
    told = Told()
    all_of = Attempts(
        once, len(PLANNED), told, clock, store, cast(Attention, told), away_s=lambda: away_s
    )
    for trial in PLANNED:
        all_of.run(trial)
    store.close()
    assert [left_s for _, _, left_s in told.trials[2:]] == [180.0, 120.0, 60.0]


def test_again_and_again_until_it_is_done(tmp_path: Path) -> None:
    wishes: list[Exception | None] = [OperatorRepeat(), OperatorRepeat(), None]

    def once(_: PlannedTrial) -> None:
        if wish := wishes.pop(0):
            raise wish

    all_of, told, store = attempts(once, VirtualClock(), tmp_path)
    all_of.run(PLANNED[0])
    store.close()
    assert not wishes
    assert told.trials == [(1, 5, None)]
    assert [event.split()[0] for event in told.events] == ["repeated", "repeated"]


def test_a_skip_is_kept_and_an_abort_goes_on_its_way(tmp_path: Path) -> None:
    wishes: list[Exception] = [
        OperatorRepeat(),
        OperatorSkip("the hose leaks"),
        OperatorAbort("enough"),
    ]

    def once(_: PlannedTrial) -> None:
        raise wishes.pop(0)

    all_of, told, store = attempts(once, VirtualClock(), tmp_path)
    all_of.run(PLANNED[0])
    with pytest.raises(OperatorAbort, match="enough"):
        all_of.run(PLANNED[1])
    store.close()
    assert told.events[-1] == f"skipped {PLANNED[0].id}: the operator skipped it: the hose leaks"
