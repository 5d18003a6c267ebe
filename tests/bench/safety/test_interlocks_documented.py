"""docs/safety.md says of the interlocks what the table does."""

from __future__ import annotations

import re

from bench.safety.interlocks import RULES
from instruments.bath.profile import CommsLoss
from tests.conftest import ROOT

TEXT = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")


def rows(heading: str) -> list[tuple[str, ...]]:
    """The cells of the first table behind ``heading``."""
    part = TEXT[TEXT.index(heading) :]
    table = re.search(r"(?:^\|.*\n)+", part, re.MULTILINE)
    assert table is not None
    return [
        tuple(cell.strip() for cell in line.strip("|").split("|"))
        for line in table[0].strip().split("\n")[2:]
    ]


def plain(text: str) -> str:
    return (
        text.replace("`", "").replace("it", "bath_max_c")
        if text.endswith("below it")
        else text.replace("`", "")
    )


def test_the_table_is_the_program_s() -> None:
    assert [tuple(plain(cell) for cell in row) for row in rows("## Interlocks")] == [
        (r.name, r.trips, r.resets) for r in RULES
    ]


def test_every_kind_of_lost_communication_is_explained() -> None:
    from typing import get_args

    assert {row[0].strip("`") for row in rows("## When the computer dies")} == set(
        get_args(CommsLoss)
    )


def test_it_says_plainly_what_it_is_not() -> None:
    first = " ".join(TEXT.split()[:40])
    assert "is no safety device" in first
    assert "independent over-temperature cut-out" in TEXT


def test_the_readme_says_so_too() -> None:
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    assert re.search(r"The bench is no safety (device|function)", readme)
    assert re.search(r"independent, latching over-temperature cut-out", readme)
    assert "docs/safety.md" in readme


def test_what_has_not_been_tried_on_windows_is_said() -> None:
    assert "**Windows has not been tried.**" in TEXT
