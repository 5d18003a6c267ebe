"""The rows of a campaign in its folder: Parquet files that are there whole or not at all, one a
chunk, merged in the end; written and read by DuckDB.

A file has a row a scene and detector; a scene's teats are a list in its row. So one rename makes a
chunk done, with both its tables. `ideal-000012.parquet` is chunk 12 of a family,
`ideal-000000-000063.parquet` are 64 of them; a chunk that a merged file has too is not read twice.
"""

from __future__ import annotations

import hashlib
import re
import tempfile
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, fields
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import duckdb

from bench.campaign.chunk import SHARES, CallTime, ChunkRows, SceneRow, TeatRow
from bench.campaign.ledger import Damage, Ledger
from bench.config import ConfigError

SHARDS = "shards"
MERGED = 64  # chunks in one file, at most
MOST_ROWS, MOST_S = 1_000_000, 300.0  # of a query
INSERTED = 100  # rows in one statement: a statement takes as long as ten rows
SIZES = {"int": "INTEGER", "float": "FLOAT", "str": "VARCHAR", "Sequence[int]": "UTINYINT[]"}
COUNTS = (
    *("visible", "hidden", "found", "missed", "false_teats", "hidden_claimed", "teat"),
    *("sure_wrong", "stated", "inside"),
)
KEYS = ("family", "member", "detector")
NAME = re.compile(r"(?P<family>.+?)-(?P<first>\d{6})(?:-(?P<last>\d{6}))?\.parquet")
# what differs from run to run, and so isn't part of a digest
MEASURED = tuple(field.name for field in fields(CallTime))


def _columns(*rows: type, leave_out: Sequence[str] = ()) -> str:
    """The columns of these rows in SQL; counts take a byte."""
    named = {
        field.name: "UTINYINT" if field.name in COUNTS else SIZES[str(field.type).split(" ")[0]]
        for row in rows
        for field in fields(row)
        if field.name not in leave_out
    }
    return ", ".join(f'"{name}" {kind}' for name, kind in named.items())


OF_TEAT = tuple(field.name for field in fields(TeatRow) if field.name not in KEYS)
TABLE = f"{_columns(SceneRow, CallTime)}, teats STRUCT({_columns(TeatRow, leave_out=KEYS)})[]"
WIDTH = len(fields(SceneRow)) + len(MEASURED) + 1


@dataclass(frozen=True, slots=True, order=True)
class Shard:
    """A file with the chunks ``first`` to ``last`` of a family."""

    family: str
    first: int
    last: int
    path: Path


