"""Lines of Python by room, against `budgets.toml`: what comes to a room that is full pays with what
goes, or lives in `docs/examples`. ``python -m tests.test_budgets`` prints both.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping

from tests.conftest import ROOT

PILLARS = ("bench", "instruments", "detector")  # whose folders are rooms


def budgets() -> Mapping[str, int]:
    """The most lines of each room."""
    return dict(tomllib.loads((ROOT / "budgets.toml").read_text(encoding="utf-8"))["lines"])


def sizes() -> dict[str, int]:
    """The lines of each room; a pillar's own files, outside of its rooms, count as its room."""
    found: dict[str, int] = {}
    for path in sorted(
        path
        for top in (*PILLARS, "reports", "textfiles", "tests")
        for path in (ROOT / top).rglob("*.py")
    ):
        top, *folders, _ = path.relative_to(ROOT).parts
        room = f"{top}/{folders[0]}" if top in PILLARS and folders else top
        with path.open("rb") as file:
            found[room] = found.get(room, 0) + sum(1 for _ in file)
    return found


def test_no_room_is_larger_than_its_budget() -> None:
    most = budgets()
    over = {room: (lines, most.get(room, 0)) for room, lines in sizes().items()}
    assert not {room: both for room, both in over.items() if both[0] > both[1]}


def test_no_room_that_went_keeps_a_budget() -> None:
    assert set(budgets()) == set(sizes())


if __name__ == "__main__":
    for name, there in sizes().items():
        print(f"{name}: {there} of {budgets().get(name, 0)}")
