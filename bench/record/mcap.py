"""A run as one MCAP file (mcap.dev/spec): frames, bath, stage, arm, truth, detections and events on
one time line, as Foxglove's published Protobuf messages and three of our own.

Lengths are metres in this file, as those messages ask; frames of reference are those of the bench.
"""

from __future__ import annotations

import hashlib
import json
import math
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
)
from google.protobuf.descriptor_pool import Default
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.writer import Writer
from scipy.spatial.transform import Rotation

from bench.config import ConfigError, read_bytes, read_calibration
from bench.record.reader import ALL, HEADS, opened
from bench.record.schema import Row
from detector.calibration.values import Calibration
from detector.geometry import Camera
from textfiles.text import in_command
from textfiles.whole import new_folders, take_place

NAME, CALIBRATION = "run.mcap", "calibration.toml"
SIXTEEN_BITS = {"thermal_radiometric", "depth", "depth_amplitude"}
# frame of reference by a camera's picture
FRAMES_OF = {one: one.partition("_")[0] for one in ("left", "right", "thermal", *SIXTEEN_BITS)}
NS = 1_000_000_000
MM_PER_M = 1000.0
NO_TURN = Quaternion(w=1.0)
LEVELS = {"trip": Log.ERROR, "fault": Log.ERROR}
LEVELS |= dict.fromkeys(("aborted", "camera", "skipped", "repeated"), Log.WARNING)


def _own(name: str, fields: str) -> Any:
    """The class of a message `teatbench.<name>`: a timestamp, then ``fields``, each behind its
    kind. No int64, which viewers in a browser don't read.
    """
    message = DescriptorProto(name=name)
    optional, kind = FieldDescriptorProto.LABEL_OPTIONAL, FieldDescriptorProto.TYPE_MESSAGE
    message.field.add(name="timestamp", number=1, label=optional, type=kind)
    message.field[0].type_name = f".{Timestamp.DESCRIPTOR.full_name}"
    for word in fields.split():
        kind = _KINDS.get(word, kind)
        if word not in _KINDS:
            number = len(message.field) + 1
            message.field.add(name=word, number=number, label=optional, type=kind)
    file = FileDescriptorProto(
        name=f"teatbench/{name}.proto",
        package="teatbench",
        dependency=[Timestamp.DESCRIPTOR.file.name],
        message_type=[message],
        syntax="proto3",
    )
    Default().Add(file)
    return GetMessageClass(Default().FindMessageTypeByName(f"teatbench.{name}"))


_KINDS = {
    "double": FieldDescriptorProto.TYPE_DOUBLE,
    "string": FieldDescriptorProto.TYPE_STRING,
    "uint32": FieldDescriptorProto.TYPE_UINT32,
}
# NaN is what was not measured, an empty text what was not said
Bath = _own("Bath", "double temp_c external_c power_percent string state")
_ANSWER = "string trial detector outcome uint32 hidden string reason double seconds success"
Answer = _own("Answer", f"{_ANSWER} max_error_mm")
_TRIAL = "string id uint32 number string name situation uint32 repeat double bath_c"
Trial = _own("Trial", f"{_TRIAL} string bath_state invalid")
_OF_FOXGLOVE = (CompressedImage, RawImage, CameraCalibration, FrameTransforms, PoseInFrame)
MESSAGES: tuple[type[Message], ...] = (*_OF_FOXGLOVE, PosesInFrame, Log, Bath, Answer, Trial)


def camera(at: Timestamp, frame: str, lens: Camera) -> CameraCalibration:
    """As the ROS model plumb_bob has it: K row by row, D = (k1, k2, p1, p2, k3)."""
    K = lens.matrix
    return CameraCalibration(
        timestamp=at,
        frame_id=frame,
        width=lens.image_size[0],
        height=lens.image_size[1],
        distortion_model="plumb_bob",
        D=list(lens.kc),
        K=K.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.column_stack([K, np.zeros(3)]).ravel().tolist(),
    )


