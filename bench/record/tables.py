"""Every table of a run as a file of its own: CSV, or Parquet with types and the record's digest in
its metadata.

An empty field of a CSV, and a null of Parquet, is what was not measured. Figures keep all digits.
"""

from __future__ import annotations

import importlib
import io
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from bench.config import ConfigError
from bench.files import write_together
from bench.record.chain import head_of
from bench.record.reader import opened
from bench.record.schema import tables_of
from reports.sanitize import csv_text


def needed(module: str, what: str) -> Any:
    """``module``, which imports a library of exports. Raises ConfigError without that."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = (error.name or module).partition(".")[0]
        why = f"{what} needs {package}, which can't be imported: {error}"
        raise ConfigError.plain(f'{why}. Get it with: pip install "teatbench[export]"') from error


def export_csv(run: Path, out: Path) -> list[Path]:
    """Write ``out/<table>.csv`` for every table; the files. Raises ConfigError, OSError."""
    with opened(run) as db:
        tables = ((name, csv_text([heads, *rows])) for name, heads, _, rows in _tables(db))
        return write_together(out, ((f"{name}.csv", text.encode()) for name, text in tables))


def export_parquet(run: Path, out: Path) -> list[Path]:
    """Write ``out/<table>.parquet`` for every table; the files. Raises ConfigError, OSError."""
    arrow, parquet = needed("pyarrow", "Parquet"), needed("pyarrow.parquet", "Parquet")
    types = {"TEXT": arrow.string(), "REAL": arrow.float64(), "INTEGER": arrow.int64()}

    def files(db: sqlite3.Connection) -> Iterator[tuple[str, bytes]]:
        about = {"run": run.name, "wall_digest": head_of(db).wall_digest}
        for name, names, kinds, rows in _tables(db):
            fields = list(map(arrow.field, names, map(types.get, kinds)))
            columns = list(zip(*rows, strict=True)) or [()] * len(fields)
            table = arrow.Table.from_arrays(
                [arrow.array(c, type=f.type) for c, f in zip(columns, fields, strict=True)],
                schema=arrow.schema(fields, metadata=about),
            )
            data = io.BytesIO()
            parquet.write_table(table, data)
            yield f"{name}.parquet", data.getvalue()

    with opened(run) as db:
        return write_together(out, files(db))


def _tables(
    db: sqlite3.Connection,
) -> Iterator[tuple[str, tuple[str, ...], tuple[str, ...], Sequence[tuple[Any, ...]]]]:
    """Each table: name, columns, SQLite's words for their kinds (TEXT, REAL, INTEGER), rows."""
    for name in tables_of(db):
        columns = db.execute(f"PRAGMA table_info({name})").fetchall()
        rows = db.execute(f"SELECT * FROM {name} ORDER BY rowid").fetchall()  # noqa: S608 - our own names
        yield name, tuple(c[1] for c in columns), tuple(c[2] for c in columns), rows