class Shards:
    """The folder of a campaign's shards. Raises ConfigError where it can't be used."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / SHARDS
        self.ledger = Ledger(folder)

    @cached_property
    def _writer(self) -> duckdb.DuckDBPyConnection:
        """Kept open: to open one takes longer than to write a chunk."""
        return duckdb.connect(config={"threads": 1})

    def files(self) -> list[Shard]:
        """What is to be read, in order: no chunk twice, nothing that the ledger doesn't name."""
        kept: list[Shard] = []
        named = self.ledger.state()
        ours = (one for one in self._all() if self._name(one.path) in named)
        for shard in sorted(ours, key=lambda one: (one.family, one.first, -one.last)):
            above = kept[-1] if kept and kept[-1].family == shard.family else None
            if above is None or shard.first > above.last:
                kept.append(shard)
        return kept

    def done(self) -> set[tuple[str, int]]:
        """Family and number of each chunk that is there."""
        return {
            (shard.family, number)
            for shard in self.files()
            for number in range(shard.first, shard.last + 1)
        }

    def write(self, family: str, number: int, rows: ChunkRows) -> None:
        """Add a chunk; its rows are sorted first."""
        self._writer.execute(f"CREATE OR REPLACE TABLE rows ({TABLE})")
        teats: dict[tuple[str, int, str], list[dict[str, Any]]] = {}
        for teat in rows.teats:
            plain = {name: getattr(teat, name) for name in OF_TEAT}
            teats.setdefault((teat.family, teat.member, teat.detector), []).append(plain)
        lines = [
            (
                *astuple(scene),
                *astuple(taken),
                teats.get((scene.family, scene.member, scene.detector), []),
            )
            for scene, taken in zip(rows.scenes, rows.taken, strict=True)
        ]
        for start in range(0, len(lines), INSERTED):
            part = lines[start : start + INSERTED]
            places = ", ".join([f"({', '.join('?' * WIDTH)})"] * len(part))
            self._writer.execute(f"INSERT INTO rows VALUES {places}", list(chain(*part)))
        self._store(f"{family}-{number:06d}")

    def merge(self) -> None:
        """Merge each block of chunks of a family."""
        blocks: dict[tuple[str, int], list[Shard]] = {}
        for shard in self.files():
            blocks.setdefault((shard.family, shard.first // MERGED), []).append(shard)
        for (family, _), parts in blocks.items():
            chunks = sum(part.last - part.first + 1 for part in parts)
            first, last = parts[0].first, parts[-1].last
            if len(parts) > 1 and chunks == last - first + 1:
                read = _read([part.path for part in parts])
                self._writer.execute(f"CREATE OR REPLACE TABLE rows AS {read}")
                self._store(f"{family}-{first:06d}-{last:06d}")
                self.remove(parts)
        self.remove(set(self._all()) - set(self.files()))

    def remove(self, shards: Iterable[Shard]) -> None:
        """Remove files, from the ledger first: one that it names and that isn't there was lost."""
        gone = list(shards)
        if gone:
            self.ledger.remove(map(self._name, (shard.path for shard in gone)))
        for shard in gone:
            shard.path.unlink(missing_ok=True)

    def remove_damaged(self, chunk: str = "") -> Damage:
        """Remove what is not as it was written, so that it is done again, of the file of one
        ``chunk`` or of all; gives back what that was.
        """
        damage = self.ledger.damage(f"{SHARDS}/{chunk}")
        if damage:
            self.ledger.remove((*damage.changed, *damage.missing, *damage.unknown))
        for name in (*damage.changed, *damage.unknown):
            (self.ledger.folder / name).unlink(missing_ok=True)
        return damage

    def check(self) -> None:
        """Raises ConfigError where a file isn't as it was written, or is missing."""
        if damage := self.ledger.damage(f"{SHARDS}/"):
            raise ConfigError.plain(
                f"{self.ledger.folder}: the campaign's rows are damaged: {damage}. Give the command"
                " 'teatbench campaign run' that made them again: it does these chunks anew."
            )

    @contextmanager
    def connect(self, *, loaded: bool = False) -> Iterator[duckdb.DuckDBPyConnection]:
        """A database with the views `scenes`, `teats` and `parameters`, once the files are checked;
        with ``loaded``, of rows in memory, which reads no file any more. Raises ConfigError, for
        what the database refuses too.
        """
        self.check()
        paths = [shard.path for shard in self.files()]
        with duckdb.connect(config={"autoinstall_known_extensions": False}) as db:
            try:
                self._views(db, paths, "TABLE" if loaded else "VIEW")
                if loaded:
                    db.execute("SET enable_external_access = false; SET lock_configuration = true")
                yield db
            except (duckdb.Error, RuntimeError, UnicodeError) as error:
                where = self.ledger.folder
                raise ConfigError.plain(f"{where}: the database refuses: {error}") from error

    def _views(self, db: duckdb.DuckDBPyConnection, paths: Sequence[Path], kind: str) -> None:
        if paths:
            db.execute(f"CREATE {kind} everything AS {_read(paths)}")
        else:
            db.execute(f"CREATE TABLE everything ({TABLE})")
        left_out = "teats, parameters, shares"
        db.execute(f"CREATE VIEW scenes AS SELECT * EXCLUDE ({left_out}) FROM everything")
        names = ", ".join(f'"{name}"' for name in KEYS)
        parts = ", ".join(f'teat."{name}"' for name in OF_TEAT)
        listed = f"SELECT {names}, unnest(teats) AS teat FROM everything"
        db.execute(f"CREATE VIEW teats AS SELECT {names}, {parts} FROM ({listed})")
        db.execute(
            f"CREATE VIEW parameters AS SELECT {names}, failure, unnest(string_split(parameters,"
            f" ',')) AS name, unnest(shares) / {SHARES}.0 AS share FROM everything"
        )

    def digest(self) -> str:
        """SHA-256 in hex of all rows, sorted, without what was measured."""
        whole = hashlib.sha256()
        left_out = ", ".join(MEASURED)
        with self.connect() as db:
            order = ", ".join(KEYS)
            found = db.execute(f"SELECT * EXCLUDE ({left_out}) FROM everything ORDER BY {order}")
            while rows := found.fetchmany(1000):
                for row in rows:
                    whole.update(repr(row).encode("utf-8"))
        return whole.hexdigest()

    def _all(self) -> list[Shard]:
        found = []
        for path in self.folder.glob("*.parquet"):
            if name := NAME.fullmatch(path.name):
                first = int(name["first"])
                found.append(Shard(name["family"], first, int(name["last"] or first), path))
        return found

    def _store(self, name: str) -> None:
        with tempfile.TemporaryDirectory(prefix="teatbench-") as made:
            path = Path(made) / "rows.parquet"
            self._writer.execute(
                f"COPY (FROM rows ORDER BY {', '.join(KEYS)}) TO {quoted(path)}"
                " (FORMAT parquet, COMPRESSION zstd, PARQUET_VERSION v2)"
            )
            self.ledger.write(f"{SHARDS}/{name}.parquet", path.read_bytes())

    @staticmethod
    def _name(path: Path) -> str:
        """As the ledger has it."""
        return f"{SHARDS}/{path.name}"


def _read(paths: Sequence[Path]) -> str:
    return f"SELECT * FROM read_parquet([{', '.join(map(quoted, paths))}])"


def quoted(path: Path) -> str:
    """A path as text in SQL."""
    return "'" + str(path).replace("'", "''") + "'"


def no_campaign(folder: Path) -> ConfigError:
    return ConfigError.plain(
        f"{folder}: no campaign is there; name the folder that 'teatbench campaign run' wrote"
    )


def query_campaign(folder: Path | str, sql: str) -> tuple[list[str], list[tuple[Any, ...]]]:
    """The columns' names and the rows that ``sql`` asks for of `scenes` and `teats`, which can't
    reach a file or a network. Raises ConfigError for a folder without shards, for damaged ones, for
    more than MOST_ROWS or MOST_S, and with the database's own words.
    """
    folder = Path(folder)
    if not (folder / SHARDS).is_dir():
        raise no_campaign(folder)
    with Shards(folder).connect(loaded=True) as db:
        timer = threading.Timer(MOST_S, db.interrupt)
        timer.start()
        try:
            # nothing at all for nothing asked
            found: duckdb.DuckDBPyConnection | None = db.execute(sql)
            if found is None:
                raise ConfigError.plain(
                    "the query is empty: ask for rows, as 'SELECT * FROM scenes'"
                )
            names = [column[0] for column in found.description or ()]
            rows = found.fetchmany(MOST_ROWS + 1)
        except duckdb.InterruptException as error:
            raise ConfigError.plain(
                f"the query took more than {MOST_S:g} s: ask for less"
            ) from error
        except (duckdb.Error, RuntimeError, UnicodeError) as error:
            raise ConfigError.plain(f"the query is refused: {error}") from error
        finally:
            timer.cancel()
            timer.join()
        if len(rows) > MOST_ROWS:
            raise ConfigError.plain(
                f"the query gives more than {MOST_ROWS:,} rows: count or group them, or end it with"
                " LIMIT"
            )
        return names, rows
