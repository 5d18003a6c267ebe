"""Records of another schema are refused by name; docs/record.md names all tables and messages."""

from __future__ import annotations

import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from bench.config import ConfigError
from bench.record.check import check_record
from bench.record.mcap import MESSAGES
from bench.record.reader import read_run
from bench.record.schema import DATABASE, SCHEMA_VERSION, make_tables, tables_of
from bench.record.writer import Store
from tests.bench.commands import Said
from tests.bench.small_run import KEPT
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "record.md").read_text(encoding="utf-8")


def changed(folder: Path, sql: str) -> Path:
    """A kept run, changed."""
    run = Path(shutil.copytree(KEPT, folder / "run"))
    with closing(sqlite3.connect(run / DATABASE)) as db:
        db.executescript(sql)
    return run


@pytest.mark.parametrize(
    ("version", "note"),
    [
        (SCHEMA_VERSION + 1, "A newer bench wrote it"),
        (SCHEMA_VERSION - 1, "An older bench wrote it"),
        (0, "No bench has finished making it"),
    ],
)
def test_tables_of_another_schema_are_refused(tmp_path: Path, version: int, note: str) -> None:
    run = changed(tmp_path, f"PRAGMA user_version = {version};")
    why = f"schema {version}; this bench has {SCHEMA_VERSION}. {note}"
    for use in (read_run, check_record, Store):
        with pytest.raises(ConfigError, match=why):
            use(run)


def test_a_record_with_nothing_to_check_it_by_is_not_called_unaltered(
    tmp_path: Path, said: Said
) -> None:
    with closing(sqlite3.connect(KEPT / DATABASE)) as db:
        emptied = "".join(f"DELETE FROM {table};" for table in reversed(tables_of(db)))
    run = changed(tmp_path, emptied)
    shutil.rmtree(run / "frames")
    seen = said(4, "store check {}", run)
    assert "as it was written." not in seen.out
    assert "0 frames" in seen.out
    assert "not checked: whether the record's rows are as they were written (0 links" in seen.err


def test_every_table_and_its_times_are_reported() -> None:
    note = dict(re.findall(r"^\| `(\w+)` \| .* \| (.*) \|$", PAGE, re.MULTILINE))
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as db:
        make_tables(db)
        named = {name: db.execute(f"PRAGMA table_info({name})") for name in tables_of(db)}
        there = {name: {row[1] for row in rows} for name, rows in named.items()}
    assert set(note) == set(there)
    for table, times in note.items():
        said = set(re.findall(r"`(t_s|wall_time|\w+_s)`", times))
        said -= {"captured_s"} if table == "detections" else set()
        assert said <= there[table]
        assert not times or {"t_s", "wall_time"} & there[table] <= said


def test_every_schema_of_the_time_line_is_reported() -> None:
    assert set(re.findall(r"`((?:foxglove|teatbench)\.\w+)`", PAGE)) == {
        kind.DESCRIPTOR.full_name for kind in MESSAGES
    }


def test_the_version_is_reported() -> None:
    assert f"this bench writes and reads {SCHEMA_VERSION}" in PAGE
