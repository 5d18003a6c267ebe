"""Whoever opens a rig leaves it safe: deaths by ways in, asked of the wire (`deaths`)."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

if sys.platform == "win32":
    pytest.skip("sends POSIX signals, and needs a terminal", allow_module_level=True)

from tests.bench.safety.deaths import DEATHS, ENDINGS, WAYS, Elsewhere, die, emulators
from tests.bench.safety.guards import Measured

pytestmark = pytest.mark.slow

# one of each kind of death, and of each way in
FEW = [
    ("script that heats", "kill -9"),
    ("script that heats", "exception"),
    ("script that heats", "interpreter"),
    ("script that moves", "sys.exit"),
    ("stage jog", "group kill"),
    ("stage move", "TERM"),
    ("calibrate stage", "terminal closed"),
]
ALL = [
    *((name, death) for name in WAYS for death in DEATHS),
    *((name, end) for name, way in WAYS.items() if way.script for end in ENDINGS),
]


@pytest.fixture(scope="module")
def there(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Elsewhere]:
    with emulators(tmp_path_factory.mktemp("rig") / "rig") as found:
        yield found


@pytest.mark.parametrize(("name", "death"), FEW)
def test_what_heats_or_moves_is_safe_however_the_process_ends(
    name: str, death: str, there: Elsewhere, tmp_path: Path, measured: Measured
) -> None:
    seconds, _ = die(there, name, death, tmp_path / "work")
    measured(f"{death}, {name}", seconds)


@pytest.mark.weekly
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("name", "death"), [one for one in ALL if one not in FEW])
def test_the_same_of_every_way_in_and_every_death(
    name: str, death: str, there: Elsewhere, tmp_path: Path, measured: Measured
) -> None:
    seconds, _ = die(there, name, death, tmp_path / "work")
    measured(f"{death}, {name}", seconds)
