"""As much of Protocol Buffers as writing takes: values of a message to bytes, and messages
described to whoever reads those bytes.

A message is a table of fields; the messages that describe messages (descriptor.proto) are such
tables themselves, so that one encoder does for both. Fields that hold their kind's zero are left
out, as proto3 does. Source: protobuf.dev, "Encoding" and "Proto3 specification"; numbers of
descriptor.proto from protobuf's own. Pure; knows no message but those that describe.

What messages of an exported time line look like: Foxglove's published schemas, and a few of our
own.

Foxglove's are the Protobuf ones, which Foxglove, Lichtblick and rerun all read (rerun draws no
others): names, numbers and kinds of fields as published (github.com/foxglove/foxglove-sdk,
schemas/proto/foxglove; numbers don't follow the order there). Of ours every viewer can draw the
numbers: NaN is what was not measured, an empty text what was not said. No field is an `int64`,
which viewers in a browser read as something other than a number. Pure tables.

Rows of a run as the messages that `schemas` describes: values by field, ready to be encoded.

Lengths are metres here, as those schemas ask, and only here; frames of reference are those of the
bench (`world`, `stage`, `left`, `right`, `thermal`). A pose without a direction has the unit
quaternion. Pure: rows in, values out.

A run as one MCAP file (mcap.dev/spec): frames, bath, stage, arm, truth, detections and events on
one time line.

The time line is the bench's own clock, set to the time of day at which its session began, so that
intervals are the bench's; what has no time on that clock stands at its time of day. Frames are
checked against their SHA-256; those of 8 bits go in byte for byte. Messages are Protocol Buffers,
for that is what all three viewers draw: Lichtblick takes JSON only with simple schemas, rerun not
at all.
"""

from __future__ import annotations

import hashlib
import json
import math
import sqlite3
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from bench.config import ConfigError, read_calibration
from bench.record.reader import opened
from bench.record.tables import needed
from detector.calibration.values import Calibration
from detector.geometry import Camera, Motion

Values = Mapping[str, Any]
VARINT, EIGHT_BYTES, COUNTED, FOUR_BYTES = 0, 1, 2, 5  # wire types
OPTIONAL, REPEATED = 1, 3  # FieldDescriptorProto.Label


class Kind(IntEnum):
    """FieldDescriptorProto.Type, as far as it is needed."""

    DOUBLE = 1
    INT64 = 3
    INT32 = 5
    FIXED32 = 7
    STRING = 9
    MESSAGE = 11
    BYTES = 12
    UINT32 = 13
    ENUM = 14


WIRE = {
    Kind.DOUBLE: EIGHT_BYTES,
    Kind.FIXED32: FOUR_BYTES,
    Kind.STRING: COUNTED,
    Kind.BYTES: COUNTED,
    Kind.MESSAGE: COUNTED,
}


@dataclass(frozen=True, slots=True)
class Choice:
    """An enumeration within a message: names to numbers."""

    name: str
    numbers: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message. ``of`` is the message or the enumeration that it holds; ``always``:
    written even where it is zero.
    """

    name: str
    number: int
    kind: Kind
    of: MessageType | Choice | None = None
    repeated: bool = False
    always: bool = False


@dataclass(frozen=True, slots=True)
class MessageType:
    """A message by its full name; each stands in a file of its own."""

    full_name: str
    fields: tuple[Field, ...]

    @property
    def package(self) -> str:
        """All before its name."""
        return self.full_name.rpartition(".")[0]

    @property
    def name(self) -> str:
        """Without its package."""
        return self.full_name.rpartition(".")[2]

    @property
    def file(self) -> str:
        """Where others find it; Google's own have small letters."""
        name = self.name.lower() if self.package == "google.protobuf" else self.name
        return f"{self.package.replace('.', '/')}/{name}.proto"


