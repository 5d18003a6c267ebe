"""The state table, walked for every pair, and the page that draws it."""

from __future__ import annotations

import re
from itertools import product

import pytest

from bench.run.events import AWAY, ENDS, TABLE, RunState, RunStates
from bench.run.interruptions import GARBLED, GONE, POLICIES, REFUSES
from tests.conftest import ROOT

PAGE = ROOT / "docs" / "runs.md"
S = RunState
# Typed from issue and design, not from the table: what may follow what.
MAY_FOLLOW = {
    "planned": "preparing safing aborted faulted",
    "preparing": "settling running paused safing",
    "settling": "running paused safing",
    "running": "settling paused safing",
    "paused": "preparing settling running safing",
    "safing": "finished aborted faulted",
    "finished": "",
    "aborted": "",
    "faulted": "",
}
WAYS = {
    S.PLANNED: [],
    S.PREPARING: [S.PREPARING],
    S.SETTLING: [S.PREPARING, S.SETTLING],
    S.RUNNING: [S.PREPARING, S.RUNNING],
    S.PAUSED: [S.PREPARING, S.PAUSED],
    S.SAFING: [S.PREPARING, S.SAFING],
    S.FINISHED: [S.PREPARING, S.SAFING, S.FINISHED],
    S.ABORTED: [S.ABORTED],
    S.FAULTED: [S.FAULTED],
}


def in_state(state: RunState) -> tuple[RunStates, list[RunState]]:
    told: list[RunState] = []
    states = RunStates(told.append, lambda: 0.0)
    for one in WAYS[state]:
        states.to(one)
    told.clear()
    return states, told


@pytest.mark.parametrize(
    ("before", "after"), [pair for pair in product(RunState, RunState) if pair[0] is not pair[1]]
)
def test_every_pair(before: RunState, after: RunState) -> None:
    states, told = in_state(before)
    if after.value in MAY_FOLLOW[before.value].split():
        states.to(after)
        assert (states.current, told) == (after, [after])
    else:
        with pytest.raises(ValueError, match=f"a run that is {before} can't be {after} next"):
            states.to(after)
        assert (states.current, told) == (before, [])


@pytest.mark.parametrize("state", RunState)
def test_staying_is_no_change(state: RunState) -> None:
    states, told = in_state(state)
    states.to(state)
    assert (states.current, told) == (state, [])


def test_whatever_happens_there_is_a_way_to_safe_and_from_there_to_an_end() -> None:
    assert set(TABLE[S.SAFING]) == ENDS == {S.FINISHED, S.ABORTED, S.FAULTED}
    assert all(
        S.SAFING in TABLE[state]
        for state in RunState
        if state not in ENDS and state is not S.SAFING
    )
    assert not any(S.FINISHED in TABLE[state] for state in RunState if state is not S.SAFING), (
        "nothing is finished before it is safe"
    )


def test_time_away_is_counted_and_only_that() -> None:
    clock = iter([0.0, 10.0, 25.0, 31.0, 40.0, 47.0, 100.0])
    states = RunStates(lambda _: None, lambda: next(clock))
    states.to(S.PREPARING)  # at 10 s
    states.to(S.SETTLING)  # at 25 s
    assert states.away_s == 6.0  # looked at 31 s
    assert {S.PAUSED, S.SETTLING} == AWAY


def test_a_pause_goes_back_to_where_it_was_and_stays_where_it_is_given_up() -> None:
    states, told = in_state(S.RUNNING)
    with states.during(S.PAUSED):
        assert states.current is S.PAUSED
    assert told == [S.PAUSED, S.RUNNING]
    with pytest.raises(OSError, match="gone"), states.during(S.PAUSED):
        raise OSError("gone")
    assert states.current is S.PAUSED


def test_the_page_draws_and_lists_the_table_as_it_is() -> None:
    page = PAGE.read_text(encoding="utf-8")
    after = {state: [to for to in RunState if to in TABLE[state]] for state in RunState}
    drawing = ["stateDiagram-v2", "    [*] --> planned"]
    drawing += [f"    {state} --> {to}" for state in RunState for to in after[state]]
    drawing += [f"    {state} --> [*]" for state in RunState if state in ENDS]
    assert "\n".join(drawing) + "\n```" in page
    listed = re.findall(r"^\| (\w+) \| [^|]+ \| ([^|]+) \|$", page, re.MULTILINE)
    assert [(str(state), ", ".join(after[state]) or "-") for state in RunState] == listed[1:]


def test_the_page_lists_what_is_tried_again() -> None:
    means = {
        GONE: "doesn't answer, link broken",
        GARBLED: "answers nonsense",
        REFUSES: "says no, or gives nothing usable",
    }
    rows = [
        f"| {who} | {means[kind]} | {policy.times} | {policy.check} |"
        for (who, kind), policy in POLICIES.items()
    ]
    head = (
        "| instrument | fault | tries in a trial | what the operator is told |\n|---|---|---|---|"
    )
    assert "\n".join([head, *rows]) in PAGE.read_text(encoding="utf-8")
