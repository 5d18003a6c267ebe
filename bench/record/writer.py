"""The one writer of a run folder. Each write is one synced transaction and one link of the chain.

A finished, skipped or checked trial is durable when its call returns, with all rows before it. So
are events and facts, but for those within ``step``: they are durable when the step or
`flush` ends, which has to come before a physical action counts as done. Events of `URGENT` kinds
never wait. Bath readings wait for the next write, at most `FLUSH_EVERY` of them. A frame's file and
folder are synced before its row is written.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import json
import os
import shutil
import sqlite3
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar

from bench.files import Picture, write_pictures, write_synced
from bench.record.chain import add_link
from bench.record.reader import TrialRecord, check_version, database_in
from bench.record.schema import DATABASE, FACTS, OF_A_TRIAL, Row, make_tables
from bench.record.state import NO_ENDING, end_in_reserve
from bench.version import __version__
from instruments.clock import wall_time as time_of_day
from textfiles.text import in_command
from textfiles.whole import in_turn, new_folders, sync_folder

Tables = Sequence[tuple[str, Sequence[Row]]]
FLUSH_EVERY = 60  # rows that may wait: one sync a minute of run time for the bath's readings
MOST_TRIES = 1000  # of a free name
M_ARENA_MAX = -8  # of glibc's malloc.h
LONGEST_NAME = 60  # bytes of the name of a script or recording in that of a run's folder
URGENT = frozenset({"trip", "fault", "aborted", "safe", "end"})
# what SQLite raises of a disk or database that takes nothing more, not of a wrong row
UNWRITABLE = (sqlite3.OperationalError, sqlite3.DatabaseError)
PRAGMAS = ("journal_mode = WAL", "synchronous = FULL", "fullfsync = ON", "foreign_keys = ON")


class FolderGoneError(OSError):
    """The run's folder, or its database, was deleted, moved or replaced while the run goes on."""