def encoded(kind: MessageType, values: Values) -> bytes:
    """The message with these ``values`` by field; what is missing has its default. Raises KeyError
    for a value that no field has.

    Fields go in the order of their numbers, as other encoders write them.
    """
    unknown = values.keys() - {field.name for field in kind.fields}
    if unknown:
        raise KeyError(f"{kind.full_name} has no {', '.join(sorted(unknown))}")
    in_order = sorted(kind.fields, key=lambda field: field.number)
    return b"".join(
        part
        for field in in_order
        if field.name in values
        for part in _field(field, values[field.name])
    )


def described(kind: MessageType) -> bytes:
    """A FileDescriptorSet with the message and all that it holds, each after what it needs."""
    files = [
        {"name": one.file, "package": one.package, **_contents(one)} for one in _with_needs(kind)
    ]
    return encoded(FILE_SET, {"file": files})


def _field(field: Field, value: Any) -> Iterator[bytes]:
    if field.repeated and field.kind is Kind.DOUBLE:  # packed
        if value:
            yield _key(field.number, COUNTED) + _counted(struct.pack(f"<{len(value)}d", *value))
    elif field.repeated:
        yield from (_key(field.number, COUNTED) + _one(field, item) for item in value)
    elif value or field.always or field.kind is Kind.MESSAGE:
        yield _key(field.number, WIRE.get(field.kind, VARINT)) + _one(field, value)


def _one(field: Field, value: Any) -> bytes:
    match field.kind:
        case Kind.DOUBLE:
            return struct.pack("<d", value)
        case Kind.FIXED32:
            return struct.pack("<I", value)
        case Kind.STRING:
            return _counted(value.encode())
        case Kind.BYTES:
            return _counted(value)
        case Kind.MESSAGE if isinstance(field.of, MessageType):
            return _counted(encoded(field.of, value))
    return _varint(value)


def _key(number: int, wire: int) -> bytes:
    return _varint(number << 3 | wire)


def _counted(data: bytes) -> bytes:
    return _varint(len(data)) + data


def _varint(value: int) -> bytes:
    """Seven bits a byte, lowest first; negative numbers as 64-bit two's complement."""
    left, found = value & (1 << 64) - 1, bytearray()
    while left > 0x7F:
        found.append(left & 0x7F | 0x80)
        left >>= 7
    return bytes([*found, left])


def _with_needs(kind: MessageType) -> list[MessageType]:
    found: dict[str, MessageType] = {}
    for field in kind.fields:
        if isinstance(field.of, MessageType):
            found |= {one.full_name: one for one in _with_needs(field.of)}
    return [*found.values(), kind]


def _contents(kind: MessageType) -> Values:
    needs = sorted({field.of.file for field in kind.fields if isinstance(field.of, MessageType)})
    choices = [field.of for field in kind.fields if isinstance(field.of, Choice)]
    enums = [
        {
            "name": one.name,
            "value": [{"name": name, "number": n} for name, n in one.numbers.items()],
        }
        for one in choices
    ]
    message = {
        "name": kind.name,
        "field": [_about(kind, field) for field in kind.fields],
        "enum_type": enums,
    }
    return {"dependency": needs, "message_type": [message], "syntax": "proto3"}


def _about(kind: MessageType, field: Field) -> Values:
    label = REPEATED if field.repeated else OPTIONAL
    about = {
        "name": field.name,
        "number": field.number,
        "label": label,
        "type": int(field.kind),
        "json_name": _camel(field.name),
    }
    if isinstance(field.of, MessageType):
        return {**about, "type_name": f".{field.of.full_name}"}
    return {**about, "type_name": f".{kind.full_name}.{field.of.name}"} if field.of else about


def _camel(name: str) -> str:
    first, *others = name.split("_")
    return first + "".join(word.capitalize() for word in others)


def _described(name: str, *fields: Field) -> MessageType:
    return MessageType(f"google.protobuf.{name}", fields)


