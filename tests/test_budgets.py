"""Lines of Python by room, against `budgets.toml`: what comes to a room that is full pays with what
goes, or lives in `docs/examples`. ``python -m tests.test_budgets > budgets.toml`` sets each to the
present size, rounded up.
"""

from __future__ import annotations

import json
import tomllib
from collections import Counter
from collections.abc import Mapping

from tests.conftest import ROOT

PILLARS = ("bench", "instruments", "detector")  # whose folders are rooms
HEAD = """# The most lines of Python that each room may have; tests/test_budgets.py checks it.
# What comes to a room that is full pays with what goes, or lives in docs/examples.
[lines]"""


def budgets() -> Mapping[str, int]:
    """The most lines of each room."""
    return dict(tomllib.loads((ROOT / "budgets.toml").read_text(encoding="utf-8"))["lines"])


def sizes() -> Counter[str]:
    """The lines of each room; a pillar's own files, outside of its rooms, count as its room."""
    found: Counter[str] = Counter()
    for top in (*PILLARS, "reports", "textfiles", "tests"):
        for path in sorted((ROOT / top).rglob("*.py")):
            _, *folders, _ = path.relative_to(ROOT).parts
            room = f"{top}/{folders[0]}" if top in PILLARS and folders else top
            found[room] += path.read_bytes().count(b"\n")
    return found


def test_no_room_is_larger_than_its_budget() -> None:
    over = sizes() - Counter(budgets())
    assert not over, f"lines beyond budgets.toml: {dict(over)}"


def test_no_room_that_went_keeps_a_budget() -> None:
    assert set(budgets()) <= set(sizes())


if __name__ == "__main__":
    print(HEAD)
    for name, lines in sorted(sizes().items()):
        print(f"{json.dumps(name)} = {-(-lines // 100) * 100}")
