"""The catalogue of faults: some of it is run anew, all of it stands in docs/faults.md;
TEATBENCH_CATALOGUE=all runs all.
"""

from __future__ import annotations

import os
from itertools import product
from pathlib import Path

import pytest

from tests.bench.fault_catalogue import (
    FAULTS,
    FOR_S,
    HEAD,
    PAGE,
    STATES,
    Reactions,
    check_sound,
    reaction,
    reactions_of,
    table,
    what_happens,
)

ALL = tuple((*fault, state) for fault, state in product(FAULTS, STATES))
SOME = (
    ("bath", "low level", "preparing"),
    ("bath", "sensor break", "settling"),
    ("stage", "stall", "running"),
    ("arm", "disconnect", "safing"),
)


def rows() -> Reactions:
    """The page's table: reactions by fault."""
    return reactions_of(PAGE.read_text(encoding="utf-8"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("instrument", "name", "state"), ALL if os.environ.get("TEATBENCH_CATALOGUE") == "all" else SOME
)
def test_the_bench_does_what_the_page_says(
    instrument: str, name: str, state: str, tmp_path: Path
) -> None:
    run = what_happens(instrument, name, state, tmp_path)
    check_sound(run)
    assert reaction(run) == rows()[instrument, name][STATES.index(state)]


def test_the_page_has_every_fault_in_every_state() -> None:
    assert len(ALL) > 200
    assert set(rows()) == set(FAULTS)
    assert all(len(cells) == len(STATES) and all(cells) for cells in rows().values())
    head = HEAD.format(for_s=FOR_S, count=len(ALL))
    assert PAGE.read_text(encoding="utf-8") == head + table(rows())
