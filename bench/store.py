"""The run folder: what was asked for, what happened, and the frames. Opens after any death of the bench.

``runs/<time>-<script>/`` holds the script, rig and calibration as used, ``run.sqlite`` (write-ahead log, full
sync) and ``frames/<trial>/<camera>.png``. A trial's rows come in one transaction after its frames are on disk:
it is there whole or not at all. Columns that begin with ``wall`` hold real time; all others repeat with the seed.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

SCHEMA_VERSION = 2
DATABASE, SCRIPT, RULES = "run.sqlite", "script.toml", "rules.toml"
GUARDIAN = "guardian.json"  # written by the guardian, when it had to act
PNG = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)  # on noise half the time of level 1, and smaller; a level would undo it
FLUSH_EVERY = 60  # bath readings a transaction: one sync a minute of run time

SCHEMA = """
CREATE TABLE facts (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE events (number INTEGER PRIMARY KEY, t_s REAL, kind TEXT NOT NULL, text TEXT NOT NULL, wall_time TEXT NOT NULL);
CREATE TABLE bath (t_s REAL PRIMARY KEY, temp_c REAL NOT NULL, external_c REAL, power_percent REAL, state TEXT NOT NULL);
CREATE TABLE trials (id TEXT PRIMARY KEY, number INTEGER NOT NULL, name TEXT NOT NULL, situation TEXT NOT NULL, repeat INTEGER NOT NULL,
  started_s REAL, ended_s REAL, captured_s REAL, bath_c REAL, bath_state TEXT, note TEXT,
  stage_mm TEXT, invalid TEXT, wall_time TEXT NOT NULL);
CREATE TABLE skipped (trial TEXT PRIMARY KEY, number INTEGER NOT NULL, name TEXT NOT NULL, situation TEXT NOT NULL, repeat INTEGER NOT NULL,
  t_s REAL NOT NULL, reason TEXT NOT NULL);
CREATE TABLE frames (trial TEXT NOT NULL REFERENCES trials, camera TEXT NOT NULL, path TEXT NOT NULL, sha256 TEXT NOT NULL, exposed_s REAL,
  PRIMARY KEY (trial, camera));
CREATE TABLE touches (trial TEXT NOT NULL REFERENCES trials, teat TEXT NOT NULL, touch INTEGER NOT NULL, t_s REAL NOT NULL,
  x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL, spread_mm REAL NOT NULL, packets INTEGER NOT NULL, counts TEXT NOT NULL,
  refused TEXT,
  PRIMARY KEY (trial, teat, touch));
CREATE TABLE truth (trial TEXT NOT NULL REFERENCES trials, teat TEXT NOT NULL,
  x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL, u_mm REAL, visible INTEGER NOT NULL, exact_mm TEXT,
  how TEXT, budget TEXT, covariance_mm2 TEXT, PRIMARY KEY (trial, teat));
CREATE TABLE checks (number INTEGER NOT NULL, teat TEXT NOT NULL, after_trial TEXT NOT NULL REFERENCES trials, t_s REAL NOT NULL,
  x_mm REAL NOT NULL, y_mm REAL NOT NULL, z_mm REAL NOT NULL, carried_x_mm REAL NOT NULL, carried_y_mm REAL NOT NULL,
  carried_z_mm REAL NOT NULL, off_mm REAL NOT NULL, limit_mm REAL NOT NULL, held INTEGER NOT NULL, PRIMARY KEY (number, teat));
CREATE TABLE detections (trial TEXT NOT NULL REFERENCES trials, detector TEXT NOT NULL, hidden INTEGER NOT NULL, reason TEXT,
  outcome TEXT NOT NULL DEFAULT 'answered', cold INTEGER NOT NULL DEFAULT 0, trace TEXT NOT NULL,
  wall_seconds REAL NOT NULL, wall_start_up_s REAL, wall_stderr TEXT, PRIMARY KEY (trial, detector));
CREATE TABLE found (trial TEXT NOT NULL, detector TEXT NOT NULL, number INTEGER NOT NULL, x_mm REAL NOT NULL, y_mm REAL NOT NULL,
  z_mm REAL NOT NULL, covariance_mm2 TEXT, left_px TEXT, right_px TEXT, PRIMARY KEY (trial, detector, number),
  FOREIGN KEY (trial, detector) REFERENCES detections);
CREATE TABLE scores (trial TEXT NOT NULL, detector TEXT NOT NULL, score TEXT NOT NULL, wall_score TEXT NOT NULL,
  PRIMARY KEY (trial, detector), FOREIGN KEY (trial, detector) REFERENCES detections);
"""

Row = Mapping[str, Any]
Picture = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class FinishedTrial:
    """All rows of one trial, ready to be written at once."""

    trial: Row
    frames: Sequence[Row]
    touches: Sequence[Row]
    truth: Sequence[Row]
    detections: Sequence[Row]
    found: Sequence[Row]
    scores: Sequence[Row]


class Store:
    """An open run folder. One writer."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._db = sqlite3.connect(folder / DATABASE, isolation_level=None, check_same_thread=False)
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute("PRAGMA synchronous = FULL")
        self._db.execute("PRAGMA foreign_keys = ON")
        self._readings: list[Row] = []
        self._lock = threading.RLock()  # the watch writes on the clock's thread, all others on the main one

    @classmethod
    def create(cls, folder: Path, files: Mapping[str, str]) -> Store:
        """A new run folder with the texts in ``files``. Raises FileExistsError when ``folder`` is there already."""
        folder.mkdir(parents=True)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8", newline="\n")
        store = cls(folder)
        store._db.executescript("BEGIN;" + SCHEMA + f"PRAGMA user_version = {SCHEMA_VERSION}; COMMIT;")
        return store

    def fact(self, key: str, value: Any) -> None:
        """Write down (or over) something that holds for the whole run; ``value`` is kept as JSON."""
        with self._lock:
            self._db.execute("INSERT OR REPLACE INTO facts VALUES (?, ?)", (key, json.dumps(value, ensure_ascii=False)))

    def event(self, t_s: float | None, kind: str, text: str, wall_time: datetime) -> None:
        """Write down what happened, durable at once."""
        self.flush()
        self._write([("events", [{"t_s": t_s, "kind": kind, "text": text, "wall_time": wall_time.isoformat(timespec="milliseconds")}])])

    def bath(self, reading: Row) -> None:
        """Write down a bath reading; durable with the next event or trial, or after a minute of readings."""
        with self._lock:
            self._readings.append(reading)
            if len(self._readings) >= FLUSH_EVERY:
                self.flush()

    def flush(self) -> None:
        """Make all bath readings durable."""
        with self._lock:
            if self._readings:
                readings, self._readings = self._readings, []
                self._write([("bath", readings)])

    def finished(self, done: FinishedTrial) -> None:
        """Write a whole trial in one transaction, durable on return."""
        names = ("frames", "touches", "truth", "detections", "found", "scores")
        with self._lock:
            readings, self._readings = self._readings, []
            tables: list[tuple[str, Sequence[Row]]] = [("bath", readings), ("trials", [done.trial])]
            self._write(tables + [(name, getattr(done, name)) for name in names])

    def skipped(self, row: Row) -> None:
        """Write down a trial that was not done, durable at once."""
        self.flush()
        self._write([("skipped", [row])])

    def checked(self, touches: Sequence[Row], invalid: Sequence[str], reason: str) -> None:
        """Write down a check of the carried truth, and for which trials it takes their truth away, at once and durable."""
        with self._lock:
            self.flush()
            marks = [("UPDATE trials SET invalid = ? WHERE id = ?", (reason, trial)) for trial in invalid]
            self._write([("checks", touches)], marks)

    def frame(self, trial: str, camera: str, image: Picture, exposed_s: float | None) -> Row:
        """Write a frame as PNG, synced and renamed; gives back its row for the trial."""
        path = self.folder / "frames" / trial / f"{camera}.png"
        data = png_bytes(image)
        write_synced(path, data)
        relative = path.relative_to(self.folder).as_posix()
        digest = hashlib.sha256(data).hexdigest()
        return {"trial": trial, "camera": camera, "path": relative, "sha256": digest, "exposed_s": exposed_s}

    def close(self) -> None:
        """Flush and close; once more is no error."""
        with self._lock:
            self.flush()
            self._db.close()

    def _write(self, tables: Iterable[tuple[str, Sequence[Row]]], further: Sequence[tuple[str, tuple[str, ...]]] = ()) -> None:
        with self._lock:
            try:
                self._db.execute("BEGIN IMMEDIATE")
                for table, rows in tables:
                    for row in rows:
                        marks = ", ".join("?" * len(row))
                        command = f"INSERT INTO {table} ({', '.join(row)}) VALUES ({marks})"  # noqa: S608 - our names
                        self._db.execute(command, tuple(row.values()))
                for command, values in further:
                    self._db.execute(command, values)
                self._db.execute("COMMIT")
            except BaseException:  # Ctrl-C too: an open transaction would keep the run's end from being written
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise


def png_bytes(image: Picture) -> bytes:
    """``image`` as a PNG, compressed fast. Raises ValueError when OpenCV can't."""
    done, data = cv2.imencode(".png", image, PNG)
    if not done:
        raise ValueError(f"OpenCV can't write an image of shape {image.shape} and type {image.dtype} as PNG")
    return bytes(data)


def write_synced(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path`` so that after a crash it is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def new_run_folder(out: Path, name: str, wall_time: datetime) -> Path:
    """A name for a run that nothing has yet: ``<out>/<time>-<name>``, with a number where two fall on one second."""
    stem = f"{wall_time:%Y%m%d-%H%M%S}-{name}"
    folder, number = out / stem, 1
    while folder.exists():
        number += 1
        folder = out / f"{stem}-{number}"
    return folder
