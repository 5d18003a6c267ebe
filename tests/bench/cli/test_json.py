"""docs/json.md is the schema of what programs read: each object has the keys that stand there."""

from __future__ import annotations

import argparse
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from bench.cli.commands import COMMANDS as COMMAND_LINE
from bench.record.state import State
from bench.results.queue import QueueEntry, QueueStatus
from bench.results.status import InstrumentStatus, LinkState, RunStatus, Safe
from bench.rig.loading import shipped
from bench.script.model import TRIALS
from bench.testing.conformance import Finding
from tests.bench.commands import Said
from tests.bench.small_run import KEPT
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "json.md").read_text(encoding="utf-8")
BATH = InstrumentStatus("bath", LinkState.ANSWERS, Safe.IN_USE)
STATUS = RunStatus("run", "Short", State.RUNNING, "running", instruments=(BATH,))


def table(head: str) -> dict[str, list[str]]:
    """The rows of the table whose head begins so: first cell, and the words of code in it all."""
    rows = PAGE[PAGE.index(f"| {head}") :].split("\n\n")[0].splitlines()[2:]
    cells = [[cell.strip() for cell in row.strip("|").split(" | ")] for row in rows]
    return {first: re.findall(r"`([^`]+)`", rest) for first, rest in cells}


def keys(head: str) -> set[str]:
    return {key for first in table(head) for key in re.findall(r"`([^`]+)`", first)}


def test_a_run_s_status_and_its_instruments_have_the_keys_of_the_page() -> None:
    shown = json.loads(json.dumps(STATUS.as_dict()))
    assert shown["schema_version"] == 1
    assert set(shown) - {"schema_version"} == keys("key | what")
    assert set(shown["instruments"][0]) == keys("key of an instrument")
    assert {one.name for one in fields(RunStatus)} <= set(shown)


def test_a_queue_has_the_keys_of_the_page() -> None:
    shown = QueueStatus("queue-1", "rig", "", (QueueEntry("a", "run", STATUS),), "").as_dict()
    assert set(shown) - {"schema_version"} == keys("key of a queue")
    assert set(shown["scripts"][0]) == set(table("key of a queue")["`scripts`"])


def test_what_a_driver_prints_is_not_among_the_json(
    said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    def talking(*_: object, **__: object) -> Iterator[Finding]:
        print("from the driver")
        yield Finding("closes twice", "passed")

    monkeypatch.setattr("bench.cli.plugin.check_driver", talking)
    written = said(0, "plugin check tank --kind bath --json")
    assert [one["check"] for one in json.loads(written.out)["checks"]] == ["closes twice"]
    assert written.err == "from the driver\n"


def test_each_word_of_a_status_is_explained() -> None:
    said = {
        word
        for words in (*table("key | what").values(), *table("key of").values())
        for word in words
    }
    assert {state.value for state in State} <= said
    assert {word.value for word in (*LinkState, *Safe)} <= said


COMMANDS = {
    "runs": "runs {runs} --json",
    "compare": "compare {run} {run} --json",
    "compare --together": "compare {run} --together --json",
    "trials": "trials --json",
    "rigs": "rigs --json",
    "detectors": "detectors --json",
    "trials show": "trials show six-situations --json",
    "plan": "plan --trials 93 --json",
}


def test_each_command_that_prints_json_is_on_the_page_and_says_the_version() -> None:
    there = {name for first in table("command") for name in re.findall(r"`([^`]+)`", first)}
    for name, (_, _, *arguments) in COMMAND_LINE.items():
        parser = argparse.ArgumentParser()
        for add in arguments:
            add(parser)
        if "--json" in parser.format_help():
            assert any(one.partition(" --")[0] == name for one in there), name
    sources = {path.stem: path.read_text("utf-8") for path in (ROOT / "bench" / "cli").glob("*.py")}
    assert [name for name, text in sources.items() if "json.dumps" in text] == ["arguments"]


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_prints_the_keys_of_the_page(command: str, tmp_path: Path, said: Said) -> None:
    run = Path(shutil.copytree(KEPT, tmp_path / "runs" / "kept"))
    words = COMMANDS[command].format(runs=run.parent, run=run)
    found: Any = json.loads(said(0, words).out)
    assert next(iter(found)) == "schema_version"
    assert set(found) - {"schema_version"} == set(table("command")[f"`{command}`"]), command
    if command == "trials":
        assert list(found["scripts"]) == shipped(TRIALS)
        assert all(len(about) > 20 for about in found["scripts"].values())
    for rows, wanted in table("rows of").items():
        name, of = re.findall(r"`([^`]+)`", rows)
        if of == command:
            assert [set(row) for row in found[name]] == [set(wanted)] * len(found[name])
