"""Looks whether a run is as it was written: database, foreign keys, chain, files. Reads only; says all that is wrong, in sentences.

What a run that died leaves behind, the frames of a trial that never finished, is told but is no damage.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from bench.store.chain import Head, fact_fingerprint, fingerprint, linked
from bench.store.files import sha256_of
from bench.store.reading import as_written, known_version
from bench.store.schema import DATABASE, LATER_WORD, tables_of

PRINTED = Path("report") / "run.json"
COUNTED = ("trials", "frames", "events", "bath")
CHAINED_SINCE = 3  # schema; what was written before has no chain


class Weight(StrEnum):
    """``damage``: not as it was written. ``note``: worth knowing."""

    DAMAGE = "damage"
    NOTE = "note"


@dataclass(frozen=True, slots=True)
class Finding:
    """One sentence on the run."""

    weight: Weight
    text: str


@dataclass(frozen=True, slots=True)
class Checked:
    """What was looked at (counts by name), what was found, and the chain's last link as it is."""

    counts: Mapping[str, int]
    findings: tuple[Finding, ...]
    head: Head

    @property
    def whole(self) -> bool:
        """Nothing is damaged."""
        return not any(finding.weight is Weight.DAMAGE for finding in self.findings)


def check_run(folder: Path, digest: str | None = None) -> Checked:
    """Look at everything; ``digest`` is one that a report names, of either kind. Raises ConfigError where it is no run."""
    with as_written(folder) as db:
        version = known_version(db, folder)
        findings: list[Finding] = []
        head, counts = Head(), dict.fromkeys(COUNTED, 0)
        try:
            findings += [*_database(db), *_frames(db, folder)]
            head = _provenance(db, folder, version, digest, findings)
            counts |= {name: int(db.execute(f"SELECT count(*) FROM {name}").fetchone()[0]) for name in COUNTED}  # noqa: S608 - our names
        except sqlite3.DatabaseError as error:
            findings.append(_damage(f"{DATABASE} can't be read to its end: {error}"))
    return Checked({**counts, "links": head.number}, tuple(findings), head)


def _provenance(db: sqlite3.Connection, folder: Path, version: int, digest: str | None, findings: list[Finding]) -> Head:
    """What the chain and the copied files say, into ``findings``; gives back the chain's last link."""
    if version < CHAINED_SINCE:
        findings.append(_note(f"the run is of an older bench (schema {version}): it has no chain, so that later edits can't be told"))
        return Head()
    links = list(db.execute("SELECT number, covers, digest, wall_covers, wall_digest FROM chain ORDER BY number"))
    findings += [*_chain(db, links), *_files(db, folder), *_printed(folder, links, digest)]
    return Head(links[-1][0], links[-1][2], links[-1][4]) if links else Head()


def _database(db: sqlite3.Connection) -> Iterator[Finding]:
    for (text,) in db.execute("PRAGMA integrity_check"):
        if text != "ok":
            yield _damage(f"{DATABASE}: {text}")
    for table, rowid, parent, _ in db.execute("PRAGMA foreign_key_check"):
        yield _damage(f"table {table}, row {rowid}: what it refers to in {parent} is not there")


def _frames(db: sqlite3.Connection, folder: Path) -> Iterator[Finding]:
    kept = dict(db.execute("SELECT path, sha256 FROM frames"))
    for path, sha256 in kept.items():
        yield from _file(folder, path, sha256)
    trials = {row[0] for row in db.execute("SELECT id FROM trials")}
    for file in sorted((folder / "frames").rglob("*")):
        path = file.relative_to(folder)
        if file.is_dir() or path.as_posix() in kept:
            continue
        if path.parts[1] in trials and file.suffix != ".part":
            yield _damage(f"{path.as_posix()} is in no row of the record: it came later, or its row was removed")
        else:
            yield _note(f"{path.as_posix()} belongs to no finished trial: the bench died or gave the trial up while it was written")


def _files(db: sqlite3.Connection, folder: Path) -> Iterator[Finding]:
    for name, sha256 in db.execute("SELECT name, sha256 FROM files"):
        yield from _file(folder, name, sha256)


def _file(folder: Path, name: str, sha256: str) -> Iterator[Finding]:
    try:
        found = sha256_of(folder / name)
    except OSError as error:
        yield _damage(f"{name} can't be read: {error.strerror or error}")
        return
    if found != sha256:
        yield _damage(f"{name} is not as it was written: its SHA-256 is {found}, the record says {sha256}")


