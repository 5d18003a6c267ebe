"""A run as one MCAP file (mcap.dev/spec): frames, bath, stage, arm, truth, detections and events on one time line.

The time line is the bench's own clock, set to the time of day at which its session began, so that intervals are the bench's; what has no
time on that clock stands at its time of day. Frames are checked against their SHA-256 and go in byte for byte. Messages are JSON.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from bench.config import ConfigError
from bench.exporting import messages
from bench.exporting.libraries import needed
from bench.exporting.messages import NS, SCHEMAS, Json
from bench.store.reading import opened

CAMERAS = ("left", "right", "thermal", "thermal_radiometric")
NAME = "run.mcap"


@dataclass(frozen=True, slots=True)
class Message:
    """``make`` gives what stands in the file; frames are read only then."""

    time_ns: int
    topic: str
    schema: str
    make: Callable[[int], Json]


def export_mcap(run: Path, out: Path) -> list[Path]:
    """Write ``out/run.mcap``; gives back the file. Raises ConfigError without the library or with a damaged frame; OSError."""
    library = needed("mcap.writer", "MCAP")
    with opened(run) as db:
        db.row_factory = sqlite3.Row
        found = sorted(_messages(db, run, _Times(db)), key=lambda message: message.time_ns)
        facts = {row["key"]: row["value"] for row in db.execute("SELECT key, value FROM facts ORDER BY key")}
    out.mkdir(parents=True, exist_ok=True)
    part = out / f"{NAME}.part"
    try:
        with part.open("wb") as file:
            _write(library.Writer(file), found, facts)
        part.replace(out / NAME)
    finally:
        part.unlink(missing_ok=True)
    return [out / NAME]


def _write(writer: Any, found: list[Message], facts: Mapping[str, str]) -> None:
    writer.start(profile="", library="teatbench")
    writer.add_metadata("teatbench", dict(facts))
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    for message in found:
        if message.schema not in schemas:
            data = json.dumps(SCHEMAS[message.schema]).encode()
            schemas[message.schema] = writer.register_schema(name=message.schema, encoding="jsonschema", data=data)
        if message.topic not in channels:
            channels[message.topic] = writer.register_channel(message.topic, "json", schemas[message.schema])
        data = json.dumps(message.make(message.time_ns), ensure_ascii=False).encode()
        writer.add_message(channels[message.topic], log_time=message.time_ns, publish_time=message.time_ns, data=data)
    writer.finish()


class _Times:
    """When things were, as nanoseconds of the time of day."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._start_ns: dict[int, int] = {}
        for session, t_s, wall in db.execute("SELECT session, t_s, wall_time FROM events WHERE t_s IS NOT NULL ORDER BY number"):
            self._start_ns.setdefault(session, _ns(wall) - round(t_s * NS))

    def of(self, session: int, t_s: float | None, wall: str | None) -> int:
        """By the bench's clock where that was set, else by the time of day, else 0."""
        start = self._start_ns.get(session)
        return _ns(wall) if t_s is None or start is None else start + round(t_s * NS)


def _ns(wall: str | None) -> int:
    try:
        return round(datetime.fromisoformat(wall or "").timestamp() * NS)
    except ValueError:
        return 0


def _messages(db: sqlite3.Connection, run: Path, times: _Times) -> Iterator[Message]:
    for row in db.execute("SELECT * FROM events"):
        yield Message(times.of(row["session"], row["t_s"], row["wall_time"]), "/events", "foxglove.Log", partial(messages.log, event=row))
    for row in db.execute("SELECT * FROM bath"):
        yield Message(times.of(row["session"], row["t_s"], row["wall_time"]), "/bath", "teatbench.Bath", partial(messages.bath, row=row))
    query = "SELECT trials.*, invalidated.reason AS invalid FROM trials LEFT JOIN invalidated ON invalidated.trial = trials.id"
    for head in db.execute(query).fetchall():
        captured = times.of(head["session"], head["captured_s"], head["wall_time"])
        yield Message(captured, "/trial", "teatbench.Trial", partial(messages.trial, row=head))
        if head["stage_mm"]:
            make = partial(messages.point, frame="stage", at_mm=json.loads(head["stage_mm"]))
            yield Message(captured, "/stage", "foxglove.PoseInFrame", make)
        yield from _touches(db, head, times)
        yield from _ends(db, head["id"], captured)
        yield from _frames(db, run, head, times)


def _touches(db: sqlite3.Connection, head: sqlite3.Row, times: _Times) -> Iterator[Message]:
    for row in db.execute("SELECT * FROM touches WHERE trial = ?", (head["id"],)):
        make = partial(messages.point, frame="world", at_mm=(row["x_mm"], row["y_mm"], row["z_mm"]))
        yield Message(times.of(head["session"], row["t_s"], row["wall_time"]), "/arm", "foxglove.PoseInFrame", make)


def _ends(db: sqlite3.Connection, trial: str, captured: int) -> Iterator[Message]:
    """Teat ends as they are and as each detector found them, at the moment of the frames."""
    places = [("/truth", db.execute("SELECT * FROM truth WHERE trial = ?", (trial,)).fetchall())]
    for row in db.execute("SELECT * FROM detections WHERE trial = ?", (trial,)).fetchall():
        name, key = row["detector"], (trial, row["detector"])
        found = db.execute("SELECT * FROM found WHERE trial = ? AND detector = ?", key).fetchall()
        score = db.execute("SELECT * FROM scores WHERE trial = ? AND detector = ?", key).fetchone()
        places.append((f"/detections/{name}", found))
        yield Message(captured, f"/answers/{name}", "teatbench.Answer", partial(messages.answer, row=row, score=score))
    for topic, rows in places:
        yield Message(captured, topic, "foxglove.PosesInFrame", partial(messages.points, frame="world", rows=rows))


def _frames(db: sqlite3.Connection, run: Path, head: sqlite3.Row, times: _Times) -> Iterator[Message]:
    for row in db.execute("SELECT * FROM frames WHERE trial = ?", (head["id"],)):
        exposed_s = head["captured_s"] if row["exposed_s"] is None else row["exposed_s"]
        topic = f"/cameras/{row['camera']}" if row["camera"] in CAMERAS else f"/stages/{row['camera']}"
        make = partial(_image, run=run, camera=row["camera"], path=row["path"], sha256=row["sha256"])
        yield Message(times.of(head["session"], exposed_s, head["wall_time"]), topic, "foxglove.CompressedImage", make)


def _image(time_ns: int, run: Path, camera: str, path: str, sha256: str) -> Json:
    try:
        data = (run / path).read_bytes()
    except OSError as error:
        raise ConfigError.plain(f"{run / path} can't be read: {error.strerror or error}") from error
    if hashlib.sha256(data).hexdigest() != sha256:
        raise ConfigError.plain(f"{run / path} is not as it was written: 'teatbench store check {run}' says what else is not")
    return messages.image(time_ns, camera, data)
