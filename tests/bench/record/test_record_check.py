"""`teatbench store check`: every kind of damage is found and named, and nothing that is no damage
is taken for it.
"""

from __future__ import annotations

import json
import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.record.chain import Head
from bench.record.check import PRINTED, Severity, check_record
from bench.record.reader import read_run
from bench.record.schema import DATABASE, tables_of
from bench.record.writer import Store
from bench.run.recordings import RECORDED
from instruments.clock import wall_time
from tests.bench.commands import Said
from tests.bench.record.test_record import PLACE, Damage, facts, flipped, sql, trial
from tests.bench.small_run import KEPT

CHECK: dict[str, Any] = {"number": 1, "teat": "1", "after_trial": "002-x-1", "t_s": 2.5, **PLACE}
CHECK |= {"carried_x_mm": 1.0, "carried_y_mm": 2.0, "carried_z_mm": 9.0}
CHECK |= {"off_mm": 6.0, "limit_mm": 1.0, "held": 0}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three trials, one skipped and a check that took a trial's truth away."""
    folder = tmp_path_factory.mktemp("store") / "run"
    store = Store.create(folder, {"script.toml": "x = 1", "rig.toml": "y = 2"})
    facts(store)
    store.event(0.0, "state", "preparing", wall_time())
    for number in (1, 2, 3):
        store.finished(trial(store, number))
    skipped = {"trial": "004-x-1", "number": 4, "name": "x", "situation": "s", "repeat": 1}
    store.skipped({**skipped, "t_s": 4.0, "reason": "no teat"})
    store.checked([CHECK], ["002-x-1"], "the carried end is 6 mm off")
    store.fact("ending", "finished")
    store.event(5.0, "end", "finished", wall_time())
    store.close()
    return folder


@pytest.fixture
def run(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "run"))


def damages(run: Path, digest: str | None = None) -> list[str]:
    found = check_record(run, digest).findings
    return [finding.text for finding in found if finding.severity is Severity.DAMAGE]


def rotten(name: Path | str, at: int) -> Damage:
    return lambda run: (run / name).write_bytes(flipped((run / name).read_bytes(), at, 0x10))


FRAME = Path("frames") / "002-x-1" / "left.png"


def test_a_run_as_it_was_written_is_whole(run: Path) -> None:
    checked = check_record(run)
    assert checked.whole
    assert checked.findings == ()
    counts = {"trials": 3, "frames": 3, "events": 2, "bath": 3, "files": 2}
    counts["links"] = checked.head.number
    assert checked.counts == counts
    assert checked.head == read_run(run).head


DAMAGE: dict[str, tuple[Damage, str]] = {
    "a truth moved": (sql("UPDATE truth SET x_mm = 1.5 WHERE trial = '002-x-1'"), r"table truth, row 2 is not as written .*trial 002-x-1"),
    "an event added": (sql("INSERT INTO events VALUES (3, 1, 6.0, 'note', 'all good', '2020')"), "table events, row 3 is in no link .* added later"),
    "a trial removed": (sql(*(f"DELETE FROM {t} WHERE trial = '003-x-1'" for t in ("found", "detections", "truth", "frames")), "DELETE FROM trials WHERE number = 3"), "table trials, row 3 is not as written"),
    "a truth given back": (sql("DELETE FROM invalidated"), "table invalidated, row 1 is not as written"),
    "a fact changed": (sql("UPDATE facts SET value = '\"real\"' WHERE key = 'kind'"), "fact 'kind' is not as written"),
    "a fact added": (sql("INSERT INTO facts VALUES ('wall_x', '1', NULL)"), "fact 'wall_x' is in no link"),
    "a fact removed": (sql("DELETE FROM facts WHERE key = 'ending'"), "fact 'ending' is missing"),
    "a link changed": (sql("UPDATE chain SET digest = wall_digest WHERE number = 4"), "link 4 of the chain doesn't follow"),
    "a link removed": (sql("DELETE FROM chain WHERE number = 5"), "link 6 of the chain doesn't follow"),
    "a link that is no JSON": (sql("UPDATE chain SET covers = '{' WHERE number = 4"), "link 4 of the chain can't be read"),
    "a row without its trial": (sql("UPDATE frames SET trial = 'gone' WHERE rowid = 1"), "table frames, row 1: what it refers to in trials"),
    "a rotten frame": (rotten(FRAME, 20), r"002-x-1/left.png is not as it was written"),
    "a lost frame": (lambda run: (run / FRAME).unlink(), r"002-x-1/left.png can't be read"),
    "a frame that came later": (lambda run: (run / FRAME.with_name("right.png")).write_bytes(b"x"), "right.png is in no row of the record"),
    "another script": (lambda run: (run / "script.toml").write_text("x = 2", encoding="utf-8"), "script.toml is not as it was written"),
    "a file without a name": (sql("UPDATE files SET name = NULL WHERE rowid = 1"), "has no name, but None in its place"),
    "a fact without a key": (sql("INSERT INTO facts VALUES (NULL, '1', NULL)"), "fact None is in no link"),
    "a rotten database": (rotten(DATABASE, 3 * 4096 + 5), r"run\.sqlite"),
}  # fmt: skip


