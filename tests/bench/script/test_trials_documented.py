"""docs/trials.md: its examples are read as they stand, and it names every key that a person may
write.
"""

from __future__ import annotations

import re

import pytest
from pydantic import BaseModel

from bench.script.phantom import Envelope, PhantomFile, TeatTable, layout_names
from bench.script.pixel_offsets import Offset, OffsetScript
from bench.script.planned_trials import Draw, Grid, PoseTable, Trial
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "trials.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
ELSEWHERE = {"title", "about", "source", "kind", "layout"}  # as in every script, or said in words


@pytest.mark.parametrize(
    "model", [Trial, PoseTable, Grid, Draw, PhantomFile, TeatTable, Envelope, OffsetScript, Offset]
)
def test_every_key_is_there(model: type[BaseModel]) -> None:
    missing = [
        key
        for key in model.model_fields
        if key not in ELSEWHERE
        and not re.search(rf"[`\[ ,]{key}\b", PAGE)
        and f"\n{key} =" not in PAGE
    ]
    assert missing == []


def test_no_key_is_there_twice() -> None:
    keys = re.findall(r"^\| (`.+?`) \|", PAGE, re.MULTILINE)
    assert sorted(set(keys)) == sorted(keys)


def test_every_layout_that_ships_is_there() -> None:
    assert [name for name in layout_names() if f"`{name}`" not in PAGE] == []