def frames_of_reference(at: Timestamp, known: Calibration) -> FrameTransforms:
    """Where the cameras are: right in the world, left in right, thermal and depth in left."""
    motions = [("world", "right", known.world_from_right), ("right", "left", known.right_from_left)]
    for name, pose in (("thermal", known.thermal_from_left), ("depth", known.depth_from_left)):
        if pose is not None:
            motions.append(("left", name, pose.inverse()))
    transforms = []
    for parent, child, motion in motions:
        x, y, z, w = Rotation.from_matrix(motion.R).as_quat().tolist()
        turn = Quaternion(x=x, y=y, z=z, w=w)
        names: dict[str, Any] = {"parent_frame_id": parent, "child_frame_id": child}
        place: dict[str, Any] = {"translation": _metres(motion.T), "rotation": turn}
        transforms.append(FrameTransform(timestamp=at, **names, **place))
    return FrameTransforms(transforms=transforms)


def point(at: Timestamp, frame: str, at_mm: Sequence[float]) -> PoseInFrame:
    pose = Pose(position=_metres(at_mm), orientation=NO_TURN)
    return PoseInFrame(timestamp=at, frame_id=frame, pose=pose)


def points(at: Timestamp, frame: str, rows: Sequence[Row]) -> PosesInFrame:
    places = [_metres((row["x_mm"], row["y_mm"], row["z_mm"])) for row in rows]
    poses = [Pose(position=place, orientation=NO_TURN) for place in places]
    return PosesInFrame(timestamp=at, frame_id=frame, poses=poses)


def log(at: Timestamp, row: Row) -> Log:
    level = LEVELS.get(row["kind"], Log.INFO)
    return Log(timestamp=at, level=level, message=row["text"], name=row["kind"])


def bath(at: Timestamp, row: Row) -> Message:
    figures = {key: _number(row[key]) for key in ("temp_c", "external_c", "power_percent")}
    return Bath(timestamp=at, **figures, state=row["state"])  # type: ignore[no-any-return]


def answer(at: Timestamp, row: Row, score: Row | None) -> Message:
    """A row of ``detections`` with its ``scores``; ``success`` is 1 or 0."""
    wall = json.loads(score["wall_score"]) if score else {}
    errors = json.loads(score["score"]).get("radial_mm", []) if score else []
    return Answer(  # type: ignore[no-any-return]
        timestamp=at,
        **{key: row[key] for key in ("trial", "detector", "outcome", "hidden")},
        reason=row["reason"] or "",
        seconds=row["wall_seconds"],
        success=_number(wall.get("success")),
        max_error_mm=_number(max(errors, default=None)),
    )


