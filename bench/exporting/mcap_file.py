"""A run as one MCAP file (mcap.dev/spec): frames, bath, stage, arm, truth, detections and events on one time line.

The time line is the bench's own clock, set to the time of day at which its session began, so that intervals are the bench's; what has no
time on that clock stands at its time of day. Frames are checked against their SHA-256; those of 8 bits go in byte for byte. Messages are
Protocol Buffers, for that is what all three viewers draw: Lichtblick takes JSON only with simple schemas, rerun not at all.
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
from bench.exporting import messages, schemas
from bench.exporting.libraries import needed
from bench.exporting.messages import NS
from bench.exporting.protobuf import MessageType, described, encoded
from bench.rig import read_calibration
from bench.store.reading import opened
from detector.calibration.values import Calibration

FRAMES_OF = {"left": "left", "right": "right", "thermal": "thermal", "thermal_radiometric": "thermal"}  # pictures of cameras
RADIOMETRIC = "thermal_radiometric"
NAME, CALIBRATION = "run.mcap", "calibration.toml"


@dataclass(frozen=True, slots=True)
class Message:
    """``make`` gives what stands in the file; frames are read only then."""

    time_ns: int
    topic: str
    kind: MessageType
    make: Callable[[int], messages.Message]


def export_mcap(run: Path, out: Path) -> list[Path]:
    """Write ``out/run.mcap``; gives back the file. Raises ConfigError without the library or with a damaged frame; OSError."""
    library = needed("mcap.writer", "MCAP")
    known = read_calibration(run / CALIBRATION) if (run / CALIBRATION).is_file() else None
    with opened(run) as db:
        db.row_factory = sqlite3.Row
        found = sorted(_messages(db, run, _Times(db)), key=lambda message: message.time_ns)
        facts = {row["key"]: row["value"] for row in db.execute("SELECT key, value FROM facts ORDER BY key")}
    first_ns = min((message.time_ns for message in found), default=0)
    found = [*_cameras(known, first_ns), *found] if known else found
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
    numbers: dict[str, int] = {}
    channels: dict[str, int] = {}
    for message in found:
        name = message.kind.full_name
        if name not in numbers:
            numbers[name] = writer.register_schema(name=name, encoding="protobuf", data=described(message.kind))
        if message.topic not in channels:
            channels[message.topic] = writer.register_channel(message.topic, "protobuf", numbers[name])
        data = encoded(message.kind, message.make(message.time_ns))
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
        yield Message(times.of(row["session"], row["t_s"], row["wall_time"]), "/events", schemas.LOG, partial(messages.log, event=row))
    for row in db.execute("SELECT * FROM bath"):
        yield Message(times.of(row["session"], row["t_s"], row["wall_time"]), "/bath", schemas.BATH, partial(messages.bath, row=row))
    query = "SELECT trials.*, invalidated.reason AS invalid FROM trials LEFT JOIN invalidated ON invalidated.trial = trials.id"
    for head in db.execute(query).fetchall():
        captured = times.of(head["session"], head["captured_s"], head["wall_time"])
        yield Message(captured, "/trial", schemas.TRIAL, partial(messages.trial, row=head))
        if head["stage_mm"]:
            make = partial(messages.point, frame="stage", at_mm=json.loads(head["stage_mm"]))
            yield Message(captured, "/stage", schemas.POSE_IN_FRAME, make)
        yield from _touches(db, head, times)
        yield from _ends(db, head["id"], captured)
        yield from _frames(db, run, head, times)


def _touches(db: sqlite3.Connection, head: sqlite3.Row, times: _Times) -> Iterator[Message]:
    for row in db.execute("SELECT * FROM touches WHERE trial = ?", (head["id"],)):
        make = partial(messages.point, frame="world", at_mm=(row["x_mm"], row["y_mm"], row["z_mm"]))
        yield Message(times.of(head["session"], row["t_s"], row["wall_time"]), "/arm", schemas.POSE_IN_FRAME, make)


def _ends(db: sqlite3.Connection, trial: str, captured: int) -> Iterator[Message]:
    """Teat ends as they are and as each detector found them, at the moment of the frames."""
    places = [("/truth", db.execute("SELECT * FROM truth WHERE trial = ?", (trial,)).fetchall())]
    for row in db.execute("SELECT * FROM detections WHERE trial = ?", (trial,)).fetchall():
        name, key = row["detector"], (trial, row["detector"])
        found = db.execute("SELECT * FROM found WHERE trial = ? AND detector = ?", key).fetchall()
        score = db.execute("SELECT * FROM scores WHERE trial = ? AND detector = ?", key).fetchone()
        places.append((f"/detections/{name}", found))
        yield Message(captured, f"/answers/{name}", schemas.ANSWER, partial(messages.answer, row=row, score=score))
    for topic, rows in places:
        yield Message(captured, topic, schemas.POSES_IN_FRAME, partial(messages.points, frame="world", rows=rows))


def _frames(db: sqlite3.Connection, run: Path, head: sqlite3.Row, times: _Times) -> Iterator[Message]:
    """A detector's pictures of its stages have no frame of reference that is known; they go by their own name."""
    for row in db.execute("SELECT * FROM frames WHERE trial = ?", (head["id"],)):
        picture = row["camera"]
        exposed_s = head["captured_s"] if row["exposed_s"] is None else row["exposed_s"]
        topic = f"/cameras/{picture}" if picture in FRAMES_OF else f"/stages/{picture}"
        kind = schemas.RAW_IMAGE if picture == RADIOMETRIC else schemas.COMPRESSED_IMAGE
        make = partial(_image, run=run, frame=FRAMES_OF.get(picture, picture), row=row)
        yield Message(times.of(head["session"], exposed_s, head["wall_time"]), topic, kind, make)


def _image(time_ns: int, run: Path, frame: str, row: sqlite3.Row) -> messages.Message:
    path = run / row["path"]
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError.plain(f"{path} can't be read: {error.strerror or error}") from error
    if hashlib.sha256(data).hexdigest() != row["sha256"]:
        raise ConfigError.plain(f"{path} is not as it was written: 'teatbench store check {run}' says what else is not")
    try:
        return (messages.raw_image if row["camera"] == RADIOMETRIC else messages.image)(time_ns, frame, data)
    except ValueError as error:
        raise ConfigError.plain(f"{path} can't be exported: {error}") from error


def _cameras(known: Calibration, time_ns: int) -> Iterator[Message]:
    """The cameras' places and lenses, once, before all else. A mirrored picture has no lens that viewers could draw with."""
    yield Message(time_ns, "/tf", schemas.FRAME_TRANSFORMS, partial(messages.frames_of_reference, known=known))
    thermal = None if known.thermal.mirrored else known.thermal.lens
    for name, lens in (("left", known.left), ("right", known.right), ("thermal", thermal)):
        if lens is not None:
            yield Message(time_ns, f"/lenses/{name}", schemas.CAMERA_CALIBRATION, partial(messages.camera, frame=name, lens=lens))
