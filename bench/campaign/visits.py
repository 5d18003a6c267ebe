"""Cows' visits in one SQLite file that is only added to: what was confirmed, by teat, for the
context that a detector may be given (`detector.history`).
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import Literal

import numpy as np

from bench.config import ConfigError
from detector.geometry import Array
from detector.protocol import Context, Visit

CONFIRMED = ("attached", "touched")
MOST_VISITS = 60  # of a context: some weeks
SCHEMA = """
CREATE TABLE IF NOT EXISTS ends (
    cow TEXT NOT NULL,
    at TEXT NOT NULL,
    hours_since_milking REAL NOT NULL CHECK (hours_since_milking >= 0),
    days_in_milk REAL,
    teat INTEGER NOT NULL CHECK (teat >= 1),
    x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL,
    covariance_mm2 TEXT NOT NULL,
    how TEXT NOT NULL CHECK (how IN ('attached', 'touched')),
    PRIMARY KEY (cow, at, teat)
);
CREATE TRIGGER IF NOT EXISTS no_update BEFORE UPDATE ON ends
BEGIN SELECT RAISE(ABORT, 'visits are only added to'); END;
CREATE TRIGGER IF NOT EXISTS no_delete BEFORE DELETE ON ends
BEGIN SELECT RAISE(ABORT, 'visits are only added to'); END;
"""


@dataclass(frozen=True, slots=True, eq=False)
class Confirmed:
    """An end (3,) mm, world, with its covariance (3, 3), and how it was confirmed. What was only
    detected or predicted is refused with ValueError: errors would feed themselves.
    """

    end_mm: Array
    covariance_mm2: Array
    how: Literal["attached", "touched"]

    def __post_init__(self) -> None:
        if self.how not in CONFIRMED:
            raise ValueError(
                f"only confirmed ends are kept ({' or '.join(CONFIRMED)}), not {self.how!r} ones"
            )
        if not np.isfinite(self.end_mm).all() or np.linalg.eigvalsh(self.covariance_mm2)[0] <= 0:
            raise ValueError("a confirmed end needs three numbers, and a covariance that is one")


class VisitStore:
    """The file at ``path``, made where it is missing. Raises ConfigError for another file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with closing(self._open()) as db:
                db.executescript(SCHEMA)
        except sqlite3.Error as error:
            raise ConfigError.plain(f"{path}: no file of visits: {error}") from error

    def _open(self) -> sqlite3.Connection:
        return sqlite3.connect(self._path, timeout=30.0)

    def add(
        self,
        cow: str,
        at: datetime,
        hours_since_milking: float,
        ends: Mapping[int, Confirmed],
        days_in_milk: float | None = None,
    ) -> None:
        """Add a visit's confirmed ends by teat. Raises ValueError for a known visit, or no zone."""
        when = _text(at)
        rows = [
            (
                cow,
                when,
                hours_since_milking,
                days_in_milk,
                teat,
                *map(float, one.end_mm),
                json.dumps(np.asarray(one.covariance_mm2).tolist()),
                one.how,
            )
            for teat, one in ends.items()
        ]
        with closing(self._open()) as db, db:
            if db.execute("SELECT 1 FROM ends WHERE cow = ? AND at = ?", (cow, when)).fetchone():
                raise ValueError(f"the visit of {cow} at {when} is there already")
            db.executemany(f"INSERT INTO ends VALUES ({', '.join('?' * 10)})", rows)  # noqa: S608

    def context(
        self,
        cow: str,
        now: datetime,
        hours_since_milking: float,
        days_in_milk: float | None = None,
    ) -> Context:
        """What is known of a cow before ``now``: no visit of that moment or later."""
        ask = "SELECT * FROM ends WHERE cow = ? AND at < ? ORDER BY at, teat"
        with closing(self._open()) as db:
            rows = db.execute(ask, (cow, _text(now))).fetchall()
        visits = tuple(_visits(rows, now))[-MOST_VISITS:]
        return Context(hours_since_milking, days_in_milk, visits)


def _visits(rows: Sequence[tuple[str, ...]], now: datetime) -> Iterator[Visit]:
    for at, ends in groupby(rows, key=lambda row: row[1]):
        these = list(ends)
        yield Visit(
            (now - datetime.fromisoformat(at)).total_seconds() / 3600.0,
            float(these[0][2]),
            tuple(int(row[4]) for row in these),
            np.array([row[5:8] for row in these], dtype=np.float64),
            np.array([json.loads(row[8]) for row in these]),
        )


def _text(at: datetime) -> str:
    """Of one length in UTC, so that text is ordered as time is."""
    if at.tzinfo is None:
        raise ValueError(f"the time {at.isoformat()} of a visit needs a zone")
    return (at - at.utcoffset()).replace(tzinfo=None).isoformat(timespec="microseconds") + "+00:00"  # type: ignore[operator]