def _texts(name: str, number: int) -> Field:
    return Field(name, number, Kind.STRING)


def _messages(name: str, number: int, of: MessageType) -> Field:
    return Field(name, number, Kind.MESSAGE, of, repeated=True)


def _numbers(fields: Sequence[tuple[str, int]]) -> list[Field]:
    return [Field(name, number, Kind.INT32, always=True) for name, number in fields]


_NUMBERS_OF_FIELD = _numbers((("number", 3), ("label", 4), ("type", 5)))
FIELD = _described(
    "FieldDescriptorProto",
    _texts("name", 1),
    *_NUMBERS_OF_FIELD,
    _texts("type_name", 6),
    _texts("json_name", 10),
)
ENUM_VALUE = _described("EnumValueDescriptorProto", _texts("name", 1), *_numbers([("number", 2)]))
ENUM = _described("EnumDescriptorProto", _texts("name", 1), _messages("value", 2, ENUM_VALUE))
MESSAGE = _described(
    "DescriptorProto",
    _texts("name", 1),
    _messages("field", 2, FIELD),
    _messages("enum_type", 4, ENUM),
)
FILE = _described(
    "FileDescriptorProto",
    _texts("name", 1),
    _texts("package", 2),
    Field("dependency", 3, Kind.STRING, repeated=True),
    _messages("message_type", 4, MESSAGE),
    _texts("syntax", 12),
)
FILE_SET = _described("FileDescriptorSet", _messages("file", 1, FILE))


def _message(name: str, *fields: tuple[str, int, Kind] | Field) -> MessageType:
    return MessageType(
        name, tuple(field if isinstance(field, Field) else Field(*field) for field in fields)
    )


def _holds(name: str, number: int, of: MessageType, *, repeated: bool = False) -> Field:
    return Field(name, number, Kind.MESSAGE, of, repeated)


def _rows(name: str, number: int) -> Field:
    return Field(name, number, Kind.DOUBLE, repeated=True)


TIMESTAMP = _message(
    "google.protobuf.Timestamp", ("seconds", 1, Kind.INT64), ("nanos", 2, Kind.INT32)
)
_TIME = _holds("timestamp", 1, TIMESTAMP)
VECTOR = _message(
    "foxglove.Vector3", ("x", 1, Kind.DOUBLE), ("y", 2, Kind.DOUBLE), ("z", 3, Kind.DOUBLE)
)
QUATERNION = _message(
    "foxglove.Quaternion", *((name, number, Kind.DOUBLE) for number, name in enumerate("xyzw", 1))
)
POSE = _message(
    "foxglove.Pose", _holds("position", 1, VECTOR), _holds("orientation", 2, QUATERNION)
)
LEVEL = Choice("Level", {"UNKNOWN": 0, "DEBUG": 1, "INFO": 2, "WARNING": 3, "ERROR": 4, "FATAL": 5})

