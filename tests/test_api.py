"""What is promised to Python programs: names and signatures as they were, the page as it runs, and
all of it by one import.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import re
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

import bench
from bench.record.schema import make_tables
from tests.conftest import ROOT

PAGE = ROOT / "docs" / "api.md"
KEPT = Path(__file__).parent / "data" / "promised.json"
MODULES = ("bench", "detector", "instruments", "bench.testing", "bench.testing.conformance")
ROWS = ("TrialRow", "TouchRow", "TruthOfTeat", "DetectionRow", "FoundRow", "BathRow", "EventRow")
TYPES = {"TEXT": "str", "REAL": "float", "INTEGER": "int"}


def on_page() -> dict[str, set[str]]:
    """The names in the page's table, by the module that has them."""
    text = PAGE.read_text(encoding="utf-8").split("## What is promised")[1]
    found: dict[str, set[str]] = {}
    for module, names in re.findall(r"^\| `([\w.]+)`[^|]*\| (.*) \|$", text, re.MULTILINE):
        found.setdefault(module, set()).update(re.findall(r"`(\w+)`", names))
    return found


def shape(thing: Any) -> Any:
    """Parameters of a function, fields and public methods of a class."""
    if inspect.isfunction(thing):
        return parameters(thing)
    if not inspect.isclass(thing):
        return type(thing).__name__
    found: dict[str, Any] = {}
    if dataclasses.is_dataclass(thing):
        found["fields"] = [field.name for field in dataclasses.fields(thing)]
    for name, member in vars(thing).items():
        if name.startswith("_"):
            continue
        if inspect.isfunction(member):
            found[name] = parameters(member)
        elif isinstance(member, property):
            found[name] = "property"
    return found


def parameters(function: Any) -> list[str]:
    """``name``, ``name=`` with a default, ``*name`` by keyword alone."""
    return [
        "*" * (one.kind is one.KEYWORD_ONLY) + one.name + "=" * (one.default is not one.empty)
        for one in inspect.signature(function).parameters.values()
    ]


def promised() -> dict[str, Any]:
    return {
        module: {
            name: shape(getattr(importlib.import_module(module), name)) for name in sorted(names)
        }
        for module, names in on_page().items()
    }


def test_names_and_signatures_are_as_they_were() -> None:
    """``python -m tests.test_api`` writes them down anew, for a change that is meant."""
    assert promised() == json.loads(KEPT.read_text(encoding="utf-8"))


@pytest.mark.parametrize("module", MODULES)
def test_what_a_package_exports_is_what_the_page_promises(module: str) -> None:
    there = importlib.import_module(module)
    if hasattr(there, "__all__"):
        assert {*there.__all__} - {"__version__"} == on_page()[module]
    for name in on_page()[module]:
        assert getattr(there, name).__doc__, f"{module}.{name} says nothing of itself"
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = there.nothing


def test_an_import_loads_nothing_heavy() -> None:
    code = (
        "import bench, sys; print(sorted({'numpy', 'cv2', 'pydantic', 'typing'} & {*sys.modules}))"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert said.stdout == "[]\n"


@pytest.mark.parametrize("name", ROWS)
def test_rows_are_the_tables_columns_with_their_types(name: str) -> None:
    row = getattr(bench, name)
    with closing(sqlite3.connect(":memory:")) as db:
        make_tables(db)
        columns = db.execute(f"PRAGMA table_info({row.table})").fetchall()
    by_column = {
        column: TYPES[kind] + ("" if needed or key else " | None")
        for _, column, kind, needed, _, key in columns
    }
    assert {field.name: field.type for field in dataclasses.fields(row)} == by_column


@pytest.mark.slow
def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text(encoding="utf-8")
    [script] = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    Path("my-script.toml").write_text(script, encoding="utf-8")
    code = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names: dict[str, Any] = {}
    for block in code:
        exec(compile(block, str(PAGE), "exec"), names)
    assert names["score"].success
    assert names["found"].verdict == "met"
    assert len(names["touches"]) >= len(names["run"].trials)
    assert names["result"].rates[0].scenes == 4
    assert {line for block in code for line in block.splitlines() if "import" in line} == {
        "import bench"
    }


if __name__ == "__main__":
    KEPT.write_text(json.dumps(promised(), indent=1) + "\n", encoding="utf-8")
