"""A run folder read back, of any state: a killed run too. The disk stays as it is; scores are as
stored.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.config import ConfigError, beside
from bench.record.chain import Head, head_of
from bench.record.schema import (
    DATABASE,
    GUARDIAN,
    GUARDIAN_FACT,
    GUARDIAN_FILES,
    OF_A_TRIAL,
    SCHEMA_VERSION,
    Row,
    version_of,
)
from bench.record.state import NO_ENDING, TRIP, end_in_reserve, holder_of
from bench.scoring.scene import SceneScore, scene_from_dict
from textfiles.text import in_command

HEADS = (
    "SELECT trials.*, invalidated.reason AS invalid FROM trials LEFT JOIN invalidated ON"
    " invalidated.trial = trials.id WHERE trials.number BETWEEN ? AND ? ORDER BY trials.number"
)

ALL = (0, 1 << 62)  # the numbers of trials


@contextmanager
def opened(folder: Path) -> Iterator[sqlite3.Connection]:
    """The database with today's tables, all reads from one moment. Raises ConfigError."""
    with as_written(folder) as db:
        check_version(db, folder)
        db.execute("BEGIN")
        yield db


@contextmanager
def as_written(folder: Path) -> Iterator[sqlite3.Connection]:
    """The database in ``folder`` with its own tables. Raises ConfigError where it can't be read."""
    path = database_in(folder)
    try:
        with closing(_connected(path)) as db:
            yield db
    except sqlite3.DatabaseError as error:
        raise ConfigError.plain(
            f"{path} can't be read: {error}. Is it a copy without its -wal file?"
        ) from error


def database_in(folder: Path) -> Path:
    """Raises ConfigError where ``folder`` is no run."""
    if not folder.exists() and folder == Path("latest"):
        where = Path("runs").resolve()
        raise ConfigError.plain(f"there are no runs yet in {where}: teatbench run six-situations")
    if not (folder / DATABASE).is_file():
        near = beside(folder, DATABASE)
        raise ConfigError.plain(f"{folder} is no run: there is no {DATABASE} in it{near}")
    return folder / DATABASE


def check_version(db: sqlite3.Connection, folder: Path) -> None:
    """Raises ConfigError for tables of another schema than this bench's."""
    version = version_of(db)
    if version == SCHEMA_VERSION:
        return
    why = "An older bench wrote it: use that one."
    if version > SCHEMA_VERSION:
        why = "A newer bench wrote it: update this one, or use that one."
    if not version:
        why = "No bench has finished making it: there is nothing in it to read."
    raise ConfigError.plain(
        f"{folder / DATABASE} has schema {version}; this bench has {SCHEMA_VERSION}. {why}"
    )


def _connected(path: Path) -> sqlite3.Connection:
    """A log needs a folder that can be written to; without one a protected copy opens as well."""
    address = f"{path.resolve().as_uri()}?mode=ro"
    try:
        return _asked(address)
    except sqlite3.OperationalError:
        log = path.with_name(path.name + "-wal")
        if log.is_file() and log.stat().st_size:
            raise
        return _asked(f"{address}&immutable=1")


def _asked(address: str) -> sqlite3.Connection:
    """SQLite opens the file at the first query; so one is made here. Raises sqlite3.Error."""
    db = sqlite3.connect(address, uri=True, isolation_level=None)
    try:
        version_of(db)
    except BaseException:
        db.close()
        raise
    return db


def points_mm(rows: Iterable[Row]) -> NDArray[np.float64]:
    """The places (n, 3) of rows that have ``x_mm``, ``y_mm`` and ``z_mm``."""
    places = [(row["x_mm"], row["y_mm"], row["z_mm"]) for row in rows]
    return np.array(places, dtype=np.float64).reshape(-1, 3)


FIRST_LINK = "SELECT wall_digest FROM chain ORDER BY number LIMIT 1"
WALL_KEYS = ("seconds", "in_time", "success")  # parts of a score that depend on real time


