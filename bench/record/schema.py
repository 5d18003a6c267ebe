"""What a run's database holds.

Columns that begin with ``wall`` hold real time; all others repeat with the seed. ``t_s`` and all
``…_s`` are seconds of the bench's monotonic clock, which starts anew with each session: a run that
was resumed has several. Rows are only ever added, but for ``facts``, where the last value of a key
holds. A version's text never changes once a bench has written it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from typing import Any

Row = Mapping[str, Any]
SCHEMA_VERSION = 5
DATABASE, SCRIPT, RULES = "run.sqlite", "script.toml", "rules.toml"
GUARDIAN = "guardian-{}"  # .json of a session: its guardian had to act; .log: what that one said
GUARDIAN_FILES = "guardian*.json"
GUARDIAN_FACT = "wall {}"  # by the file's name, once a session follows

OF_A_TRIAL = ("frames", "touches", "truth", "detections", "found", "scores")
FACTS = "facts"  # the one table whose rows are written over

SCHEMA = """
CREATE TABLE sessions (number INTEGER PRIMARY KEY, bench TEXT NOT NULL, wall_time TEXT NOT NULL);
CREATE TABLE files (name TEXT PRIMARY KEY, sha256 TEXT NOT NULL);
CREATE TABLE facts (key TEXT PRIMARY KEY, value TEXT NOT NULL, wall_time TEXT);
CREATE TABLE events (number INTEGER PRIMARY KEY, session INTEGER NOT NULL REFERENCES sessions, t_s REAL, kind TEXT NOT NULL,
  text TEXT NOT NULL, wall_time TEXT NOT NULL);
CREATE TABLE bath (session INTEGER NOT NULL REFERENCES sessions, t_s REAL NOT NULL, temp_c REAL NOT NULL, external_c REAL,
  power_percent REAL, state TEXT NOT NULL, wall_time TEXT, PRIMARY KEY (session, t_s));
CREATE TABLE trials (id TEXT PRIMARY KEY, session INTEGER NOT NULL REFERENCES sessions, number INTEGER NOT NULL, name TEXT NOT NULL,
  situation TEXT NOT NULL, repeat INTEGER NOT NULL, started_s REAL, ended_s REAL, captured_s REAL, bath_c REAL, bath_state TEXT,
  note TEXT, stage_mm TEXT, wall_time TEXT NOT NULL);
CREATE TABLE invalidated (trial TEXT PRIMARY KEY REFERENCES trials, reason TEXT NOT NULL, wall_time TEXT);
CREATE TABLE skipped (trial TEXT PRIMARY KEY, session INTEGER NOT NULL REFERENCES sessions, number INTEGER NOT NULL, name TEXT NOT NULL,
  situation TEXT NOT NULL, repeat INTEGER NOT NULL, t_s REAL NOT NULL, reason TEXT NOT NULL, wall_time TEXT);
CREATE TABLE frames (trial TEXT NOT NULL REFERENCES trials, camera TEXT NOT NULL, path TEXT NOT NULL, sha256 TEXT NOT NULL, exposed_s REAL,
  wall_time TEXT, PRIMARY KEY (trial, camera));
CREATE TABLE touches (trial TEXT NOT NULL REFERENCES trials, teat TEXT NOT NULL, touch INTEGER NOT NULL, t_s REAL NOT NULL,
  x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL, spread_mm REAL NOT NULL, packets INTEGER NOT NULL, counts TEXT NOT NULL,
  refused TEXT, wall_time TEXT, PRIMARY KEY (trial, teat, touch));
CREATE TABLE truth (trial TEXT NOT NULL REFERENCES trials, teat TEXT NOT NULL,
  x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL, u_mm REAL, visible INTEGER NOT NULL, exact_mm TEXT,
  how TEXT, budget TEXT, covariance_mm2 TEXT, cameras TEXT, PRIMARY KEY (trial, teat));
CREATE TABLE checks (number INTEGER NOT NULL, teat TEXT NOT NULL, after_trial TEXT NOT NULL REFERENCES trials, t_s REAL NOT NULL,
  x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL, carried_x_mm REAL NOT NULL, carried_y_mm REAL NOT NULL,
  carried_z_mm REAL NOT NULL, off_mm REAL NOT NULL, limit_mm REAL NOT NULL, held INTEGER NOT NULL, wall_time TEXT,
  PRIMARY KEY (number, teat));
CREATE TABLE detections (trial TEXT NOT NULL REFERENCES trials, detector TEXT NOT NULL, hidden INTEGER NOT NULL, reason TEXT,
  outcome TEXT NOT NULL DEFAULT 'answered', cold INTEGER NOT NULL DEFAULT 0, trace TEXT NOT NULL,
  wall_seconds REAL NOT NULL, wall_start_up_s REAL, wall_stderr TEXT, wall_cpu_s REAL, wall_load REAL, PRIMARY KEY (trial, detector));
CREATE TABLE found (trial TEXT NOT NULL, detector TEXT NOT NULL, number INTEGER NOT NULL, x_mm REAL NOT NULL, y_mm REAL NOT NULL,
  z_mm REAL NOT NULL, covariance_mm2 TEXT, left_px TEXT, right_px TEXT, PRIMARY KEY (trial, detector, number),
  FOREIGN KEY (trial, detector) REFERENCES detections);
CREATE TABLE scores (trial TEXT NOT NULL, detector TEXT NOT NULL, score TEXT NOT NULL, wall_score TEXT NOT NULL,
  PRIMARY KEY (trial, detector), FOREIGN KEY (trial, detector) REFERENCES detections);
CREATE TABLE chain (number INTEGER PRIMARY KEY, covers TEXT NOT NULL, digest TEXT NOT NULL, wall_covers TEXT NOT NULL,
  wall_digest TEXT NOT NULL);
"""


def version_of(db: sqlite3.Connection) -> int:
    """The schema that ``db`` was written with; 0 for none."""
    return int(db.execute("PRAGMA user_version").fetchone()[0])


def tables_of(db: sqlite3.Connection) -> tuple[str, ...]:
    """All tables of ``db`` in the order in which they were made."""
    return tuple(
        row[0]
        for row in db.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY rowid")
    )


def make_tables(db: sqlite3.Connection) -> None:
    """Today's tables in an empty database, all or none."""
    db.executescript(f"BEGIN; {SCHEMA} PRAGMA user_version = {SCHEMA_VERSION}; COMMIT;")
