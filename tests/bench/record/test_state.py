"""One word for how a run stands, the same on each surface at the same moment."""

from __future__ import annotations

import json
import shutil
from contextlib import ExitStack
from pathlib import Path

import pytest

from bench.console.watching import listed
from bench.record.reader import read_run
from bench.record.state import State, run_lock, state_of
from bench.record.writer import Store
from bench.run.lock import locked
from instruments.clock import wall_time
from tests.bench.commands import Said
from tests.bench.small_run import KEPT

# the record's ending, and the events before it
ENDINGS: dict[State, tuple[str, tuple[str, ...]]] = {
    State.RUNNING: ("interrupted", ()),
    State.FAULTED: ("faulted", ("fault",)),
    State.TRIPPED: ("faulted", ("trip", "fault")),
    State.ABORTED: ("aborted", ("aborted",)),
    State.INTERRUPTED: ("interrupted", ()),
}


def stopped(state: State, folder: Path) -> Path:
    """A run of 18 trials with the results of two."""
    run = Path(shutil.copytree(KEPT, folder / "runs" / "a-run"))
    ending, kinds = ENDINGS[state]
    store = Store(run)
    for kind in kinds:
        store.event(None, kind, "bath: no answer for 12 s", wall_time())
    store.fact("planned", 18)
    store.fact("ending", ending)
    store.close()
    return run


@pytest.mark.slow
@pytest.mark.parametrize("state", ENDINGS)
def test_every_surface_has_the_same_word(state: State, tmp_path: Path, said: Said) -> None:
    run = stopped(state, tmp_path)
    with ExitStack() as stack:
        if state is State.RUNNING:
            stack.enter_context(locked(run_lock(run), "a run", print, "run"))
        assert read_run(run).state is state
        table = said(0, "runs {}", run.parent).out
        assert state in table
        others = set(ENDINGS) - {state}
        assert not any(other in table for other in others)
        found = json.loads(said(0, "runs {} --json", run.parent).out)["runs"][0]
        card = listed(run.parent)[0]
        shown = said(3, "report {} --no-pdf", run).out
    assert f'verdict-{state}"' in (run.parent / "index.html").read_text(encoding="utf-8")
    assert (found["state"], found["ending"]) == (state, ENDINGS[state][0])
    assert {one["verdict"] for one in found["results"]} == {"aborted"}, "as scripts know it"
    assert card["state"] == state
    written = json.loads((run / "report" / "run.json").read_text(encoding="utf-8"))
    assert (written["state"], written["ending"]) == (state, ENDINGS[state][0])
    junit = (run / "report" / "junit.xml").read_text(encoding="utf-8")
    page = (run / "report" / "index.html").read_text(encoding="utf-8")
    assert f'<span class="word-text">{state}</span>' in page
    if state is State.RUNNING:
        assert "running: trial 3 of 18" in shown
        assert "trial 3 of 18" in junit
        for text in (shown, junit, page):
            assert "The bench died" not in text
            assert "teatbench resume" not in text
    else:
        assert f"Verdict: {state}" in shown
        assert "2 of 18 trials" in junit


def test_only_the_last_session_s_trip_counts(tmp_path: Path) -> None:
    run = stopped(State.TRIPPED, tmp_path)
    store = Store(run)
    store.fact("ending", "aborted")
    store.close()
    assert read_run(run).state is State.ABORTED
    store = Store(run)
    store.fact("ending", "faulted")
    store.close()
    assert read_run(run).state is State.FAULTED
    assert listed(run.parent)[0]["state"] == State.FAULTED


def test_an_ending_counts_though_the_bench_still_packs_and_an_unknown_one_has_a_word() -> None:
    assert state_of("finished", tripped=False, held=True) is State.FINISHED
    assert state_of("exploded", tripped=False, held=False) is State.INTERRUPTED