def trial(at: Timestamp, row: Row) -> Message:
    return Trial(  # type: ignore[no-any-return]
        timestamp=at,
        **{key: row[key] for key in ("id", "number", "name", "situation", "repeat")},
        bath_c=_number(row["bath_c"]),
        **{key: row[key] or "" for key in ("bath_state", "invalid")},
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _metres(at_mm: Sequence[float] | np.ndarray[Any, Any]) -> Vector3:
    x, y, z = (float(value) / MM_PER_M for value in at_mm)
    return Vector3(x=x, y=y, z=z)


@dataclass(frozen=True, slots=True)
class TimedMessage:
    """``make`` gives what stands in the file; frames are read only then."""

    time_ns: int
    topic: str
    make: Callable[[Timestamp], Message]


def export_mcap(run: Path, out: Path) -> list[Path]:
    """Write ``out/run.mcap``; its path. Times are the bench's clock from the time of day of its
    session, else the time of day. Raises ConfigError with a damaged frame; OSError.
    """
    file = run / CALIBRATION
    known = read_calibration(file, doubtful=True) if file.is_file() else None
    with opened(run) as db:
        db.row_factory = sqlite3.Row
        found = sorted(_run_messages(db, run, _Times(db)), key=lambda message: message.time_ns)
        facts = dict(db.execute("SELECT key, value FROM facts ORDER BY key").fetchall())
    first_ns = min((message.time_ns for message in found), default=0)
    found = [*_cameras(known, first_ns), *found] if known else found
    part = out / f"{NAME}.part"
    with new_folders(out):
        try:
            with part.open("wb") as to:
                writer = Writer(to)
                writer.add_metadata("teatbench", facts)
                for one in found:
                    seconds, nanos = divmod(one.time_ns, NS)
                    content = one.make(Timestamp(seconds=seconds, nanos=nanos))
                    writer.write_message(one.topic, content, one.time_ns, one.time_ns)
                writer.finish()  # type: ignore[no-untyped-call]
            take_place(part, out / NAME)
        finally:
            part.unlink(missing_ok=True)
    return [out / NAME]


class _Times:
    """When things were, as nanoseconds of the time of day."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._start_ns: dict[int, int] = {}
        query = "SELECT session, t_s, wall_time FROM events WHERE t_s IS NOT NULL ORDER BY number"
        for session, t_s, wall in db.execute(query):
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
    for table, make in (("events", log), ("bath", bath)):
        for row in db.execute(f"SELECT * FROM {table}"):  # noqa: S608 - our names
            at = times.of(row["session"], row["t_s"], row["wall_time"])
            yield TimedMessage(at, f"/{table}", partial(make, row=row))
    for head in db.execute(HEADS, ALL).fetchall():
        captured = times.of(head["session"], head["captured_s"], head["wall_time"])
        yield TimedMessage(captured, "/trial", partial(trial, row=head))
        if head["stage_mm"]:
            at_mm = json.loads(head["stage_mm"])
            yield TimedMessage(captured, "/stage", partial(point, frame="stage", at_mm=at_mm))
        for row in db.execute("SELECT * FROM touches WHERE trial = ?", (head["id"],)):
            touched = times.of(head["session"], row["t_s"], row["wall_time"])
            at_mm = (row["x_mm"], row["y_mm"], row["z_mm"])
            yield TimedMessage(touched, "/arm", partial(point, frame="world", at_mm=at_mm))
        yield from _ends(db, head["id"], captured)
        yield from _frames(db, run, head, times)


def _ends(db: sqlite3.Connection, trial: str, captured: int) -> Iterator[TimedMessage]:
    """Teat ends as they are and as each detector found them, at the moment of the frames."""
    places = [("/truth", db.execute("SELECT * FROM truth WHERE trial = ?", (trial,)).fetchall())]
    for row in db.execute("SELECT * FROM detections WHERE trial = ?", (trial,)).fetchall():
        name, key = row["detector"], (trial, row["detector"])
        found = db.execute("SELECT * FROM found WHERE trial = ? AND detector = ?", key).fetchall()
        score = db.execute("SELECT * FROM scores WHERE trial = ? AND detector = ?", key).fetchone()
        places.append((f"/detections/{name}", found))
        yield TimedMessage(captured, f"/answers/{name}", partial(answer, row=row, score=score))
    for topic, rows in places:
        yield TimedMessage(captured, topic, partial(points, frame="world", rows=rows))


def _frames(
    db: sqlite3.Connection, run: Path, head: sqlite3.Row, times: _Times
) -> Iterator[TimedMessage]:
    for row in db.execute("SELECT * FROM frames WHERE trial = ?", (head["id"],)):
        picture = row["camera"]
        exposed_s = head["captured_s"] if row["exposed_s"] is None else row["exposed_s"]
        at = times.of(head["session"], exposed_s, head["wall_time"])
        topic = f"/cameras/{picture}" if picture in FRAMES_OF else f"/stages/{picture}"
        yield TimedMessage(at, topic, partial(_image, run=run, row=row))


def _image(at: Timestamp, run: Path, row: sqlite3.Row) -> Message:
    """A frame, checked against its SHA-256: the bytes of its file; pixels where it has 16 bits."""
    path, picture = run / row["path"], row["camera"]
    frame = FRAMES_OF.get(picture, picture)
    data = read_bytes(path)
    if hashlib.sha256(data).hexdigest() != row["sha256"]:
        all_of_it = f"'teatbench store check {in_command(run)}' says what else is not"
        raise ConfigError.plain(f"{path} is not as it was written: {all_of_it}")
    if picture not in SIXTEEN_BITS:
        return CompressedImage(timestamp=at, frame_id=frame, data=data, format="png")
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise ConfigError.plain(f"{path} can't be exported: it is no grey picture of 16 bits")
    height, width = pixels.shape
    size = {"width": width, "height": height, "step": 2 * width}
    whole = pixels.astype("<u2").tobytes()
    return RawImage(timestamp=at, frame_id=frame, encoding="mono16", data=whole, **size)


def _cameras(known: Calibration, time_ns: int) -> Iterator[TimedMessage]:
    """The cameras' places and lenses, before all else; a mirrored picture has no such lens."""
    yield TimedMessage(time_ns, "/tf", partial(frames_of_reference, known=known))
    thermal = None if known.thermal.mirrored else known.thermal.lens
    lenses = {"left": known.left, "right": known.right, "thermal": thermal, "depth": known.depth}
    for name, lens in lenses.items():
        if lens is not None:
            make = partial(camera, frame=name, lens=lens)
            yield TimedMessage(time_ns, f"/lenses/{name}", make)
