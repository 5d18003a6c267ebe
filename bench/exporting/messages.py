"""Rows of a run as messages that viewers of MCAP files know: Foxglove's published schemas, and a few of our own.

Lengths are metres here, as those schemas ask, and only here. A pose without a direction has the unit quaternion. Schema names and
fields are Foxglove's (docs.foxglove.dev/docs/sdk/schemas); the descriptions are ours. Pure: rows in, values out.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from typing import Any

Json = Mapping[str, Any]  # what JSON can say; rows of the database look the same
NS = 1_000_000_000
MM_PER_M = 1000.0

_TEXT, _NUMBER, _INTEGER = {"type": "string"}, {"type": "number"}, {"type": "integer"}
_MAYBE = {"type": ["number", "null"]}
_MAYBE_TEXT = {"type": ["string", "null"]}


def _object(title: str, **fields: Json) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": fields}


_TIME = _object("time", sec={**_INTEGER, "minimum": 0}, nsec={**_INTEGER, "minimum": 0, "maximum": NS - 1})
_VECTOR = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_BYTES = {"type": "string", "contentEncoding": "base64"}

SCHEMAS: dict[str, Json] = {
    schema["title"]: schema
    for schema in (
        _object("foxglove.CompressedImage", timestamp=_TIME, frame_id=_TEXT, data=_BYTES, format=_TEXT),
        _object("foxglove.PoseInFrame", timestamp=_TIME, frame_id=_TEXT, pose=_POSE),
        _object("foxglove.PosesInFrame", timestamp=_TIME, frame_id=_TEXT, poses={"type": "array", "items": _POSE}),
        _object("foxglove.Log", timestamp=_TIME, level=_INTEGER, message=_TEXT, name=_TEXT, file=_TEXT, line=_INTEGER),
        _object("teatbench.Bath", timestamp=_TIME, temp_c=_NUMBER, external_c=_MAYBE, power_percent=_MAYBE, state=_TEXT),
        _object(
            "teatbench.Answer", timestamp=_TIME, trial=_TEXT, detector=_TEXT, outcome=_TEXT, hidden=_INTEGER, reason=_MAYBE_TEXT,
            seconds=_NUMBER, success={"type": ["boolean", "null"]}, max_error_mm=_MAYBE,
        ),
        _object(
            "teatbench.Trial", timestamp=_TIME, id=_TEXT, number=_INTEGER, name=_TEXT, situation=_TEXT, repeat=_INTEGER, bath_c=_MAYBE,
            bath_state=_MAYBE_TEXT, invalid=_MAYBE_TEXT,
        ),
    )
}  # fmt: skip

_LEVELS = {"trip": 4, "fault": 4, "aborted": 3, "camera": 3, "skipped": 3, "repeated": 3}  # foxglove.Log: 2 tells, 3 warns, 4 is an error
_TELLS = 2


def stamp(time_ns: int) -> Json:
    """A time as Foxglove's schemas write it."""
    return {"sec": time_ns // NS, "nsec": time_ns % NS}


def image(time_ns: int, camera: str, png: bytes) -> Json:
    """A frame, byte for byte as its file holds it."""
    return {"timestamp": stamp(time_ns), "frame_id": camera, "data": base64.b64encode(png).decode("ascii"), "format": "png"}


def point(time_ns: int, frame: str, at_mm: Sequence[float]) -> Json:
    """One place in ``frame``."""
    return {"timestamp": stamp(time_ns), "frame_id": frame, "pose": _pose(at_mm)}


def points(time_ns: int, frame: str, rows: Sequence[Json]) -> Json:
    """Places in ``frame``, of rows with x_mm, y_mm, z_mm."""
    return {"timestamp": stamp(time_ns), "frame_id": frame, "poses": [_pose((row["x_mm"], row["y_mm"], row["z_mm"])) for row in rows]}


def log(time_ns: int, event: Json) -> Json:
    """A row of ``events``."""
    level = _LEVELS.get(event["kind"], _TELLS)
    return {"timestamp": stamp(time_ns), "level": level, "message": event["text"], "name": event["kind"], "file": "", "line": 0}


def bath(time_ns: int, row: Json) -> Json:
    """A row of ``bath``."""
    return {"timestamp": stamp(time_ns)} | {key: row[key] for key in ("temp_c", "external_c", "power_percent", "state")}


def answer(time_ns: int, row: Json, score: Json | None) -> Json:
    """A row of ``detections`` with its ``scores``; what was not scored is null."""
    wall = json.loads(score["wall_score"]) if score else {}
    errors = json.loads(score["score"]).get("radial_mm", []) if score else []
    return {
        "timestamp": stamp(time_ns),
        **{key: row[key] for key in ("trial", "detector", "outcome", "hidden", "reason")},
        "seconds": row["wall_seconds"],
        "success": wall.get("success"),
        "max_error_mm": max(errors, default=None),
    }


def trial(time_ns: int, row: Json) -> Json:
    """A row of ``trials``."""
    names = ("id", "number", "name", "situation", "repeat", "bath_c", "bath_state", "invalid")
    return {"timestamp": stamp(time_ns)} | {key: row[key] for key in names}


def _pose(at_mm: Sequence[float]) -> Json:
    x, y, z = (value / MM_PER_M for value in at_mm)
    return {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