@pytest.mark.parametrize("what", DAMAGE)
def test_damage_is_found_and_named(run: Path, what: str, said: Said) -> None:
    damage, note = DAMAGE[what]
    damage(run)
    found = damages(run)
    assert any(re.search(note, text) for text in found), found
    assert "The record is NOT as it was written." in said(1, "store check {}", run).out


@pytest.mark.slow
def test_no_cell_of_any_table_changes_unseen(run: Path) -> None:
    with closing(sqlite3.connect(run / DATABASE, isolation_level=None)) as db:
        db.execute("PRAGMA synchronous = OFF")
        for table in tables_of(db):
            for _, column, *_ in db.execute(f"PRAGMA table_info({table})").fetchall():
                rows = db.execute(
                    f"SELECT rowid, {column} FROM {table} ORDER BY rowid LIMIT 1"
                ).fetchall()
                for rowid, value in rows:
                    change = f"UPDATE {table} SET {column} = ? WHERE rowid = ?"
                    other = "other" if isinstance(value, str | None) else value + 1_000_000
                    db.execute(change, (other, rowid))
                    assert damages(run), f"{table}.{column}"
                    at = (
                        rowid + 1_000_000
                        if column in ("number", "rowid") and is_rowid(db, table)
                        else rowid
                    )
                    db.execute(change, (value, at))
                    assert not damages(run), f"{table}.{column} was restored"


def is_rowid(db: sqlite3.Connection, table: str) -> bool:
    """Whether the table's column ``number`` is another name for its rowid."""
    columns = db.execute(f"PRAGMA table_info({table})").fetchall()
    return (
        any(name == "number" and kind == "INTEGER" and key for _, name, kind, _, _, key in columns)
        and sum(bool(c[5]) for c in columns) == 1
    )


def test_what_a_dead_bench_leaves_is_reported_but_no_damage(run: Path, said: Said) -> None:
    store = Store(run)
    store.frames("004-x-1", {"left": np.zeros((4, 5), np.uint8)}, {})
    (run / "frames" / "004-x-1" / "right.png.part").write_bytes(b"half a fra")
    store.close()
    note = said(0, "store check {}", run).out
    assert "note: frames/004-x-1/left.png belongs to no finished trial" in note
    assert "note: frames/004-x-1/right.png.part belongs to no finished trial" in note
    assert "The record is as it was written." in note


def test_a_chain_made_anew_or_cut_off_differs_from_what_the_report_names(run: Path) -> None:
    """Who can write the file can make a chain of his own, but not the digest that was printed."""
    head = check_record(run).head
    named = {"links": head.number, "digest": head.digest, "wall_digest": head.wall_digest}
    (run / PRINTED).parent.mkdir()
    (run / PRINTED).write_text(json.dumps({"chain": named}), encoding="utf-8")
    assert damages(run, digest=head.digest) == damages(run, digest=head.wall_digest.upper()) == []
    last = f"DELETE FROM chain WHERE number = {head.number}"
    sql("DELETE FROM events WHERE number = 2", last)(run)
    (found,) = damages(run)
    assert found.startswith(f"the chain doesn't pass through the digest of {PRINTED.as_posix()}:")
    (run / PRINTED).unlink()
    assert damages(run) == []
    assert "doesn't pass through" in damages(run, digest=head.wall_digest)[0]


def test_a_run_that_went_on_after_its_report_still_passes_through_its_digest(run: Path) -> None:
    head = check_record(run).head
    store = Store(run)
    store.event(0.1, "state", "resumed", wall_time())
    store.close()
    assert damages(run, digest=head.wall_digest) == []
    assert [event["session"] for event in read_run(run).events] == [1, 1, 2]


def test_the_digest_without_real_time_repeats_and_the_other_does_not(tmp_path: Path) -> None:
    heads = []
    for name, command in (("one", "teatbench run"), ("two", "teatbench run --out other")):
        store = Store.create(tmp_path / name, {"script.toml": "x = 1"})
        facts(store)
        store.fact("command", command)
        store.fact(RECORDED, str(tmp_path / f"recorded-{name}"))
        store.fact("wall_started", wall_time().isoformat())
        store.finished(trial(store, 1))
        store.close()
        heads.append(check_record(store.folder).head)
    assert heads[0].digest == heads[1].digest
    assert heads[0].wall_digest != heads[1].wall_digest


def test_a_run_that_was_kept_still_checks(tmp_path: Path) -> None:
    """The chain's format: a change of it would call every older record an altered one."""
    checked = check_record(Path(shutil.copytree(KEPT, tmp_path / "kept")))
    assert checked.whole
    assert checked.head == Head(
        29,
        "fcbdc54f3e59d2f1ae6cb59e36e6ddd03af1b1f037a234c1fc960abbbb7313ed",
        "42d060533a0cafcf405cf2b128a7abc43afb885ef698c5cd9faea4b91a2641d6",
    )
    counts = {"trials": 2, "frames": 8, "events": 12, "bath": 24, "files": 3, "links": 29}
    assert checked.counts == counts


def test_a_folder_that_is_no_run_is_wrong_use(tmp_path: Path, said: Said) -> None:
    assert "is no run" in said(2, "store check {}", tmp_path).err