def _chain(db: sqlite3.Connection, links: list[tuple[Any, ...]]) -> Iterator[Finding]:
    """Each link follows from the one before, covers the rows that follow those before, and they are as it says."""
    before, ends, facts = Head(), dict.fromkeys(_chained(db), 0), dict[str, str]()
    for number, covers, digest, wall_covers, wall_digest in links:
        given = Head(number, digest, wall_digest)
        if linked(before, covers, wall_covers).head != given:
            yield _damage(f"link {number} of the chain doesn't follow from the one before: links were changed, added or removed")
        before = given
        try:
            plain, whole = json.loads(covers), json.loads(wall_covers)
            plain.pop(LATER_WORD, None)
            facts |= whole.pop(LATER_WORD, {})
            yield from _rows(db, number, plain, whole, ends)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            yield _damage(f"link {number} of the chain can't be read: {error!r}")
    yield from _facts(db, facts)
    for table, end in ends.items():
        (last,) = db.execute(f"SELECT coalesce(max(rowid), 0) FROM {table}").fetchone()  # noqa: S608 - our names
        if last > end:
            yield _damage(f"table {table}, rows {end + 1} to {last} are in no link of the chain: they were added later")


def _rows(db: sqlite3.Connection, number: int, covers: dict[str, Any], wall: dict[str, Any], ends: dict[str, int]) -> Iterator[Finding]:
    for table, (first, last, plain) in covers.items():
        if first != ends[table] + 1:
            yield _damage(f"link {number} of the chain begins with row {first} of {table}; {ends[table] + 1} was to come")
        ends[table] = last
        if fingerprint(db, table, first, last) != (plain, wall[table][2]):
            rows = f"row {first} is" if first == last else f"rows {first} to {last} are"
            yield _damage(f"table {table}, {rows} not as written (link {number}{_whose(db, table, first)}): changed, added or removed")


def _facts(db: sqlite3.Connection, said: Mapping[str, str]) -> Iterator[Finding]:
    there = {row[0] for row in db.execute("SELECT key FROM facts")}
    for key in sorted(there - said.keys()):
        yield _damage(f"fact {key!r} is in no link of the chain: it was added later")
    for key, whole in said.items():
        if key not in there:
            yield _damage(f"fact {key!r} is missing")
        elif fact_fingerprint(db, key)[1] != whole:
            yield _damage(f"fact {key!r} is not as written")


def _printed(folder: Path, links: list[tuple[Any, ...]], digest: str | None) -> Iterator[Finding]:
    """The chain has to pass through what a report named: nothing else tells that its end was cut off, or all of it made anew."""
    known = {value: row[0] for row in links for value in (row[2], row[4])}
    if digest is not None and digest.lower() not in known:
        yield _damage(f"the chain doesn't pass through {digest}: the record was cut off or made anew since that was printed")
    path = folder / PRINTED
    if not path.is_file():
        return
    try:
        printed = json.loads(path.read_text(encoding="utf-8")).get("chain")
    except ValueError as error:
        yield _damage(f"{PRINTED.as_posix()} can't be read: {error}")
        return
    if printed and known.get(printed["wall_digest"]) != printed["links"]:
        yield _damage(f"the chain doesn't pass through the digest of {PRINTED.as_posix()}: the record was cut off or made anew since")


def _whose(db: sqlite3.Connection, table: str, rowid: int) -> str:
    """Which trial a row belongs to, where that is known."""
    column = {"trials": "id", "checks": "after_trial"}.get(table, "trial")
    names = {row[1] for row in db.execute(f"PRAGMA table_info({table})")}
    if column not in names:
        return ""
    row = db.execute(f"SELECT {column} FROM {table} WHERE rowid = ?", (rowid,)).fetchone()  # noqa: S608 - our names
    return f", trial {row[0]}" if row else ""


def _chained(db: sqlite3.Connection) -> list[str]:
    return [table for table in tables_of(db) if table not in ("chain", LATER_WORD)]


def _damage(text: str) -> Finding:
    return Finding(Weight.DAMAGE, text)


def _note(text: str) -> Finding:
    return Finding(Weight.NOTE, text)