COMPRESSED_IMAGE = _message(
    "foxglove.CompressedImage",
    _TIME,
    ("frame_id", 4, Kind.STRING),
    ("data", 2, Kind.BYTES),
    ("format", 3, Kind.STRING),
)
RAW_IMAGE = _message(
    "foxglove.RawImage",
    _TIME,
    ("frame_id", 7, Kind.STRING),
    ("width", 2, Kind.FIXED32),
    ("height", 3, Kind.FIXED32),
    ("encoding", 4, Kind.STRING),
    ("step", 5, Kind.FIXED32),
    ("data", 6, Kind.BYTES),
)
CAMERA_CALIBRATION = _message(
    "foxglove.CameraCalibration",
    _TIME,
    ("frame_id", 9, Kind.STRING),
    ("width", 2, Kind.FIXED32),
    ("height", 3, Kind.FIXED32),
    ("distortion_model", 4, Kind.STRING),
    _rows("D", 5),
    _rows("K", 6),
    _rows("R", 7),
    _rows("P", 8),
)
FRAME_TRANSFORM = _message(
    "foxglove.FrameTransform",
    _TIME,
    ("parent_frame_id", 2, Kind.STRING),
    ("child_frame_id", 3, Kind.STRING),
    _holds("translation", 4, VECTOR),
    _holds("rotation", 5, QUATERNION),
)
FRAME_TRANSFORMS = _message(
    "foxglove.FrameTransforms", _holds("transforms", 1, FRAME_TRANSFORM, repeated=True)
)
POSE_IN_FRAME = _message(
    "foxglove.PoseInFrame", _TIME, ("frame_id", 2, Kind.STRING), _holds("pose", 3, POSE)
)
POSES_IN_FRAME = _message(
    "foxglove.PosesInFrame",
    _TIME,
    ("frame_id", 2, Kind.STRING),
    _holds("poses", 3, POSE, repeated=True),
)
LOG = _message(
    "foxglove.Log",
    _TIME,
    Field("level", 2, Kind.ENUM, LEVEL),
    ("message", 3, Kind.STRING),
    ("name", 4, Kind.STRING),
    ("file", 5, Kind.STRING),
    ("line", 6, Kind.FIXED32),
)

BATH = _message(
    "teatbench.Bath",
    _TIME,
    ("temp_c", 2, Kind.DOUBLE),
    ("external_c", 3, Kind.DOUBLE),
    ("power_percent", 4, Kind.DOUBLE),
    ("state", 5, Kind.STRING),
)
ANSWER = _message(
    "teatbench.Answer",
    _TIME,
    ("trial", 2, Kind.STRING),
    ("detector", 3, Kind.STRING),
    ("outcome", 4, Kind.STRING),
    ("hidden", 5, Kind.UINT32),
    ("reason", 6, Kind.STRING),
    ("seconds", 7, Kind.DOUBLE),
    ("success", 8, Kind.DOUBLE),
    ("max_error_mm", 9, Kind.DOUBLE),
)
TRIAL = _message(
    "teatbench.Trial",
    _TIME,
    ("id", 2, Kind.STRING),
    ("number", 3, Kind.UINT32),
    ("name", 4, Kind.STRING),
    ("situation", 5, Kind.STRING),
    ("repeat", 6, Kind.UINT32),
    ("bath_c", 7, Kind.DOUBLE),
    ("bath_state", 8, Kind.STRING),
    ("invalid", 9, Kind.STRING),
)

SCHEMAS = {
    kind.full_name: kind
    for kind in (
        COMPRESSED_IMAGE,
        RAW_IMAGE,
        CAMERA_CALIBRATION,
        FRAME_TRANSFORMS,
        POSE_IN_FRAME,
        POSES_IN_FRAME,
        LOG,
        BATH,
        ANSWER,
        TRIAL,
    )
}


Row = Mapping[str, Any]
Message = Mapping[str, Any]
NS = 1_000_000_000
MM_PER_M = 1000.0
UNIT = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}

_LEVELS = {
    "trip": "ERROR",
    "fault": "ERROR",
    "aborted": "WARNING",
    "camera": "WARNING",
    "skipped": "WARNING",
    "repeated": "WARNING",
}


def stamp(time_ns: int) -> Message:
    """A google.protobuf.Timestamp."""
    return {"seconds": time_ns // NS, "nanos": time_ns % NS}


def image(time_ns: int, frame: str, png: bytes) -> Message:
    """A frame, byte for byte as its file holds it."""
    return {"timestamp": stamp(time_ns), "frame_id": frame, "data": png, "format": "png"}


def raw_image(time_ns: int, frame: str, png: bytes) -> Message:
    """A frame of 16 bits pixel by pixel: viewers let one choose what is black and what is white,
    which they don't for a PNG.

    Raises ValueError where it is no picture of 16 bits.
    """
    pixels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED) if png else None
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise ValueError("it is no grey picture of 16 bits")
    height, width = pixels.shape
    about = {"width": width, "height": height, "encoding": "mono16", "step": 2 * width}
    return {
        "timestamp": stamp(time_ns),
        "frame_id": frame,
        **about,
        "data": pixels.astype("<u2").tobytes(),
    }


