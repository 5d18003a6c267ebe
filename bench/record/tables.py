"""Every table of a run as a file of its own: CSV, or Parquet with types and the record's digest in
its metadata.

An empty field of a CSV, and a null of Parquet, is what was not measured. Figures keep all digits.
"""

from __future__ import annotations

import importlib
import io
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.config import ConfigError
from bench.files import write_synced
from bench.record.chain import head_of
from bench.record.reader import opened
from bench.record.schema import tables_of
from reports.sanitize import csv_text


def needed(module: str, what: str) -> Any:
    """``module``, which imports a library that only an export needs. Raises ConfigError where that
    isn't installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = (error.name or module).partition(".")[0]
        why = f"{what} needs {package}, which can't be imported: {error}"
        raise ConfigError.plain(f'{why}. Get it with: pip install "teatbench[export]"') from error


@dataclass(frozen=True, slots=True)
class Table:
    """A table as it is stored: ``kinds`` are SQLite's words for
    its columns (TEXT, REAL, INTEGER).
    """

    name: str
    columns: tuple[str, ...]
    kinds: tuple[str, ...]
    rows: Sequence[tuple[Any, ...]]


def export_csv(run: Path, out: Path) -> list[Path]:
    """Write ``out/<table>.csv`` for every table; gives back the
    files. Raises ConfigError, OSError.
    """
    written = []
    with opened(run) as db:
        for table in _tables(db):
            written.append(out / f"{table.name}.csv")
            write_synced(written[-1], csv_text([table.columns, *table.rows]).encode())
    return written


def export_parquet(run: Path, out: Path) -> list[Path]:
    """Write ``out/<table>.parquet`` for every table; gives back the files. Raises ConfigError where
    pyarrow is missing; OSError.
    """
    arrow, parquet = needed("pyarrow", "Parquet"), needed("pyarrow.parquet", "Parquet")
    types = {"TEXT": arrow.string(), "REAL": arrow.float64(), "INTEGER": arrow.int64()}
    written = []
    with opened(run) as db:
        about = {"run": run.name, "wall_digest": head_of(db).wall_digest}
        for table in _tables(db):
            fields = [
                arrow.field(name, types[kind])
                for name, kind in zip(table.columns, table.kinds, strict=True)
            ]
            columns = list(zip(*table.rows, strict=True)) or [()] * len(fields)
            arrays = [
                arrow.array(column, type=field.type)
                for column, field in zip(columns, fields, strict=True)
            ]
            data = io.BytesIO()
            parquet.write_table(
                arrow.Table.from_arrays(arrays, schema=arrow.schema(fields, metadata=about)), data
            )
            written.append(out / f"{table.name}.parquet")
            write_synced(written[-1], data.getvalue())
    return written


def _tables(db: sqlite3.Connection) -> Iterator[Table]:
    for name in tables_of(db):
        columns = db.execute(f"PRAGMA table_info({name})").fetchall()
        rows = db.execute(f"SELECT * FROM {name} ORDER BY rowid").fetchall()  # noqa: S608 - our own names
        yield Table(name, tuple(c[1] for c in columns), tuple(c[2] for c in columns), rows)