@dataclass(frozen=True, slots=True)
class TrialRecord:
    """One finished trial: its rows by table; ``scores`` by detector."""

    head: Row
    frames: Sequence[Row] = ()
    touches: Sequence[Row] = ()
    truth: Sequence[Row] = ()
    detections: Sequence[Row] = ()
    found: Sequence[Row] = ()
    scores: Mapping[str, SceneScore] = field(default_factory=dict)

    @property
    def id(self) -> str:
        """Unique in the run: number, name and repeat."""
        return str(self.head["id"])

    @property
    def pose(self) -> str:
        """Repeats of one pose share this name."""
        return str(self.head["name"])

    @property
    def invalid(self) -> str | None:
        """Why its truth doesn't hold, so that the trial is in no count; None where it holds."""
        reason = self.head["invalid"]
        return None if reason is None else str(reason)

    @property
    def how(self) -> str | None:
        """``touched`` or ``carried``; None of a recording."""
        how = self.truth[0]["how"] if self.truth else None
        return None if how is None else str(how)

    @property
    def score_rows(self) -> list[Row]:
        """Rows of the table ``scores``; what depends on real time stands apart."""
        rows: list[Row] = []
        for detector, score in self.scores.items():
            whole = score.as_dict()
            wall = json.dumps({key: whole.pop(key) for key in WALL_KEYS})
            text = json.dumps(whole)
            rows.append({"trial": self.id, "detector": detector, "score": text, "wall_score": wall})
        return rows


@dataclass(frozen=True, slots=True, eq=False)
class RunRecord:
    """A run as it stands on disk. ``bath`` has columns t_s, temp_c, power_percent (n, 3), by the
    clocks of ``bath_sessions``; ``external_c`` (n,) is nan without a sensor. ``head``: last link
    of the chain, number 0 without one; ``first_link``: the digest of its first, "" without.
    ``holder``: the bench that worked on it as it was read, by its lock. ``guardians``: what those
    did that had to act, by session. ``damage``: what isn't as it was written, with which no verdict
    holds. ``counted_trials``: of a record that was read without its trials and readings.
    """

    folder: Path
    facts: Mapping[str, Any]
    trials: tuple[TrialRecord, ...] = ()
    skipped: tuple[Row, ...] = ()
    checks: tuple[Row, ...] = ()
    events: tuple[Row, ...] = ()
    bath: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    bath_states: tuple[str, ...] = ()
    external_c: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    sessions: int = 1
    guardians: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)
    head: Head | None = None
    damage: tuple[str, ...] = ()
    first_link: str = ""
    holder: Mapping[str, Any] = field(default_factory=dict)
    counted_trials: int | None = None
    bath_sessions: tuple[int, ...] = ()

    @property
    def ending(self) -> str:
        """``finished``, ``aborted``, ``faulted``; ``interrupted`` without one. For programs."""
        return str(self.facts.get("ending", NO_ENDING))

    @property
    def tripped(self) -> bool:
        """Whether an interlock tripped in its last session."""
        last = (event for event in self.events if event.get("session", 1) == self.sessions)
        return any(event["kind"] == TRIP for event in last)

    @property
    def done(self) -> int:
        """How many trials have their result."""
        return len(self.trials) if self.counted_trials is None else self.counted_trials

    @property
    def guardian(self) -> Mapping[str, Any] | None:
        """What the last session's guardian did; None where it had nothing to do."""
        return self.guardians.get(self.sessions)

    @property
    def counted(self) -> tuple[TrialRecord, ...]:
        """The trials that the verdicts are made of: all but those whose truth was invalidated."""
        return tuple(trial for trial in self.trials if trial.invalid is None)

    @property
    def detectors(self) -> tuple[str, ...]:
        return tuple(self.facts["detectors"])


@contextmanager
def read_in(folder: Path) -> Iterator[sqlite3.Connection]:
    """As `opened`; raises ConfigError also for rows that can't be read."""
    try:
        with opened(folder) as db:
            yield db
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        hint = f"'teatbench store check {in_command(folder)}' says what is damaged."
        why = f"{type(error).__name__}: {error}. {hint}"
        raise ConfigError.plain(f"the record in {folder} can't be read: {why}") from error


def read_facts(folder: Path) -> dict[str, Any]:
    """What holds for the whole run in ``folder``. Raises ConfigError, also where it never began."""
    with read_in(folder) as db:
        facts = _facts(db)
    refuse_unbegun(folder, facts)
    return facts


def refuse_unbegun(folder: Path, facts: Mapping[str, Any]) -> None:
    """Raises ConfigError where what a run is was not written down."""
    if "detectors" not in facts:
        why = "the bench died before it wrote down what is under test. Delete the folder."
        raise ConfigError.plain(f"{folder} is a run that never began: {why}")


