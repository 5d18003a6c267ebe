"""Checks whether a run is as it was written: database, foreign keys, chain, files. Reads only.

Frames of an unfinished trial, which a run that died leaves behind, are a note, no damage.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from bench.config import ConfigError
from bench.files import sha256_of
from bench.record.chain import COLUMNS, LOOKS_ALONE, Head, fact_fingerprint, fingerprint, linked
from bench.record.reader import opened
from bench.record.schema import DATABASE, FACTS, GUARDIAN_FACT, GUARDIAN_FILES, tables_of
from instruments.errors import InstrumentError

NOT_AS_WRITTEN = "The record is NOT as it was written"
PRINTED = Path("report") / "run.json"
COUNTED = ("trials", "frames", "events", "bath")
Folders = Sequence[Path | str]
Damage = tuple[str, ...] | None  # in sentences; None: not looked for yet
SHOWN = 5  # damages of a run, in one message


class Weight(StrEnum):
    DAMAGE = "damage"  # not as it was written
    NOTE = "note"


@dataclass(frozen=True, slots=True)
class RecordFinding:
    """One sentence on the run."""

    weight: Weight
    text: str


_damage, _note = partial(RecordFinding, Weight.DAMAGE), partial(RecordFinding, Weight.NOTE)


@dataclass(frozen=True, slots=True)
class CheckResult:
    """What was checked (counts by name), what was found, and the chain's last link: ``head``, and
    ``unlooked``, the last but for looks that came later (`looks.write_looks`).
    """

    counts: Mapping[str, int]
    findings: tuple[RecordFinding, ...]
    head: Head
    unlooked: Head

    @property
    def whole(self) -> bool:
        return not any(finding.weight is Weight.DAMAGE for finding in self.findings)

    @property
    def sentence(self) -> str:
        return "The record is as it was written." if self.whole else f"{NOT_AS_WRITTEN}."

    @property
    def unchecked(self) -> str:
        """What nothing was there to check by; empty where a chain covers the record."""
        if not self.whole or self.head.number:
            return ""
        looked = f"0 links of a chain, {self.counts['frames']} frames with their SHA-256"
        return f"not checked: whether the record's rows are as they were written ({looked})"


def check_record(run: Path | str, digest: str | None = None) -> CheckResult:
    """Check all; ``digest`` is one that a report names. Raises ConfigError where it is no run."""
    folder = Path(run)
    with opened(folder) as db:
        findings: list[RecordFinding] = []  # what was found before something fails is kept
        links: list[tuple[Any, ...]] = []
        counts = dict.fromkeys((*COUNTED, "files"), 0)
        try:
            for (text,) in db.execute("PRAGMA integrity_check"):
                findings += [_damage(f"{DATABASE}: {text}")] if text != "ok" else []
            for table, rowid, parent, _ in db.execute("PRAGMA foreign_key_check"):
                row = f"table {table}, row {rowid}"
                findings.append(_damage(f"{row}: what it refers to in {parent} is not there"))
            for finding in chain(_frames(db, folder), _guardians(db, folder)):
                findings.append(finding)
            for finding in _provenance(db, folder, digest, links):
                findings.append(finding)
            counts |= {
                name: int(db.execute(f"SELECT count(*) FROM {name}").fetchone()[0])  # noqa: S608
                for name in (*COUNTED, "files")
            }
        except (sqlite3.Error, ValueError, TypeError, RecursionError) as error:
            findings.append(_damage(f"{DATABASE} can't be read to its end: {error}"))
    own = next((at for at, link in enumerate(reversed(links)) if link[1] != LOOKS_ALONE), 0)
    heads = [Head(link[0], link[2], link[4]) for link in links]
    head, unlooked = (heads[-1], heads[-1 - own]) if heads else (Head(), Head())
    return CheckResult({**counts, "links": head.number}, tuple(findings), head, unlooked)


def damage_of(folder: Path) -> tuple[str, ...]:
    """What of the record in ``folder`` is not as it was written. Raises as `check_record`."""
    return tuple(_damage_in(folder, check_record(folder)))


def _damage_in(folder: Path, checked: CheckResult) -> Iterator[str]:
    for finding in checked.findings:
        if finding.weight is Weight.DAMAGE:
            yield f"{folder.resolve().name}: {finding.text}"


class DamagedError(ConfigError):
    """Records are refused: ``folders`` are not as they were written, ``damage`` in sentences."""

    folders: tuple[Path, ...] = ()
    damage: tuple[str, ...] = ()


@contextmanager
def checked_first(folders: Folders, *, despite_damage: bool) -> Iterator[tuple[str, ...]]:
    """Checks these runs, then gives the damage, in sentences. Raises ConfigError where there is any
    and ``despite_damage`` isn't set; where it is, for what fails since the record is damaged.
    """
    checked = {folder: check_record(folder) for folder in dict.fromkeys(map(Path, folders))}
    found = [(folder, text) for folder, one in checked.items() for text in _damage_in(folder, one)]
    damage = tuple(text for _, text in found)
    if damage and not despite_damage:
        hint = (
            "'teatbench store check RUN' lists all of it; `despite_damage` goes on all the same,"
            " and says so in what it writes."
        )
        what = f"{NOT_AS_WRITTEN}, and is refused. {shortened(damage)}\n{hint}"
        refused = DamagedError.plain(what)
        refused.folders, refused.damage = tuple(dict(found)), damage
        raise refused
    try:
        yield damage
    except (ConfigError, InstrumentError, OSError):
        raise
    except Exception as error:  # whatever a damaged record makes of the code that reads it
        if all(one.whole and one.head.number for one in checked.values()):
            raise
        why = "It has no chain, so that it can't be checked against what was written."
        raise ConfigError.plain(
            f"the record is too damaged for this ({type(error).__name__}: {error})."
            f" {shortened(damage) if damage else why}"
        ) from error


@contextmanager
def known_damage(folders: Folders, damage: Damage) -> Iterator[tuple[str, ...]]:
    """The damage of these records. Raises ConfigError where they were not checked before, and one
    is damaged.
    """
    if damage is not None:
        yield damage
        return
    with checked_first(folders, despite_damage=False) as found:
        yield found


def damage_text(damage: Sequence[str]) -> str:
    """What is said of a damaged record; empty for none."""
    return f"{NOT_AS_WRITTEN}. {shortened(damage)}" if damage else ""


def shortened(damage: Sequence[str]) -> str:
    more = [f"and {len(damage) - SHOWN} more"] if len(damage) > SHOWN else []
    return "; ".join([*damage[:SHOWN], *more]) + "."


def _provenance(
    db: sqlite3.Connection, folder: Path, digest: str | None, links: list[tuple[Any, ...]]
) -> Iterator[RecordFinding]:
    """What the chain and the copied files say; ``links`` gets the chain's."""
    links += db.execute(f"SELECT {COLUMNS} FROM chain ORDER BY number")  # noqa: S608
    yield from _chain(db, links)
    for name, sha256 in db.execute("SELECT name, sha256 FROM files"):
        yield from _file(folder, name, sha256)
    # The chain has to pass through the link that a report named.
    known = {value: row[0] for row in links for value in (row[2], row[4])}
    why = "the record was cut off or made anew since"
    if digest is not None and digest.lower() not in known:
        yield _damage(f"the chain doesn't pass through {digest}: {why} that was printed")
    name = PRINTED.as_posix()
    try:
        printed = printed_chain(folder)
        if printed and known.get(printed["wall_digest"]) != printed["links"]:
            yield _damage(f"the chain doesn't pass through the digest of {name}: {why}")
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        hint = "Without the folder report, 'teatbench report' makes it anew"
        yield _damage(f"{name} can't be read: {error!r}. {hint}")


