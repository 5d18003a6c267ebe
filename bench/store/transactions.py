"""Rows into the database: what waits and what comes, in one synced transaction with the link of the chain that covers it.

A wrong row never holds up others, for the end of a run has to be written whatever came before; a disk at fault loses nothing that
waits. Ctrl-C may come between any two lines. Not for several threads at once: the store sees to that.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from typing import Any

from bench.store.chain import Spans, add_link
from bench.store.schema import LATER_WORD

Row = Mapping[str, Any]
Tables = Sequence[tuple[str, Sequence[Row]]]


class Transactions:
    """On ``db``, an open database of today's schema in autocommit."""

    def __init__(self, db: sqlite3.Connection) -> None:
        for pragma in ("journal_mode = WAL", "synchronous = FULL", "fullfsync = ON", "foreign_keys = ON"):
            db.execute(f"PRAGMA {pragma}")
        self._db = db
        self._waiting: list[tuple[str, Row]] = []

    @property
    def waiting(self) -> int:
        """How many rows the next write will take along."""
        return len(self._waiting)

    def wait(self, table: str, row: Row) -> None:
        """Have ``row`` written with whatever is written next."""
        self._waiting.append((table, row))

    def write(self, tables: Tables) -> None:
        """What waits and ``tables``, all or nothing, durable on return. Raises sqlite3.Error; on OperationalError it goes on waiting."""
        waiting = _by_table(self._waiting)
        try:
            self._transaction([*waiting, *tables])
        except sqlite3.OperationalError:
            raise
        except Exception:  # a row is wrong
            if tables and waiting:
                self.write([])
            self._waiting = []
            raise

    def _transaction(self, tables: Tables) -> None:
        begun = False
        try:
            self._db.execute("BEGIN IMMEDIATE")
            begun = True
            add_link(self._db, *self._inserted(tables))
            self._db.execute("COMMIT")
            self._waiting = []
        except BaseException as why:  # Ctrl-C too: an open transaction would keep the run's end from being written
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            elif begun and not isinstance(why, sqlite3.Error):  # it came between the commit and the line behind
                self._waiting = []
            raise

    def _inserted(self, tables: Tables) -> tuple[Spans, list[str]]:
        """Insert all rows; gives back which there are now by rowid, and the keys of the facts as they came."""
        spans: dict[str, tuple[int, int]] = {}
        facts: dict[str, None] = {}  # in order, so that the same seed gives the same link
        for table, rows in tables:
            verb = "REPLACE" if table == LATER_WORD else "INSERT"
            for row in rows:
                command = f"{verb} INTO {table} ({', '.join(row)}) VALUES ({', '.join('?' * len(row))})"
                at = self._db.execute(command, tuple(row.values())).lastrowid or 0
                if table == LATER_WORD:
                    facts[row["key"]] = None
                else:
                    spans[table] = (spans.get(table, (at, at))[0], at)
        return spans, list(facts)


def _by_table(rows: Sequence[tuple[str, Row]]) -> list[tuple[str, list[Row]]]:
    tables: dict[str, list[Row]] = {}
    for table, row in rows:
        tables.setdefault(table, []).append(row)
    return list(tables.items())
