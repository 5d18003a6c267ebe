"""Opens a run's database for reading only, whatever bench wrote it, and never changes it.

A run of an older bench is copied into memory and brought to today's tables there: what lies on the disk stays as it was written.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from bench.config import ConfigError
from bench.store.schema import DATABASE, SCHEMA_VERSION, migrate, version_of


@contextmanager
def opened(folder: Path) -> Iterator[sqlite3.Connection]:
    """The database in ``folder`` with today's tables, all reads from one moment. Raises ConfigError, where it is none of this bench's."""
    with as_written(folder) as db:
        version = known_version(db, folder)
        if version == SCHEMA_VERSION:
            db.execute("BEGIN")
            yield db
            return
        with closing(sqlite3.connect(":memory:", isolation_level=None)) as copy:
            db.backup(copy)
            migrate(copy)
            yield copy


@contextmanager
def as_written(folder: Path) -> Iterator[sqlite3.Connection]:
    """The database in ``folder`` with the tables that it was written with. Raises ConfigError where there is none, or it can't be read."""
    path = folder / DATABASE
    if not path.is_file():
        raise ConfigError.plain(f"{folder} is no run: there is no {DATABASE} in it. Give a folder under runs/.")
    try:
        with closing(_connected(path)) as db:
            yield db
    except sqlite3.DatabaseError as error:
        raise ConfigError.plain(f"{path} can't be read: {error}. Is it a copy without its -wal file?") from error


def known_version(db: sqlite3.Connection, folder: Path) -> int:
    """The version of the tables. Raises ConfigError where this bench doesn't know them."""
    version = version_of(db)
    if 1 <= version <= SCHEMA_VERSION:
        return version
    found = f"{folder / DATABASE} has schema {version}; this bench reads 1 to {SCHEMA_VERSION}"
    if version > SCHEMA_VERSION:
        raise ConfigError.plain(f"{found}. A newer bench wrote it: update this one, or use that one.")
    raise ConfigError.plain(f"{found}. No bench has finished making it: there is nothing in it to read.")


def _connected(path: Path) -> sqlite3.Connection:
    """A write-ahead log needs a folder that can be written to; without a log that matters, a write-protected copy opens as well."""
    address = f"{path.resolve().as_uri()}?mode=ro"
    try:
        return _asked(address)
    except sqlite3.OperationalError:
        log = path.with_name(path.name + "-wal")
        if log.is_file() and log.stat().st_size:
            raise
        return _asked(f"{address}&immutable=1")


def _asked(address: str) -> sqlite3.Connection:
    """SQLite says only when it is asked something whether it could open the file."""
    db = sqlite3.connect(address, uri=True, isolation_level=None)
    try:
        version_of(db)
    except BaseException:
        db.close()
        raise
    return db
