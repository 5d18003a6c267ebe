"""What the record costs: events, and steps in a long run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from statistics import median, quantiles
from time import thread_time

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from bench.record.writer import Store
from instruments.clock import wall_time
from tests.bench.record.test_record import bare_trial, facts
from tests.benchmarks.figures import figure, taken_s

EVENTS, A_STEP = 3000, 50
LONG, BLOCKS, A_BLOCK = 100_000, 40, 200


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    made = Store.create(tmp_path / "run", {})
    facts(made)
    yield made
    made.close()


def say(store: Store, events: int) -> None:
    for _ in range(events // A_STEP):
        with store.step():
            for number in range(A_STEP):
                store.event(float(number), "state", "the stage moves to x = 120 mm", wall_time())


def test_events_in_steps(benchmark: BenchmarkFixture, store: Store) -> None:
    benchmark.pedantic(lambda: say(store, EVENTS), rounds=5, warmup_rounds=1)
    figure(
        benchmark,
        f"events a second, durable with their step of {A_STEP}",
        EVENTS / taken_s(benchmark),
        "at least 5 000",
    )


def test_a_step_late_in_a_run_of_100_000(
    benchmark: BenchmarkFixture, store: Store, tmp_path: Path
) -> None:
    """Beside a step early in another run, in turns, so that what else the machine does falls on
    both.

    In the thread's own time, without syncs, which would hide it: then what grows with the run is
    all that could show.
    """
    early = Store.create(tmp_path / "early", {})
    facts(early)
    for one in (store, early):
        one._db.execute("PRAGMA synchronous = OFF")
    for number in range(1, LONG + 1):
        store.finished(bare_trial(number))
    steps_s(early, 1, LONG // 100)
    blocks: list[tuple[float, float]] = []

    def in_turns() -> None:
        for number in range(BLOCKS):
            begun = [
                (store, LONG + 1 + number * A_BLOCK),
                (early, LONG // 100 + 1 + number * A_BLOCK),
            ]
            taken_s = {
                one: steps_s(one, first, A_BLOCK)
                for one, first in (begun if number % 2 else reversed(begun))
            }
            blocks.append((taken_s[store], taken_s[early]))

    benchmark.pedantic(in_turns, rounds=1)
    early.close()
    late_s, early_s = (median(some) for some in zip(*blocks, strict=True))
    figure(
        benchmark,
        "a trial's step early in a run, without sync, us of the thread's time",
        1e6 * early_s,
        "-",
    )
    figure(benchmark, f"the same after {LONG}, us", 1e6 * late_s, "no more than that")
    found = [late / early for late, early in blocks]
    twentieths = quantiles(found, n=20)
    what = "the one over the other"
    figure(benchmark, f"{what}, median of {len(found)}", median(found), "at most 1")
    figure(benchmark, f"{what}, 5 % lie below", twentieths[0], "-")
    figure(benchmark, f"{what}, 5 % lie above", twentieths[-1], "-")


def steps_s(store: Store, first: int, count: int) -> float:
    """The median cost of ``count`` trials from number ``first`` on."""
    taken = []
    for number in range(first, first + count):
        done = bare_trial(number)
        start_s = thread_time()
        store.finished(done)
        taken.append(thread_time() - start_s)
    return median(taken)
