"""What messages of an exported time line look like: Foxglove's published schemas, and a few of our own.

Foxglove's are the Protobuf ones, which Foxglove, Lichtblick and rerun all read (rerun draws no others): names, numbers and kinds of
fields as published (github.com/foxglove/foxglove-sdk, schemas/proto/foxglove; numbers don't follow the order there). Of ours every viewer
can draw the numbers: NaN is what was not measured, an empty text what was not said. No field is an `int64`, which viewers in a browser
read as something other than a number. Pure tables.
"""

from __future__ import annotations

from bench.exporting.protobuf import Choice, Field, Kind, MessageType


def _message(name: str, *fields: tuple[str, int, Kind] | Field) -> MessageType:
    return MessageType(name, tuple(field if isinstance(field, Field) else Field(*field) for field in fields))


def _holds(name: str, number: int, of: MessageType, *, repeated: bool = False) -> Field:
    return Field(name, number, Kind.MESSAGE, of, repeated)


def _rows(name: str, number: int) -> Field:
    return Field(name, number, Kind.DOUBLE, repeated=True)


TIMESTAMP = _message("google.protobuf.Timestamp", ("seconds", 1, Kind.INT64), ("nanos", 2, Kind.INT32))
_TIME = _holds("timestamp", 1, TIMESTAMP)
VECTOR = _message("foxglove.Vector3", ("x", 1, Kind.DOUBLE), ("y", 2, Kind.DOUBLE), ("z", 3, Kind.DOUBLE))
QUATERNION = _message("foxglove.Quaternion", *((name, number, Kind.DOUBLE) for number, name in enumerate("xyzw", 1)))
POSE = _message("foxglove.Pose", _holds("position", 1, VECTOR), _holds("orientation", 2, QUATERNION))
LEVEL = Choice("Level", {"UNKNOWN": 0, "DEBUG": 1, "INFO": 2, "WARNING": 3, "ERROR": 4, "FATAL": 5})

COMPRESSED_IMAGE = _message(
    "foxglove.CompressedImage", _TIME, ("frame_id", 4, Kind.STRING), ("data", 2, Kind.BYTES), ("format", 3, Kind.STRING)
)
RAW_IMAGE = _message(
    "foxglove.RawImage", _TIME, ("frame_id", 7, Kind.STRING), ("width", 2, Kind.FIXED32), ("height", 3, Kind.FIXED32),
    ("encoding", 4, Kind.STRING), ("step", 5, Kind.FIXED32), ("data", 6, Kind.BYTES),
)  # fmt: skip
CAMERA_CALIBRATION = _message(
    "foxglove.CameraCalibration", _TIME, ("frame_id", 9, Kind.STRING), ("width", 2, Kind.FIXED32), ("height", 3, Kind.FIXED32),
    ("distortion_model", 4, Kind.STRING), _rows("D", 5), _rows("K", 6), _rows("R", 7), _rows("P", 8),
)  # fmt: skip
FRAME_TRANSFORM = _message(
    "foxglove.FrameTransform", _TIME, ("parent_frame_id", 2, Kind.STRING), ("child_frame_id", 3, Kind.STRING),
    _holds("translation", 4, VECTOR), _holds("rotation", 5, QUATERNION),
)  # fmt: skip
FRAME_TRANSFORMS = _message("foxglove.FrameTransforms", _holds("transforms", 1, FRAME_TRANSFORM, repeated=True))
POSE_IN_FRAME = _message("foxglove.PoseInFrame", _TIME, ("frame_id", 2, Kind.STRING), _holds("pose", 3, POSE))
POSES_IN_FRAME = _message("foxglove.PosesInFrame", _TIME, ("frame_id", 2, Kind.STRING), _holds("poses", 3, POSE, repeated=True))
LOG = _message(
    "foxglove.Log", _TIME, Field("level", 2, Kind.ENUM, LEVEL), ("message", 3, Kind.STRING), ("name", 4, Kind.STRING),
    ("file", 5, Kind.STRING), ("line", 6, Kind.FIXED32),
)  # fmt: skip

BATH = _message(
    "teatbench.Bath", _TIME, ("temp_c", 2, Kind.DOUBLE), ("external_c", 3, Kind.DOUBLE), ("power_percent", 4, Kind.DOUBLE),
    ("state", 5, Kind.STRING),
)  # fmt: skip
ANSWER = _message(
    "teatbench.Answer", _TIME, ("trial", 2, Kind.STRING), ("detector", 3, Kind.STRING), ("outcome", 4, Kind.STRING),
    ("hidden", 5, Kind.UINT32), ("reason", 6, Kind.STRING), ("seconds", 7, Kind.DOUBLE), ("success", 8, Kind.DOUBLE),
    ("max_error_mm", 9, Kind.DOUBLE),
)  # fmt: skip
TRIAL = _message(
    "teatbench.Trial", _TIME, ("id", 2, Kind.STRING), ("number", 3, Kind.UINT32), ("name", 4, Kind.STRING), ("situation", 5, Kind.STRING),
    ("repeat", 6, Kind.UINT32), ("bath_c", 7, Kind.DOUBLE), ("bath_state", 8, Kind.STRING), ("invalid", 9, Kind.STRING),
)  # fmt: skip

SCHEMAS = {
    kind.full_name: kind
    for kind in (
        COMPRESSED_IMAGE, RAW_IMAGE, CAMERA_CALIBRATION, FRAME_TRANSFORMS, POSE_IN_FRAME, POSES_IN_FRAME, LOG, BATH, ANSWER, TRIAL,
    )
}  # fmt: skip
