"""Foxglove's schemas field by field as published, bytes as Foxglove's own library writes them, and
what viewers need of ours.

Fields typed from github.com/foxglove/foxglove-sdk, schemas/proto/foxglove, and protobuf's
timestamp.proto; bytes from foxglove-sdk 0.30.3.
"""

from __future__ import annotations

from typing import Any

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap_protobuf.schema import build_file_descriptor_set

from bench.record.mcap import MESSAGES
from tests.bench import mcap_reading

SCHEMAS = {kind.DESCRIPTOR.full_name: kind for kind in MESSAGES}

KINDS = {"double": 1, "int64": 3, "int32": 5, "fixed32": 7, "string": 9, "bytes": 12, "uint32": 13}
WHEN = "google.protobuf.Timestamp timestamp = 1"
PUBLISHED = {
    "google.protobuf.Timestamp": "int64 seconds = 1; int32 nanos = 2",
    "foxglove.Vector3": "double x = 1; double y = 2; double z = 3",
    "foxglove.Quaternion": "double x = 1; double y = 2; double z = 3; double w = 4",
    "foxglove.Pose": "foxglove.Vector3 position = 1; foxglove.Quaternion orientation = 2",
    "foxglove.CompressedImage": f"{WHEN}; string frame_id = 4; bytes data = 2; string format = 3",
    "foxglove.RawImage": f"""{WHEN}; string frame_id = 7; fixed32 width = 2; fixed32 height = 3;
        string encoding = 4; fixed32 step = 5; bytes data = 6""",
    "foxglove.CameraCalibration": f"""{WHEN}; string frame_id = 9; fixed32 width = 2;
        fixed32 height = 3; string distortion_model = 4; repeated double D = 5;
        repeated double K = 6; repeated double R = 7; repeated double P = 8""",
    "foxglove.FrameTransform": f"""{WHEN}; string parent_frame_id = 2; string child_frame_id = 3;
        foxglove.Vector3 translation = 4; foxglove.Quaternion rotation = 5""",
    "foxglove.FrameTransforms": "repeated foxglove.FrameTransform transforms = 1",
    "foxglove.PoseInFrame": f"{WHEN}; string frame_id = 2; foxglove.Pose pose = 3",
    "foxglove.PosesInFrame": f"{WHEN}; string frame_id = 2; repeated foxglove.Pose poses = 3",
    "foxglove.Log": f"""{WHEN}; enum foxglove.Log.Level level = 2; string message = 3;
        string name = 4; string file = 5; fixed32 line = 6""",
}


def described(name: str) -> bytes:
    """The schema as it stands in the file."""
    return build_file_descriptor_set(SCHEMAS[name]).SerializeToString()


def fields(text: str) -> dict[int, tuple[str, int, bool, str]]:
    """Lines of a .proto file as `mcap_reading` gives them."""
    found = {}
    for line in text.split(";"):
        left, _, number = line.partition("=")
        words = left.split()
        kind, name = words[-2:]
        code = mcap_reading.ENUM if "enum" in words else KINDS.get(kind, mcap_reading.MESSAGE)
        found[int(number)] = (name, code, "repeated" in words, "" if kind in KINDS else kind)
    return found


FOXGLOVES = sorted(name for name in SCHEMAS if name.startswith("foxglove."))


@pytest.mark.parametrize("name", FOXGLOVES)
def test_a_schema_is_field_by_field_what_foxglove_publishes(name: str) -> None:
    ours = mcap_reading.described(described(name))
    assert name in ours
    assert ours == {one: fields(PUBLISHED[one]) for one in ours}


def test_levels_of_a_log_are_the_published_ones() -> None:
    published = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")
    assert dict(Log.Level.items()) == {name: number for number, name in enumerate(published)}


@pytest.mark.parametrize("name", sorted(set(SCHEMAS) - set(FOXGLOVES)))
def test_our_own_hold_only_what_every_viewer_takes(name: str) -> None:
    """Lichtblick refuses JSON schemas with two types for a field, and gives an int64 as something
    that can't be plotted.
    """
    ours = mcap_reading.described(described(name))[name]
    assert ours.pop(1) == ("timestamp", mcap_reading.MESSAGE, False, "google.protobuf.Timestamp")
    plain = {mcap_reading.DOUBLE, mcap_reading.STRING, mcap_reading.UINT32}
    assert {kind for _, kind, _, _ in ours.values()} <= plain


T = {"seconds": 1_700_000_000, "nanos": 5}
UNIT = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
POSE = {"position": {"x": 0.1, "y": 0.0, "z": -0.005}, "orientation": UNIT}
TIE = {
    "timestamp": T,
    "parent_frame_id": "world",
    "child_frame_id": "right",
    "translation": {"x": 1.0, "y": 2.0, "z": 3.0},
    "rotation": UNIT,
}
AS_FOXGLOVE_WRITES: dict[str, tuple[dict[str, Any], str]] = {
    "foxglove.CompressedImage": (
        {"timestamp": T, "frame_id": "left", "data": b"abc", "format": "png"},
        "0a080880e2cfaa06100512036162631a03706e6722046c656674",
    ),
    "foxglove.RawImage": (
        {
            "timestamp": T,
            "frame_id": "thermal",
            "width": 2,
            "height": 1,
            "encoding": "mono16",
            "step": 4,
            "data": b"abcd",
        },
        "0a080880e2cfaa06100515020000001d0100000022066d6f6e6f31362d040000003204616263643a07746865726d616c",
    ),
    "foxglove.FrameTransforms": (
        {"transforms": [TIE]},
        "0a400a080880e2cfaa0610051205776f726c641a057269676874221b09000000000000f03f1100000000000000401900000000000008402a0921000000000000f03f",
    ),
    "foxglove.PoseInFrame": (
        {"timestamp": T, "frame_id": "stage", "pose": POSE},
        "0a080880e2cfaa061005120573746167651a1f0a12099a9999999999b93f197b14ae47e17a74bf120921000000000000f03f",
    ),
    "foxglove.PosesInFrame": (
        {"timestamp": T, "frame_id": "world", "poses": [POSE, POSE]},
        "0a080880e2cfaa0610051205776f726c64"
        + 2 * "1a1f0a12099a9999999999b93f197b14ae47e17a74bf120921000000000000f03f",
    ),
    "foxglove.Log": (
        {"timestamp": T, "level": 4, "message": "gone: ü", "name": "fault"},
        "0a080880e2cfaa06100510041a08676f6e653a20c3bc22056661756c74",
    ),
}


@pytest.mark.parametrize("name", AS_FOXGLOVE_WRITES)
def test_bytes_are_those_of_foxgloves_own_library(name: str) -> None:
    values, wanted = AS_FOXGLOVE_WRITES[name]
    assert SCHEMAS[name](**values).SerializeToString().hex() == wanted


@pytest.mark.parametrize("name", FOXGLOVES)
def test_descriptions_are_those_of_foxgloves_own_library(name: str) -> None:
    """Options for other languages' generators and names for JSON, which follow from the fields'
    names, say nothing of the bytes.
    """
    theirs = pytest.importorskip(
        "foxglove.messages", reason="foxglove-sdk is not installed: nobody to compare with"
    )
    kind = getattr(theirs, name.removeprefix("foxglove."))
    sets = [
        FileDescriptorSet.FromString(data) for data in (kind.get_schema().data, described(name))
    ]
    for file in [file for files in sets for file in files.file]:
        file.ClearField("options")
        for field in [field for message in file.message_type for field in message.field]:
            field.ClearField("json_name")
    files_of = [{file.name: file for file in files.file} for files in sets]
    assert files_of[0] == files_of[1]
