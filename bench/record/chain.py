"""A hash chain over everything that is written: each write is a link, and names the digest of all
before it.

A link covers the rows that one transaction added, table by table, with the SHA-256 of what SQLite
holds of them. ``digest`` leaves out real time and looks, so that it repeats with the seed;
``wall_digest`` covers every column. A row that is changed, added or removed later breaks its link;
a chain written anew as a whole gets another last digest than the one that the report names.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from bench.record.schema import FACTS

ZERO = "0" * 64
# keys that begin like this hold what doesn't repeat with the seed
LOOK = "look "
VARYING_FACTS = ("wall", "command", "recorded to", LOOK)
LOOKS_ALONE = "{}"  # what a link of looks covers without real time: nothing, so digest stays

COLUMNS = "number, covers, digest, wall_covers, wall_digest"
Spans = Mapping[str, tuple[int, int]]  # table -> first and last rowid


@dataclass(frozen=True, slots=True)
class Head:
    """The last link: its number from 1, and the digests of all written up to it."""

    number: int = 0
    digest: str = ZERO
    wall_digest: str = ZERO


def head_of(db: sqlite3.Connection) -> Head:
    row = db.execute(
        "SELECT number, digest, wall_digest FROM chain ORDER BY number DESC LIMIT 1"
    ).fetchone()
    return Head(*row) if row else Head()


def add_link(db: sqlite3.Connection, spans: Spans, facts: Collection[str]) -> None:
    """Add the link that covers these rows, in the transaction that wrote them."""
    covers: dict[str, Any] = {}
    wall_covers: dict[str, Any] = {}
    for table, (first, last) in spans.items():
        plain, whole = fingerprint(db, table, first, last)
        covers[table], wall_covers[table] = [first, last, plain], [first, last, whole]
    if facts:
        repeats = spans or not all(key.startswith(LOOK) for key in facts)
        prints = {key: fact_fingerprint(db, key) for key in facts}
        own = {key: plain for key, (plain, _) in prints.items() if plain is not None}
        covers |= {FACTS: own} if repeats else {}
        wall_covers[FACTS] = {key: whole for key, (_, whole) in prints.items()}
    plain, whole = _text(covers), _text(wall_covers)
    head = linked(head_of(db), plain, whole)
    values = (head.number, plain, head.digest, whole, head.wall_digest)
    db.execute(f"INSERT INTO chain ({COLUMNS}) VALUES (?, ?, ?, ?, ?)", values)  # noqa: S608


def linked(before: Head, covers: str, wall_covers: str) -> Head:
    """The head with the link that follows ``before``. What it covers is JSON: table -> [first
    rowid, last rowid, SHA-256]; facts: key -> SHA-256.
    """
    digest = _sha256(f"{before.digest}\n{covers}") if covers != LOOKS_ALONE else before.digest
    wall_digest = _sha256(f"{before.wall_digest}\n{digest}\n{wall_covers}")
    return Head(before.number + 1, digest, wall_digest)


def fingerprint(db: sqlite3.Connection, table: str, first: int, last: int) -> tuple[str, str]:
    """SHA-256 of these rows: without the columns of real time, and of all columns."""
    query = f"SELECT * FROM {table} WHERE rowid BETWEEN ? AND ? ORDER BY rowid"  # noqa: S608
    return _prints(table, db.execute(query, (first, last)))


def fact_fingerprint(db: sqlite3.Connection, key: str) -> tuple[str | None, str]:
    """SHA-256 of a fact; the first is None where it doesn't repeat with the seed."""
    plain, whole = _prints(FACTS, db.execute("SELECT * FROM facts WHERE key = ?", (key,)))
    return None if key.startswith(VARYING_FACTS) else plain, whole


def _prints(table: str, cursor: sqlite3.Cursor) -> tuple[str, str]:
    names, rows = [column[0] for column in cursor.description], cursor.fetchall()
    kept = [k for k, name in enumerate(names) if not name.startswith("wall")]
    plain = [table, [names[k] for k in kept], [[row[k] for k in kept] for row in rows]]
    return _sha256(_text(plain)), _sha256(_text([table, names, rows]))


def _text(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
