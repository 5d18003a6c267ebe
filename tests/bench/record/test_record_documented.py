"""docs/record.md says what there is: every table with its columns of time, every topic, every
schema.
"""

from __future__ import annotations

import re
import sqlite3
from contextlib import closing
from pathlib import Path

from bench.record.mcap import MESSAGES
from bench.record.schema import SCHEMA_VERSION, make_tables, tables_of

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "record.md").read_text(encoding="utf-8")


def test_every_table_and_its_times_are_told() -> None:
    told = dict(re.findall(r"^\| `(\w+)` \| .* \| (.*) \|$", PAGE, re.MULTILINE))
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as db:
        make_tables(db)
        assert set(told) == set(tables_of(db))
        for table, times in told.items():
            columns = {row[1] for row in db.execute(f"PRAGMA table_info({table})")}
            named = set(re.findall(r"`(t_s|wall_time|\w+_s)`", times)) - (
                {"captured_s"} if table == "detections" else set()
            )
            assert named <= columns
            assert not times or {"t_s", "wall_time"} & columns <= named


def test_every_schema_of_the_time_line_is_told() -> None:
    assert set(re.findall(r"`((?:foxglove|teatbench)\.\w+)`", PAGE)) == {
        kind.DESCRIPTOR.full_name for kind in MESSAGES
    }


def test_the_version_is_told() -> None:
    assert f"this bench writes {SCHEMA_VERSION} and reads 1 to {SCHEMA_VERSION}" in PAGE