def _frames(db: sqlite3.Connection, folder: Path) -> Iterator[RecordFinding]:
    kept = dict(db.execute("SELECT path, sha256 FROM frames"))
    for path, sha256 in kept.items():
        yield from _file(folder, path, sha256)
    trials = {row[0] for row in db.execute("SELECT id FROM trials")}
    for file in sorted((folder / "frames").rglob("*")):
        path = file.relative_to(folder)
        if file.is_dir() or path.as_posix() in kept:
            continue
        if path.parts[1] in trials and file.suffix != ".part":
            why = "it came later, or its row was removed"
            yield _damage(f"{path.as_posix()} is in no row of the record: {why}")
        else:
            why = "it was added, or the bench died or gave the trial up while it was written"
            yield _note(f"{path.as_posix()} belongs to no finished trial: {why}")


def _guardians(db: sqlite3.Connection, folder: Path) -> Iterator[RecordFinding]:
    """What a guardian wrote has to be what the next session found; the last one's isn't checked."""
    there = {path.name for path in folder.glob(GUARDIAN_FILES)}
    pattern = GUARDIAN_FACT.format(GUARDIAN_FILES)
    found = db.execute("SELECT key, value FROM facts WHERE key GLOB ?", (pattern,))
    kept = {key.removeprefix(GUARDIAN_FACT.format("")): json.loads(text) for key, text in found}
    for name in sorted(kept.keys() | there):
        try:
            record = json.loads((folder / name).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            yield _damage(f"{name} can't be read: {getattr(error, 'strerror', None) or error}")
            continue
        if name not in kept:
            why = "its guardian wrote it after the bench had died"
            yield _note(f"{name} is in no link of the chain: {why}")
        elif record != kept[name]:
            yield _damage(f"{name} is not as the next session found it")


def _file(folder: Path, name: Any, sha256: Any) -> Iterator[RecordFinding]:
    if not isinstance(name, str):
        yield _damage(f"a file of the record has no name, but {name!r} in its place")
        return
    try:
        found = sha256_of(folder / name)
    except (OSError, ValueError) as error:  # a name may hold what no file's name can
        yield _damage(f"{name} can't be read: {getattr(error, 'strerror', None) or error}")
        return
    if found != sha256:
        yield _damage(
            f"{name} is not as it was written: its SHA-256 is {found}, the record says {sha256}"
        )


def _chain(db: sqlite3.Connection, links: list[tuple[Any, ...]]) -> Iterator[RecordFinding]:
    """Each link follows from the one before, and covers the next rows, as they are."""
    chained = [table for table in tables_of(db) if table not in ("chain", FACTS)]
    before, ends, facts = Head(), dict.fromkeys(chained, 0), dict[str, str]()
    for number, covers, digest, wall_covers, wall_digest in links:
        given = Head(number, digest, wall_digest)
        if linked(before, covers, wall_covers) != given:
            why = "links were changed, added or removed"
            yield _damage(f"link {number} of the chain doesn't follow from the one before: {why}")
        before = given
        try:
            plain, whole = json.loads(covers), json.loads(wall_covers)
            plain.pop(FACTS, None)
            facts |= whole.pop(FACTS, {})
            yield from _rows(db, number, plain, whole, ends)
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            yield _damage(f"link {number} of the chain can't be read: {error!r}")
    there = {row[0] for row in db.execute("SELECT key FROM facts")}
    for key in sorted(there - facts.keys(), key=repr):
        yield _damage(f"fact {key!r} is in no link of the chain: it was added later")
    for key, whole in facts.items():
        if key not in there:
            yield _damage(f"fact {key!r} is missing")
        elif fact_fingerprint(db, key)[1] != whole:
            yield _damage(f"fact {key!r} is not as written")
    for table, end in ends.items():
        (last,) = db.execute(f"SELECT coalesce(max(rowid), 0) FROM {table}").fetchone()  # noqa: S608 - our names
        if last > end:
            rows = f"row {last} is" if last == end + 1 else f"rows {end + 1} to {last} are"
            yield _damage(f"table {table}, {rows} in no link of the chain: added later")


def _rows(
    db: sqlite3.Connection,
    number: int,
    covers: dict[str, Any],
    wall: dict[str, Any],
    ends: dict[str, int],
) -> Iterator[RecordFinding]:
    for table, (first, last, plain) in covers.items():
        if first != (wanted := ends[table] + 1):
            begins = f"link {number} of the chain begins with row {first} of {table}"
            yield _damage(f"{begins}; {wanted} was to come")
        ends[table] = last
        if fingerprint(db, table, first, last) != (plain, wall[table][2]):
            rows = f"row {first} is" if first == last else f"rows {first} to {last} are"
            where = f"link {number}{_whose(db, table, first)}"
            why = "changed, added or removed"
            yield _damage(f"table {table}, {rows} not as written ({where}): {why}")


def printed_chain(folder: Path) -> Any:
    """The chain's last link as the run's last report names it; None where there is none."""
    path = folder / PRINTED
    return json.loads(path.read_text(encoding="utf-8")).get("chain") if path.is_file() else None


def _whose(db: sqlite3.Connection, table: str, rowid: int) -> str:
    """Which trial a row belongs to, where that is known."""
    column = {"trials": "id", "checks": "after_trial"}.get(table, "trial")
    names = {row[1] for row in db.execute(f"PRAGMA table_info({table})")}
    if column not in names:
        return ""
    row = db.execute(f"SELECT {column} FROM {table} WHERE rowid = ?", (rowid,)).fetchone()  # noqa: S608 - our names
    return f", trial {row[0]}" if row else ""