def camera(time_ns: int, frame: str, lens: Camera) -> Message:
    """A camera as Bouguet, OpenCV and the ROS model plumb_bob have it: K row by row, D = (k1, k2,
    p1, p2, k3).
    """
    (fx, fy), (cx, cy) = lens.fc, lens.cc
    rows = [[fx, lens.alpha_c * fx, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    return {
        "timestamp": stamp(time_ns),
        "frame_id": frame,
        "width": lens.image_size[0],
        "height": lens.image_size[1],
        "distortion_model": "plumb_bob",
        "D": list(lens.kc),
        "K": [value for row in rows for value in row],
        "R": np.eye(3).ravel().tolist(),
        "P": [value for row in rows for value in (*row, 0.0)],
    }


def frames_of_reference(time_ns: int, known: Calibration) -> Message:
    """Where the cameras are in the world: the right one first, to which the left is tied, and the
    thermal one to that.
    """
    motions = [("world", "right", known.world_from_right), ("right", "left", known.right_from_left)]
    if known.thermal_from_left is not None:
        motions.append(("left", "thermal", known.thermal_from_left.inverse()))
    return {
        "transforms": [
            _transform(time_ns, parent, child, motion) for parent, child, motion in motions
        ]
    }


def _transform(time_ns: int, parent: str, child: str, parent_from_child: Motion) -> Message:
    x, y, z, w = (float(value) for value in Rotation.from_matrix(parent_from_child.R).as_quat())
    ids = {"parent_frame_id": parent, "child_frame_id": child}
    return {
        "timestamp": stamp(time_ns),
        **ids,
        "translation": _metres(parent_from_child.T),
        "rotation": {"x": x, "y": y, "z": z, "w": w},
    }


def point(time_ns: int, frame: str, at_mm: Sequence[float]) -> Message:
    """One place in ``frame``."""
    return {"timestamp": stamp(time_ns), "frame_id": frame, "pose": _pose(at_mm)}


def points(time_ns: int, frame: str, rows: Sequence[Row]) -> Message:
    """Places in ``frame``, of rows with x_mm, y_mm, z_mm."""
    return {
        "timestamp": stamp(time_ns),
        "frame_id": frame,
        "poses": [_pose((row["x_mm"], row["y_mm"], row["z_mm"])) for row in rows],
    }


def log(time_ns: int, event: Row) -> Message:
    """A row of ``events``."""
    level = LEVEL.numbers[_LEVELS.get(event["kind"], "INFO")]
    return {
        "timestamp": stamp(time_ns),
        "level": level,
        "message": event["text"],
        "name": event["kind"],
    }


def bath(time_ns: int, row: Row) -> Message:
    """A row of ``bath``."""
    figures = {key: _number(row[key]) for key in ("temp_c", "external_c", "power_percent")}
    return {"timestamp": stamp(time_ns), **figures, "state": row["state"]}


def answer(time_ns: int, row: Row, score: Row | None) -> Message:
    """A row of ``detections`` with its ``scores``; ``success`` is 1 or 0."""
    wall = json.loads(score["wall_score"]) if score else {}
    errors = json.loads(score["score"]).get("radial_mm", []) if score else []
    return {
        "timestamp": stamp(time_ns),
        **{key: row[key] for key in ("trial", "detector", "outcome", "hidden")},
        "reason": row["reason"] or "",
        "seconds": row["wall_seconds"],
        "success": _number(wall.get("success")),
        "max_error_mm": _number(max(errors, default=None)),
    }


def trial(time_ns: int, row: Row) -> Message:
    """A row of ``trials``."""
    texts = {key: row[key] or "" for key in ("bath_state", "invalid")}
    names = {key: row[key] for key in ("id", "number", "name", "situation", "repeat")}
    return {"timestamp": stamp(time_ns), **names, "bath_c": _number(row["bath_c"]), **texts}


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _pose(at_mm: Sequence[float]) -> Message:
    return {"position": _metres(at_mm), "orientation": UNIT}


def _metres(at_mm: Sequence[float] | np.ndarray[Any, Any]) -> Message:
    x, y, z = (float(value) / MM_PER_M for value in at_mm)
    return {"x": x, "y": y, "z": z}


# pictures of cameras
FRAMES_OF = {
    "left": "left",
    "right": "right",
    "thermal": "thermal",
    "thermal_radiometric": "thermal",
}
RADIOMETRIC = "thermal_radiometric"
NAME, CALIBRATION = "run.mcap", "calibration.toml"


@dataclass(frozen=True, slots=True)
class TimedMessage:
    """``make`` gives what stands in the file; frames are read only then."""

    time_ns: int
    topic: str
    kind: MessageType
    make: Callable[[int], Message]


def export_mcap(run: Path, out: Path) -> list[Path]:
    """Write ``out/run.mcap``; gives back the file. Raises ConfigError without the library or with a
    damaged frame; OSError.
    """
    library = needed("mcap.writer", "MCAP")
    known = read_calibration(run / CALIBRATION) if (run / CALIBRATION).is_file() else None
    with opened(run) as db:
        db.row_factory = sqlite3.Row
        found = sorted(_run_messages(db, run, _Times(db)), key=lambda message: message.time_ns)
        facts = {
            row["key"]: row["value"]
            for row in db.execute("SELECT key, value FROM facts ORDER BY key")
        }
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


def _write(writer: Any, found: list[TimedMessage], facts: Mapping[str, str]) -> None:
    writer.start(profile="", library="teatbench")
    writer.add_metadata("teatbench", dict(facts))
    numbers: dict[str, int] = {}
    channels: dict[str, int] = {}
    for message in found:
        name = message.kind.full_name
        if name not in numbers:
            numbers[name] = writer.register_schema(
                name=name, encoding="protobuf", data=described(message.kind)
            )
        if message.topic not in channels:
            channels[message.topic] = writer.register_channel(
                message.topic, "protobuf", numbers[name]
            )
        data = encoded(message.kind, message.make(message.time_ns))
        writer.add_message(
            channels[message.topic],
            log_time=message.time_ns,
            publish_time=message.time_ns,
            data=data,
        )
    writer.finish()


class _Times:
    """When things were, as nanoseconds of the time of day."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._start_ns: dict[int, int] = {}
        for session, t_s, wall in db.execute(
            "SELECT session, t_s, wall_time FROM events WHERE t_s IS NOT NULL ORDER BY number"
        ):
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


def _run_messages(db: sqlite3.Connection, run: Path, times: _Times) -> Iterator[TimedMessage]:
    for row in db.execute("SELECT * FROM events"):
        yield TimedMessage(
            times.of(row["session"], row["t_s"], row["wall_time"]),
            "/events",
            LOG,
            partial(log, event=row),
        )
    for row in db.execute("SELECT * FROM bath"):
        yield TimedMessage(
            times.of(row["session"], row["t_s"], row["wall_time"]),
            "/bath",
            BATH,
            partial(bath, row=row),
        )
    query = (
        "SELECT trials.*, invalidated.reason AS invalid FROM trials LEFT JOIN invalidated ON"
        " invalidated.trial = trials.id"
    )
    for head in db.execute(query).fetchall():
        captured = times.of(head["session"], head["captured_s"], head["wall_time"])
        yield TimedMessage(captured, "/trial", TRIAL, partial(trial, row=head))
        if head["stage_mm"]:
            make = partial(point, frame="stage", at_mm=json.loads(head["stage_mm"]))
            yield TimedMessage(captured, "/stage", POSE_IN_FRAME, make)
        yield from _touches(db, head, times)
        yield from _ends(db, head["id"], captured)
        yield from _frames(db, run, head, times)


def _touches(db: sqlite3.Connection, head: sqlite3.Row, times: _Times) -> Iterator[TimedMessage]:
    for row in db.execute("SELECT * FROM touches WHERE trial = ?", (head["id"],)):
        make = partial(point, frame="world", at_mm=(row["x_mm"], row["y_mm"], row["z_mm"]))
        yield TimedMessage(
            times.of(head["session"], row["t_s"], row["wall_time"]), "/arm", POSE_IN_FRAME, make
        )


def _ends(db: sqlite3.Connection, trial: str, captured: int) -> Iterator[TimedMessage]:
    """Teat ends as they are and as each detector found them, at the moment of the frames."""
    places = [("/truth", db.execute("SELECT * FROM truth WHERE trial = ?", (trial,)).fetchall())]
    for row in db.execute("SELECT * FROM detections WHERE trial = ?", (trial,)).fetchall():
        name, key = row["detector"], (trial, row["detector"])
        found = db.execute("SELECT * FROM found WHERE trial = ? AND detector = ?", key).fetchall()
        score = db.execute("SELECT * FROM scores WHERE trial = ? AND detector = ?", key).fetchone()
        places.append((f"/detections/{name}", found))
        yield TimedMessage(
            captured, f"/answers/{name}", ANSWER, partial(answer, row=row, score=score)
        )
    for topic, rows in places:
        yield TimedMessage(
            captured, topic, POSES_IN_FRAME, partial(points, frame="world", rows=rows)
        )


def _frames(
    db: sqlite3.Connection, run: Path, head: sqlite3.Row, times: _Times
) -> Iterator[TimedMessage]:
    """A detector's pictures of its stages have no frame of reference that is known; they go by
    their own name.
    """
    for row in db.execute("SELECT * FROM frames WHERE trial = ?", (head["id"],)):
        picture = row["camera"]
        exposed_s = head["captured_s"] if row["exposed_s"] is None else row["exposed_s"]
        topic = f"/cameras/{picture}" if picture in FRAMES_OF else f"/stages/{picture}"
        kind = RAW_IMAGE if picture == RADIOMETRIC else COMPRESSED_IMAGE
        make = partial(_image, run=run, frame=FRAMES_OF.get(picture, picture), row=row)
        yield TimedMessage(
            times.of(head["session"], exposed_s, head["wall_time"]), topic, kind, make
        )


def _image(time_ns: int, run: Path, frame: str, row: sqlite3.Row) -> Message:
    path = run / row["path"]
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError.plain(f"{path} can't be read: {error.strerror or error}") from error
    if hashlib.sha256(data).hexdigest() != row["sha256"]:
        raise ConfigError.plain(
            f"{path} is not as it was written: 'teatbench store check {run}' says what else is not"
        )
    try:
        return (raw_image if row["camera"] == RADIOMETRIC else image)(time_ns, frame, data)
    except ValueError as error:
        raise ConfigError.plain(f"{path} can't be exported: {error}") from error


def _cameras(known: Calibration, time_ns: int) -> Iterator[TimedMessage]:
    """The cameras' places and lenses, once, before all else. A mirrored picture has no lens that
    viewers could draw with.
    """
    yield TimedMessage(time_ns, "/tf", FRAME_TRANSFORMS, partial(frames_of_reference, known=known))
    thermal = None if known.thermal.mirrored else known.thermal.lens
    for name, lens in (("left", known.left), ("right", known.right), ("thermal", thermal)):
        if lens is not None:
            yield TimedMessage(
                time_ns,
                f"/lenses/{name}",
                CAMERA_CALIBRATION,
                partial(camera, frame=name, lens=lens),
            )
