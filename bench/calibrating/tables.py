"""Tables of numbers that a person writes: comma-separated values with a first line of names, explained when wrong."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bench.config import ConfigError, short
from detector.geometry import Array


def read_table(path: Path, columns: tuple[str, ...]) -> Mapping[str, Array]:
    """Columns of numbers from a CSV file with a first line of names. Raises ConfigError with the line."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = csv.DictReader(file, strict=True)
            if missing := [name for name in columns if name not in (lines.fieldnames or ())]:
                raise ConfigError.plain(
                    f"{path}:1: the column(s) {', '.join(missing)} are missing; the first line must name {','.join(columns)}"
                )
            rows = [[_number(f"{path}:{lines.line_num}", name, line[name]) for name in columns] for line in lines]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError.plain(f"{path}: can't be read as a table of comma-separated values in UTF-8: {error}") from error
    table = np.array(rows, dtype=np.float64).reshape(-1, len(columns))
    return dict(zip(columns, table.T, strict=True))


def _number(where: str, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        raise ConfigError.plain(f"{where}: {name} must be a number, is {short(repr(text))}") from None
    if not np.isfinite(value):
        raise ConfigError.plain(f"{where}: {name} must be finite, is {text!r}")
    return value