class Store:
    """An open run folder: begins a further session, or goes on in ``session``, and removes frames
    of unfinished trials. Raises ConfigError where the tables are of another bench.
    """

    keeps_pictures: ClassVar[bool] = True
    pragmas: ClassVar[tuple[str, ...]] = PRAGMAS

    def __init__(self, folder: Path, session: int | None = None) -> None:
        self.folder = folder
        if self.keeps_pictures:  # threads that draw would fragment heaps of their own (mallopt(3))
            _of_glibc("mallopt", M_ARENA_MAX, 1)
        # the watch writes on the clock's thread, all others on the main one
        self._lock = threading.RLock()
        self._steps = 0
        path = database_in(folder)
        self._db = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
        try:
            check_version(self._db, folder)
            self._place = _place(folder)
            for pragma in self.pragmas:
                self._db.execute(f"PRAGMA {pragma}")
            self._waiting: list[tuple[str, Row]] = []  # what the next write takes along
            self.session = self._begun() if session is None else session
        except BaseException:
            self._db.close()
            raise

    @classmethod
    def create(cls, folder: Path, files: Mapping[str, str]) -> Store:
        """A new run folder with ``files``, whole or not at all. Raises FileExistsError, OSError."""
        if folder.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(folder))
        part = folder.with_name(f".{folder.name}.{os.getpid()}-{threading.get_ident()}.part")
        if part.exists():
            shutil.rmtree(part)  # of a process that had our number, and died
        with new_folders(folder.parent):
            try:
                # one folder down, so that a list of runs doesn't have it
                session = cls._made(part / folder.name, files)
                # on Windows a virus scanner may hold the folder of new files
                in_turn(lambda: (part / folder.name).rename(folder))
            finally:
                # the error that kept it from being made is the one to raise
                shutil.rmtree(part, ignore_errors=True)
        return cls(folder, session)

    @classmethod
    def create_next(
        cls, out: Path, name: str, wall_time: datetime, files: Mapping[str, str]
    ) -> Store:
        """A new run in ``out``, numbered where others begin in the same second. Raises OSError."""
        for _ in range(MOST_TRIES):
            folder = new_run_folder(out, name, wall_time)
            try:
                return cls.create(folder, files)
            except OSError:
                # another took this name between the look and the rename; each system has its error
                if not folder.exists():
                    raise
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(folder))

    @classmethod
    def _made(cls, folder: Path, files: Mapping[str, str]) -> int:
        """Everything that a new run has, closed and synced; gives back its session."""
        folder.mkdir(parents=True)
        for name, text in files.items():
            write_synced(folder / name, text.encode())
        with closing(sqlite3.connect(folder / DATABASE, isolation_level=None)) as db:
            make_tables(db)
        store = cls(folder)
        digests = [
            {"name": name, "sha256": hashlib.sha256(text.encode()).hexdigest()}
            for name, text in files.items()
        ]
        store._write([("files", digests)])
        store.close()
        sync_folder(folder)
        return store.session

    @contextmanager
    def step(self) -> Iterator[None]:
        """What is written within is durable when the outermost step ends."""
        with self._lock:
            self._steps += 1
        try:
            yield
        finally:
            with self._lock:
                self._steps -= 1
                if not self._steps:
                    self.flush()

    def fact(self, key: str, value: Any) -> None:
        """Write down (or over) something that holds for the whole run; it is kept as JSON."""
        row = {"key": key, "value": json.dumps(value, ensure_ascii=False), "wall_time": self._now()}
        self._add_row(FACTS, row, urgent=not self._steps)

    def event(self, t_s: float | None, kind: str, text: str, wall_time: datetime) -> None:
        now = wall_time.isoformat(timespec="milliseconds")
        row = {"session": self.session, "t_s": t_s, "kind": kind, "text": text, "wall_time": now}
        self._add_row("events", row, urgent=not self._steps or kind in URGENT)

    def bath(self, reading: Row) -> None:
        """Write down a bath reading; it waits for whatever is written next."""
        row = {**reading, "session": self.session, "wall_time": self._now()}
        self._add_row("bath", row, urgent=False)

    def flush(self) -> None:
        """Make durable all rows so far."""
        with self._lock:
            if self._waiting:
                self._write([])

    @property
    def unwritten(self) -> list[Row]:
        """The events that are not on the disk yet."""
        with self._lock:
            return [row for table, row in self._waiting if table == "events"]

    def refuse_gone(self) -> None:
        """Raise FolderGoneError where folder or database isn't the one that was opened."""
        try:
            gone = _place(self.folder) != self._place
        except OSError:
            gone = True
        if gone:
            raise FolderGoneError(
                f"the run's folder {self.folder} was deleted, moved or replaced: what was recorded"
                " since the last finished trial may be lost. Put the folder back, then: teatbench"
                f" resume {in_command(self.folder)}"
            )

    def finished(self, done: TrialRecord) -> None:
        """Write a whole trial in one transaction, durable on return."""
        rows = ((name, getattr(done, name)) for name in OF_A_TRIAL if name != "scores")
        head = {**done.head, "session": self.session}
        self._write([("trials", [head]), *rows, ("scores", done.score_rows)])

    def skipped(self, row: Row) -> None:
        self._write([("skipped", [{**row, "session": self.session, "wall_time": self._now()}])])

    def checked(self, touches: Sequence[Row], invalid: Sequence[str], reason: str) -> None:
        """Write a check of the carried truth, and which trials lose their truth by it."""
        now = self._now()
        lost = [{"trial": trial, "reason": reason, "wall_time": now} for trial in invalid]
        rows = [{**touch, "wall_time": now} for touch in touches]
        self._write([("checks", rows), ("invalidated", lost)])

    def frames(
        self, trial: str, images: Mapping[str, Picture], exposed_s: Mapping[str, float]
    ) -> list[Row]:
        """Write pictures as PNG by name, synced on return; their rows. ``exposed_s`` is by camera,
        a picture's name up to "_". Raises FolderGoneError.
        """
        self.refuse_gone()
        paths = {camera: self.folder / "frames" / trial / f"{camera}.png" for camera in images}
        digests = write_pictures({paths[camera]: image for camera, image in images.items()})
        now = self._now()
        return [
            {
                "trial": trial,
                "camera": camera,
                "path": path.relative_to(self.folder).as_posix(),
                "sha256": digests[path],
                "exposed_s": exposed_s.get(camera.split("_")[0]),
                "wall_time": now,
            }
            for camera, path in paths.items()
        ]

    def close(self) -> None:
        """Flush and close; once more is no error."""
        with self._lock:
            try:
                self.flush()
            finally:
                self._db.close()

    def _begun(self) -> int:
        query = "SELECT coalesce(max(number), 0) + 1 FROM sessions"
        number = int(self._db.execute(query).fetchone()[0])
        row = {"number": number, "bench": __version__, "wall_time": self._now()}
        self._write([("events", self._left(number - 1)), ("sessions", [row])])
        # a trial that died in flight is done again, and may leave other pictures then
        finished = {row[0] for row in self._db.execute("SELECT id FROM trials")}
        for folder in (self.folder / "frames").glob("*"):
            if folder.name not in finished:
                shutil.rmtree(folder)
        return number

    def _left(self, session: int) -> list[Row]:
        """The events of the end of ``session`` for which there was no room then."""
        query = "SELECT value FROM facts WHERE key = 'ending'"
        (ending,) = self._db.execute(query).fetchone() or (None,)
        no_end = ending is None or json.loads(ending) == NO_ENDING
        return list(end_in_reserve(self.folder, session).get("events", ())) if no_end else []

    def _now(self) -> str:
        return time_of_day().isoformat(timespec="milliseconds")

    def _add_row(self, table: str, row: Row, *, urgent: bool) -> None:
        with self._lock:
            self._waiting.append((table, row))
            if urgent or len(self._waiting) >= FLUSH_EVERY:
                self._write([])

    def _write(self, tables: Tables) -> None:
        """Write the rows that wait and ``tables``, all or nothing, durable on return. Raises
        sqlite3.Error; the rows go on waiting then, unless one is wrong.
        """
        with self._lock:
            waiting: dict[str, list[Row]] = {}
            for table, row in self._waiting:
                waiting.setdefault(table, []).append(row)
            try:
                self._transaction([*waiting.items(), *tables])
            except Exception as error:
                if type(error) in UNWRITABLE:
                    raise
                if tables and waiting:
                    self._write([])
                self._waiting = []
                raise

    def _transaction(self, tables: Tables) -> None:
        begun = False
        try:
            self._db.execute("BEGIN IMMEDIATE")
            begun = True
            spans: dict[str, tuple[int, int]] = {}  # first and last rowid by table
            facts: dict[str, None] = {}  # in order, so that the same seed gives the same link
            for table, rows in tables:
                verb = "REPLACE" if table == FACTS else "INSERT"
                for row in rows:
                    marks = ", ".join("?" * len(row))
                    command = f"{verb} INTO {table} ({', '.join(row)}) VALUES ({marks})"
                    at = self._db.execute(command, tuple(row.values())).lastrowid or 0
                    if table == FACTS:
                        facts[row["key"]] = None
                    else:
                        spans[table] = (spans.get(table, (at, at))[0], at)
            add_link(self._db, spans, list(facts))
            self._db.execute("COMMIT")
            self._waiting = []
        # Ctrl-C too: an open transaction would keep the run's end from being written
        except BaseException as why:
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            # it came between the commit and the line behind
            elif begun and not isinstance(why, sqlite3.Error):
                self._waiting = []
            raise


def new_run_folder(out: Path, name: str, wall_time: datetime) -> Path:
    """A new name for a run: ``<out>/<time>-<name>``, numbered where needed, ``name`` cut."""
    stem = f"{wall_time:%Y%m%d-%H%M%S}-{name.encode()[:LONGEST_NAME].decode(errors='ignore')}"
    folder, number = out / stem, 1
    while folder.exists():
        number += 1
        folder = out / f"{stem}-{number}"
    return folder


def release_memory() -> None:
    """Return what written trials free to the system, where the C library is glibc
    (malloc_trim(3)): frames fragment its heap, which would grow with each trial.
    """
    _of_glibc("malloc_trim", 0)


def _of_glibc(function: str, *given: int) -> None:
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            getattr(ctypes.CDLL(None), function)(*given)


def _place(folder: Path) -> tuple[tuple[int, int], ...]:
    """How the system identifies the folder and its database (inodes; file indices on Windows)."""
    return tuple(
        (found.st_dev, found.st_ino) for found in (folder.stat(), (folder / DATABASE).stat())
    )
