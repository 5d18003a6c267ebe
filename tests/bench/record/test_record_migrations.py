"""Runs of older benches: read by migration in memory, left on the disk as they are, and never gone
on with. docs/record.md names today's tables and messages.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from bench.config import ConfigError
from bench.record.check import check_run
from bench.record.mcap import MESSAGES
from bench.record.reader import read_run
from bench.record.schema import DATABASE, SCHEMA_VERSION, make_tables, migrate, tables_of
from bench.record.writer import Store
from tests.bench.commands import Said
from tests.bench.old_schemas import ROWS_1, ROWS_2, VERSION_1, VERSION_2

OLD = {1: VERSION_1 + ROWS_1, 2: VERSION_2 + ROWS_2}


def old_run(folder: Path, version: int, text: str) -> Path:
    folder.mkdir()
    with closing(sqlite3.connect(folder / DATABASE)) as db:
        db.executescript(f"{text} PRAGMA user_version = {version};")
    return folder


def kept(folder: Path) -> Path:
    """A run as the bench of schema 3 wrote it."""
    return Path(shutil.copytree(Path(__file__).parent / "kept" / "schema-3", folder / "schema-3"))


@pytest.fixture(params=OLD)
def run(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return old_run(tmp_path / "run", request.param, OLD[request.param])


def test_a_run_of_every_older_bench_is_read_and_left_as_it_is(run: Path) -> None:
    before = hashlib.sha256((run / DATABASE).read_bytes()).hexdigest()
    record = read_run(run)
    assert record.ending == "finished"
    assert [one.id for one in record.trials] == ["001-x-1", "002-y-1"]
    first = record.trials[0]
    assert first.found[0]["x_mm"] == 1.5
    assert first.touches[0]["refused"] is None
    assert record.bath.tolist() == [[1.0, 32.5, 4.0], [2.0, 33.0, 3.0]]
    assert [event["session"] for event in record.events] == [1, 1]
    assert record.head is not None
    assert record.head.number == 0, "an older bench made no chain"
    assert hashlib.sha256((run / DATABASE).read_bytes()).hexdigest() == before
    assert [path.name for path in run.iterdir()] == [DATABASE]


def test_what_version_1_did_not_know_has_its_default(tmp_path: Path) -> None:
    first = read_run(old_run(tmp_path / "run", 1, OLD[1])).trials[0]
    assert (first.invalid, first.how, first.head["stage_mm"]) == (None, None, None)
    assert (first.detections[0]["outcome"], first.detections[0]["cold"]) == ("answered", 0)


def test_what_version_2_knew_is_kept(tmp_path: Path) -> None:
    record = read_run(old_run(tmp_path / "run", 2, OLD[2]))
    assert [one.invalid for one in record.trials] == [None, "the carried end was off"]
    assert [one.id for one in record.counted] == ["001-x-1"]
    assert record.trials[0].how == "touched"
    assert record.trials[0].detections[0]["outcome"] == "timeout"
    assert record.skipped[0]["reason"] == "no teat to touch"
    assert record.checks[0]["off_mm"] == 6.0


def columns(db: sqlite3.Connection) -> dict[str, set[str]]:
    """By table."""
    named = {name: db.execute(f"PRAGMA table_info({name})") for name in tables_of(db)}
    return {name: {row[1] for row in rows} for name, rows in named.items()}


def test_every_migration_ends_in_the_tables_of_today(tmp_path: Path) -> None:
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as today:
        make_tables(today)
        olds = [old_run(tmp_path / str(version), version, text) for version, text in OLD.items()]
        for folder in (*olds, kept(tmp_path)):
            with closing(sqlite3.connect(folder / DATABASE, isolation_level=None)) as old:
                migrate(old)
                assert columns(old) == columns(today)
                assert old.execute("PRAGMA foreign_key_check").fetchall() == []


def test_an_old_run_is_checked_and_exported_but_not_gone_on_with(
    run: Path, tmp_path: Path, said: Said
) -> None:
    assert any("it has no chain" in finding.text for finding in check_run(run).findings)
    export = "store export {} --format csv --out {}"
    said(2, export, run, tmp_path / "csv")  # its pictures aren't there
    said(0, f"{export} --despite-damage", run, tmp_path / "csv")
    assert "001-x-1" in (tmp_path / "csv" / "trials.csv").read_text(encoding="utf-8")
    why = "of an older bench: it can be read and reported, but not gone on with"
    with pytest.raises(ConfigError, match=why):
        Store(run)


def test_a_record_with_nothing_to_check_it_by_is_not_called_unaltered(
    run: Path, said: Said
) -> None:
    with closing(sqlite3.connect(run / DATABASE)) as db:
        db.execute("DELETE FROM frames")  # their pictures aren't there
        db.commit()
    seen = said(4, "store check {}", run)
    assert "as it was written." not in seen.out
    assert "0 frames" in seen.out
    assert "not checked: whether the record's rows are as they were written (0 links" in seen.err


@pytest.mark.slow
def test_a_run_of_schema_3_is_whole_reported_and_exported(tmp_path: Path, said: Said) -> None:
    run = kept(tmp_path)
    detections = [row for trial in read_run(run).trials for row in trial.detections]
    assert [row["wall_cpu_s"] for row in detections] == [None, None]
    said(0, "store check {}", run)
    said(4, "report {} --no-pdf", run)
    said(0, "store export {} --format parquet --out {}", run, tmp_path / "parquet")
    said(0, "store check {}", run)  # the report names the chain as it is
    with pytest.raises(ConfigError, match="of an older bench"):
        Store(run)


@pytest.mark.parametrize(
    ("version", "note"),
    [(SCHEMA_VERSION + 1, "A newer bench wrote it"), (0, "No bench has finished making it")],
)
def test_tables_that_this_bench_does_not_know_are_refused(
    tmp_path: Path, version: int, note: str
) -> None:
    run = old_run(tmp_path / "run", version, VERSION_2)
    with pytest.raises(ConfigError, match=note):
        read_run(run)
    with pytest.raises(ConfigError, match=f"schema {version}"):
        Store(run)


PAGE = (Path(__file__).resolve().parents[3] / "docs" / "record.md").read_text(encoding="utf-8")


def test_every_table_and_its_times_are_reported() -> None:
    note = dict(re.findall(r"^\| `(\w+)` \| .* \| (.*) \|$", PAGE, re.MULTILINE))
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as db:
        make_tables(db)
        there = columns(db)
    assert set(note) == set(there)
    for table, times in note.items():
        named = set(re.findall(r"`(t_s|wall_time|\w+_s)`", times))
        named -= {"captured_s"} if table == "detections" else set()
        assert named <= there[table]
        assert not times or {"t_s", "wall_time"} & there[table] <= named


def test_every_schema_of_the_time_line_is_reported() -> None:
    assert set(re.findall(r"`((?:foxglove|teatbench)\.\w+)`", PAGE)) == {
        kind.DESCRIPTOR.full_name for kind in MESSAGES
    }


def test_the_version_is_reported() -> None:
    assert f"this bench writes {SCHEMA_VERSION} and reads 1 to {SCHEMA_VERSION}" in PAGE
