"""What guardians wrote in a run's folder, read by session."""

from __future__ import annotations

import json
import shutil
from contextlib import closing
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from bench.config import ConfigError
from bench.record.check import Severity, check_record
from bench.record.reader import RunRecord, read_run
from bench.record.state import State
from bench.record.writer import Store
from bench.report.bath import _care_parts
from bench.results.headline import guardian_text, stopped_why
from bench.run.resume import keep_guardians
from instruments.clock import wall_time
from tests.bench.small_run import KEPT


def acted(minutes: float = 0.0, **more: Any) -> dict[str, Any]:
    """What a guardian writes; ``minutes`` ago."""
    when = (wall_time() - timedelta(minutes=minutes)).isoformat(timespec="milliseconds")
    record = {"cause": "died", "why": "its end of the pipe closed without a word", "guardian": 7}
    record |= {"wall_last_sign": when, "wall_noticed": when, "wall_safe": when, "bath": "COM3"}
    return record | {"standby": True, "tries": 1, "seconds": 0.01, "error": ""} | more


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return Path(shutil.copytree(KEPT, tmp_path / "run"))


def write(run: Path, name: str, record: dict[str, Any]) -> None:
    (run / name).write_text(json.dumps(record), encoding="utf-8")


def goes_on(run: Path) -> None:
    """A further session, as resume begins it."""
    with closing(Store(run)) as store:
        keep_guardians(store)


def paragraphs(record: RunRecord) -> str:
    return repr(list(_care_parts(record)))


def test_each_session_has_its_own_and_the_last_one_s_says_how_the_run_stands(run: Path) -> None:
    write(run, "guardian-1.json", first := acted())
    assert read_run(run).guardian == first
    goes_on(run)
    record = read_run(run)
    assert (record.guardians, record.guardian) == ({1: first}, None), "this session needed none"
    write(run, "guardian-2.json", second := acted(cause="hung", why="moving"))
    record = read_run(run)
    assert record.guardians == {1: first, 2: second}
    assert record.guardian == second
    assert f"Session 1: {guardian_text(first)}" in paragraphs(record)
    assert f"Session 2: {guardian_text(second)}" in paragraphs(record)


def test_what_the_next_session_found_is_in_the_chain(run: Path) -> None:
    write(run, "guardian-1.json", acted())
    note = (
        "guardian-1.json is in no link of the chain: its guardian wrote it after the bench had died"
    )
    found = [(one.severity, one.text) for one in check_record(run).findings]
    assert (Severity.NOTE, note) in found
    goes_on(run)
    checked = check_record(run)
    assert checked.whole
    assert note not in [one.text for one in checked.findings]
    write(run, "guardian-1.json", acted(tries=2))
    damage = [one.text for one in check_record(run).findings if one.severity is Severity.DAMAGE]
    assert damage == ["guardian-1.json is not as the next session found it"]
    (run / "guardian-1.json").unlink()
    damage = [one.text for one in check_record(run).findings if one.severity is Severity.DAMAGE]
    assert damage == ["guardian-1.json can't be read: No such file or directory"]
    assert read_run(run).guardians[1]["tries"] == 1, "the record has it still"


def test_one_that_is_no_record_is_named(run: Path) -> None:
    (run / (name := "guardian-1.json")).write_text("{", encoding="utf-8")
    with pytest.raises(ConfigError, match=f"{name} can't be read"):
        read_run(run)
    assert not check_record(run).whole


def test_a_bath_that_the_guardian_did_not_reach_either_is_no_second_paragraph(run: Path) -> None:
    """What to do at it stands in a line of its own, first."""
    gave_up = acted(cause="gave up", standby=False, tries=7, error="the link broke. Check it.")
    write(run, "guardian-1.json", gave_up)
    why = stopped_why(read_run(run), State.TRIPPED, "0 of 3 trials")
    assert why.endswith(" The guardian did not reach the bath either, in 7 tries.")
    assert "SWITCH OFF" not in why
    assert "THE BATH in 7 tries (the link broke. Check it)." in guardian_text(gave_up)
