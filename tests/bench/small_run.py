"""A run of two trials: whole, and small enough to be kept and to be damaged in many ways.

``python -m tests.bench.small_run FOLDER`` wrote the folders in tests/bench/kept, each by the bench
of its schema.
"""

from __future__ import annotations

import shutil
import sqlite3
import sys
import tempfile
from contextlib import closing
from pathlib import Path

from bench.cli.main import main
from bench.files import sha256_of
from bench.record.chain import add_link
from bench.record.schema import DATABASE, FACTS, SCHEMA_VERSION, tables_of
from tests.bench import operated_runs

# what the bench of today's schema wrote so: this process's copy of it, for a reader of a run leaves
# its database's own files in the folder for a moment, where another process copies them
WRITTEN = Path(__file__).parent / "record" / "kept" / f"schema-{SCHEMA_VERSION}"
_COPIES = tempfile.TemporaryDirectory(prefix="teatbench-kept-")
KEPT = Path(shutil.copytree(WRITTEN, Path(_COPIES.name) / WRITTEN.name))
SCRIPT = (
    operated_runs.SCRIPT.replace("thesis", "fused").replace(
        "poses = [{ x_mm = 12.0, y_mm = -8.0 }, { x_mm = -15.0, z_mm = 6.0, yaw_deg = 4.0 }, {}]",
        "poses = [{ x_mm = 12.0 }]",
    )
    + """
[[trials]]
name = "again"
situation = "ideal"
layout = "table-5-1"
set_up = "Teats as in table 5.1."
poses = [{}]

[[requirements]]
kind = "error"
name = "error"
limit_mm = 5.0
rate = 0.2

[[requirements]]
kind = "time"
name = "time"
limit_s = 60.0
statistic = "max"
"""
)


def write_small_run(folder: Path) -> Path:
    """Run it, with all its files in ``folder``; gives back the run's folder."""
    arguments = operated_runs.files(
        folder, script=SCRIPT, emulation="faults = []", stage=operated_runs.STAGE
    )
    main(arguments)
    (run,) = (folder / "runs").iterdir()
    return run


def written_anew(run: Path) -> Path:
    """Make a record that was edited one that some bench could have written: digests of files and
    the chain as they would be then.
    """
    shutil.rmtree(run / "report", ignore_errors=True)
    with closing(sqlite3.connect(run / DATABASE)) as db:
        for table, name in (("frames", "path"), ("files", "name")):
            for rowid, file in db.execute(f"SELECT rowid, {name} FROM {table}").fetchall():
                db.execute(
                    f"UPDATE {table} SET sha256 = ? WHERE rowid = ?", (sha256_of(run / file), rowid)
                )
        db.execute("DELETE FROM chain")
        tables = [table for table in tables_of(db) if table not in ("chain", FACTS)]
        last = {
            table: db.execute(f"SELECT max(rowid) FROM {table}").fetchone()[0] for table in tables
        }
        add_link(
            db,
            {table: (1, end) for table, end in last.items() if end},
            [row[0] for row in db.execute("SELECT key FROM facts")],
        )
        db.commit()
    return run


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        shutil.move(write_small_run(Path(made)), sys.argv[1])
