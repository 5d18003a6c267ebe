"""A bench is killed in real time, and its run resumed: in each state, with a bath that answers and
one that doesn't, whatever its guardian does meanwhile. Each run reaches its end, and has the trials
of one that nothing disturbed.

The whole matrix is the weekly run's; three kinds of cells are in every suite.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

if sys.platform == "win32":
    pytest.skip("kills benches with POSIX signals", allow_module_level=True)

from tests.bench.crashes import (
    CELLS,
    GUARDIANS,
    PUMP_ON,
    REACHED,
    SILENT,
    STATES,
    crash,
    undisturbed,
)

pytestmark = pytest.mark.slow

AT_ONCE = 3  # an arm in real time that waits for a busy processor counts as lost
Trials = dict[str, list[Any]]
Cell = tuple[str, str, str]

SOME: tuple[Cell, ...] = (
    ("capture", SILENT, "trying"),
    ("moving", REACHED, "frozen"),
    ("bring-up", SILENT, "gone"),
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Trials:
    trials = undisturbed(tmp_path_factory.mktemp("whole"))
    assert len(trials["trials"]) == 2
    assert all(trials[table] for table in ("frames", "touches", "truth", "found", "scores"))
    return trials


def cells_end_as(
    whole: Trials, cells: Sequence[Cell], folder: Path, **more: Any
) -> list[tuple[str, float]]:
    """Crash in all ``cells``; how long each resumed bench took, for the summary."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        jobs = {
            cell: pool.submit(crash, folder / "-".join(cell).replace(" ", "-"), *cell, **more)
            for cell in cells
        }
        outcomes = {cell: job.result() for cell, job in jobs.items()}
    for cell, outcome in outcomes.items():
        assert outcome.trials == whole, cell
        assert outcome.sessions == (3 if "trying" in cell else 2), cell
        assert not outcome.latched, f"{cell}: nothing tripped"
        assert "guardian lost" not in outcome.said, cell
    return [(", ".join(cell), outcome.seconds) for cell, outcome in outcomes.items()]


@pytest.mark.timeout(600)
def test_a_run_is_resumed_whatever_became_of_bath_and_guardian(
    whole: Trials, tmp_path: Path
) -> None:
    assert {(bath, how) for _, bath, how in SOME} <= {cell[1:] for cell in CELLS}
    assert len(cells_end_as(whole, SOME, tmp_path)) == len(SOME)


@pytest.mark.weekly
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    ("bath", "how"), [(bath, how) for bath in GUARDIANS for how in GUARDIANS[bath]]
)
def test_a_run_is_resumed_after_a_crash_in_any_state(
    bath: str, how: str, whole: Trials, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    took = cells_end_as(whole, [(state, bath, how) for state in STATES], tmp_path)
    assert len(took) == len(STATES) == 13
    request.node.user_properties.extend((f"s to the end, {cell}", round(s, 1)) for cell, s in took)


@pytest.mark.weekly
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    ("more", "kinds"),
    [
        ({"pty": True}, [(REACHED, "at once"), (SILENT, "trying"), (SILENT, "frozen")]),
        ({"pump": True}, [(REACHED, PUMP_ON), (SILENT, "trying"), (REACHED, "gone")]),
    ],
    ids=["serial ports", "a pump on a relay"],
)
def test_a_port_or_a_pump_that_an_old_guardian_holds_goes_to_the_next_session(
    more: dict[str, Any],
    kinds: list[tuple[str, str]],
    whole: Trials,
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:
    cells = [(state, *kind) for state in ("settling", "touch") for kind in kinds]
    took = cells_end_as(whole, cells, tmp_path, profile="eurotherm-2400", **more)
    request.node.user_properties.extend((f"s to the end, {cell}", round(s, 1)) for cell, s in took)