def read_run(folder: Path, damage: tuple[str, ...] = (), *, whole: bool = True) -> RunRecord:
    """The run in ``folder``; unless ``whole`` without trials and readings. Raises ConfigError."""
    with read_in(folder) as db:
        db.row_factory = sqlite3.Row
        holder = holder_of(folder)  # first: a run that ends from here on has its ending
        facts, events = _facts(db), db.execute("SELECT * FROM events ORDER BY number")
        (done,) = db.execute("SELECT COUNT(*) FROM trials").fetchone()
        sessions = [number for (number,) in db.execute("SELECT number FROM sessions")]
        at_end = {}
        if not holder and facts.get("ending", NO_ENDING) == NO_ENDING:
            at_end = end_in_reserve(folder, max(sessions, default=1))
        record = RunRecord(
            folder=folder,
            facts=facts | at_end.get("facts", {}),
            trials=tuple(_trials(db, *ALL)) if whole else (),
            counted_trials=None if whole else done,
            skipped=tuple(map(dict, db.execute("SELECT * FROM skipped ORDER BY number"))),
            checks=tuple(map(dict, db.execute("SELECT * FROM checks ORDER BY number, teat"))),
            events=(*map(dict, events), *at_end.get("events", ())),
            **_readings(db, -math.inf if whole else math.inf),
            sessions=max(sessions, default=1),
            guardians=_guardians(folder, sessions, facts),
            head=head_of(db),
            damage=damage,
            holder=holder,
            first_link=str(row[0]) if (row := db.execute(FIRST_LINK).fetchone()) else "",
        )
    refuse_unbegun(folder, record.facts)
    return record


def read_trials(folder: Path, first: int, last: int) -> RunRecord:
    """Facts of a run, trials ``first`` to ``last``, readings about these. Raises ConfigError."""
    with opened(folder) as db:
        db.row_factory = sqlite3.Row
        trials = tuple(_trials(db, first, last))
        begun_s = min((one.head["captured_s"] or math.inf for one in trials), default=math.inf)
        return RunRecord(folder, _facts(db), trials, **_readings(db, begun_s - 60.0))


def _facts(db: sqlite3.Connection) -> dict[str, Any]:
    return {key: json.loads(value) for key, value in db.execute("SELECT key, value FROM facts")}


def _readings(db: sqlite3.Connection, since_s: float) -> dict[str, Any]:
    """Bath and external sensor."""
    columns = "t_s, temp_c, power_percent, external_c, state, session"
    query = f"SELECT {columns} FROM bath WHERE t_s >= ? ORDER BY session, t_s"  # noqa: S608
    bath = db.execute(query, (since_s,)).fetchall()
    table = np.array([tuple(row)[:4] for row in bath], dtype=np.float64).reshape(-1, 4)
    more = {f"bath_{name}s": tuple(row[name] for row in bath) for name in ("state", "session")}
    return {"bath": table[:, :3], "external_c": table[:, 3], **more}


def guardian_files(folder: Path) -> dict[str, Mapping[str, Any]]:
    """What guardians wrote, by the file's name: they write whole files. Raises ConfigError."""
    found: dict[str, Mapping[str, Any]] = {}
    for path in sorted(folder.glob(GUARDIAN_FILES)):
        try:
            found[path.name] = dict(json.loads(path.read_text(encoding="utf-8")))
        except ValueError as error:
            raise ConfigError.plain(
                f"{path} can't be read: {error}. Delete it to see the rest of the run."
            ) from error
    return found


def _guardians(
    folder: Path, sessions: Iterable[int], facts: Mapping[str, Any]
) -> dict[int, Mapping[str, Any]]:
    """What they wrote, by session."""
    files = guardian_files(folder)
    names = {number: f"{GUARDIAN.format(number)}.json" for number in sorted(sessions)}
    records = {n: files.get(of) or facts.get(GUARDIAN_FACT.format(of)) for n, of in names.items()}
    return {number: record for number, record in records.items() if record}


def _trials(db: sqlite3.Connection, *numbers: int) -> Iterator[TrialRecord]:
    """Those of the numbers from the first to the last."""
    those = "trial IN (SELECT id FROM trials WHERE number BETWEEN ? AND ?)"
    by_table: dict[str, dict[str, list[Row]]] = {table: {} for table in OF_A_TRIAL}
    for table, grouped in by_table.items():
        for row in db.execute(f"SELECT * FROM {table} WHERE {those} ORDER BY rowid", numbers):  # noqa: S608 - our own names
            grouped.setdefault(row["trial"], []).append(dict(row))
    for head in db.execute(HEADS, numbers):
        rows = {table: tuple(grouped.get(head["id"], ())) for table, grouped in by_table.items()}
        scores = {
            row["detector"]: scene_from_dict(
                {**json.loads(row["score"]), **json.loads(row["wall_score"])}
            )
            for row in rows.pop("scores")
        }
        yield TrialRecord(dict(head), scores=scores, **rows)
