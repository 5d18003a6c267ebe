"""Rows of a run as the messages that `schemas` describes: values by field, ready to be encoded.

Lengths are metres here, as those schemas ask, and only here; frames of reference are those of the bench (`world`, `stage`, `left`, `right`,
`thermal`). A pose without a direction has the unit quaternion. Pure: rows in, values out.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from bench.exporting.schemas import LEVEL
from detector.calibration.values import Calibration
from detector.geometry import Camera, Motion

Row = Mapping[str, Any]
Message = Mapping[str, Any]
NS = 1_000_000_000
MM_PER_M = 1000.0
UNIT = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}

_LEVELS = {"trip": "ERROR", "fault": "ERROR", "aborted": "WARNING", "camera": "WARNING", "skipped": "WARNING", "repeated": "WARNING"}


def stamp(time_ns: int) -> Message:
    """A google.protobuf.Timestamp."""
    return {"seconds": time_ns // NS, "nanos": time_ns % NS}


def image(time_ns: int, frame: str, png: bytes) -> Message:
    """A frame, byte for byte as its file holds it."""
    return {"timestamp": stamp(time_ns), "frame_id": frame, "data": png, "format": "png"}


def raw_image(time_ns: int, frame: str, png: bytes) -> Message:
    """A frame of 16 bits pixel by pixel: viewers let one choose what is black and what is white, which they don't for a PNG.

    Raises ValueError where it is no picture of 16 bits.
    """
    pixels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED) if png else None
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise ValueError("it is no grey picture of 16 bits")
    height, width = pixels.shape
    about = {"width": width, "height": height, "encoding": "mono16", "step": 2 * width}
    return {"timestamp": stamp(time_ns), "frame_id": frame, **about, "data": pixels.astype("<u2").tobytes()}


def camera(time_ns: int, frame: str, lens: Camera) -> Message:
    """A camera as Bouguet, OpenCV and the ROS model plumb_bob have it: K row by row, D = (k1, k2, p1, p2, k3)."""
    (fx, fy), (cx, cy) = lens.fc, lens.cc
    rows = [[fx, lens.alpha_c * fx, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    return {
        "timestamp": stamp(time_ns), "frame_id": frame, "width": lens.image_size[0], "height": lens.image_size[1],
        "distortion_model": "plumb_bob", "D": list(lens.kc), "K": [value for row in rows for value in row],
        "R": np.eye(3).ravel().tolist(), "P": [value for row in rows for value in (*row, 0.0)],
    }  # fmt: skip


def frames_of_reference(time_ns: int, known: Calibration) -> Message:
    """Where the cameras are in the world: the right one first, to which the left is tied, and the thermal one to that."""
    motions = [("world", "right", known.world_from_right), ("right", "left", known.right_from_left)]
    if known.thermal_from_left is not None:
        motions.append(("left", "thermal", known.thermal_from_left.inverse()))
    return {"transforms": [_transform(time_ns, parent, child, motion) for parent, child, motion in motions]}


def _transform(time_ns: int, parent: str, child: str, parent_from_child: Motion) -> Message:
    x, y, z, w = (float(value) for value in Rotation.from_matrix(parent_from_child.R).as_quat())
    ids = {"parent_frame_id": parent, "child_frame_id": child}
    return {"timestamp": stamp(time_ns), **ids, "translation": _metres(parent_from_child.T), "rotation": {"x": x, "y": y, "z": z, "w": w}}


def point(time_ns: int, frame: str, at_mm: Sequence[float]) -> Message:
    """One place in ``frame``."""
    return {"timestamp": stamp(time_ns), "frame_id": frame, "pose": _pose(at_mm)}


def points(time_ns: int, frame: str, rows: Sequence[Row]) -> Message:
    """Places in ``frame``, of rows with x_mm, y_mm, z_mm."""
    return {"timestamp": stamp(time_ns), "frame_id": frame, "poses": [_pose((row["x_mm"], row["y_mm"], row["z_mm"])) for row in rows]}


def log(time_ns: int, event: Row) -> Message:
    """A row of ``events``."""
    level = LEVEL.numbers[_LEVELS.get(event["kind"], "INFO")]
    return {"timestamp": stamp(time_ns), "level": level, "message": event["text"], "name": event["kind"]}


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
