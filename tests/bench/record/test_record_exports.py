"""A run's record for other programs, read back with the libraries that those programs use."""

from __future__ import annotations

import csv
import math
import shutil
import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import build_file_descriptor_set
from scipy.spatial.transform import Rotation

from bench.config import read_calibration
from bench.files import Picture
from bench.record.mcap import MESSAGES
from bench.record.reader import RunRecord, read_run
from bench.record.writer import Store
from bench.rig.loading import RIGS
from bench.scoring.scene import score_scene
from instruments.clock import wall_time
from tests.bench.commands import Said, teatbench
from tests.bench.record.test_record import facts, trial
from tests.instruments.bath.peers import foreign

RADIOMETRIC = np.arange(29_300, 29_312, dtype=np.uint16).reshape(3, 4)
SCORE = score_scene(
    [[1.5, 0.0, 0.0], [60.0, 2.5, 0.0]], [[0.0, 0.0, 0.0], [60.0, 0.0, 0.0]], [True, True],
    u_mm=0.2, seconds=0.1, limit_mm=5.0, time_limit_s=2.0,
)  # fmt: skip
TOUCH: dict[str, Any] = {"teat": "1", "touch": 1, "t_s": 1.25, "spread_mm": 0.1, "packets": 40}
TOUCH |= {"x_mm": 10.0, "y_mm": -20.0, "z_mm": 30.0, "counts": "[1, 2]"}
Messages = dict[str, list[tuple[str, int, Any]]]  # by topic: schema, time in ns, content
EXPORT = "store export {} --format {} --out {}"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunRecord:
    folder = tmp_path_factory.mktemp("exports") / "run"
    store = Store.create(
        folder, {"calibration.toml": (RIGS / "calibration.toml").read_text(encoding="utf-8")}
    )
    facts(store)
    store.event(0.5, "state", "preparing", wall_time())
    made = trial(store, 1)
    left = np.full((6, 8), 1, np.uint8)
    pictures: dict[str, Picture] = {"left": left, "thermal_radiometric": RADIOMETRIC}
    pictures |= {"depth": RADIOMETRIC}
    frames = store.frames("001-x-1", pictures, {"left": 1.0})
    times: dict[str, Any] = {"started_s": 0.75, "captured_s": 1.0, "ended_s": 2.0}
    times |= {"stage_mm": "[100.0, 0.0, -5.0]", "bath_c": 33.0, "bath_state": "stable"}
    touch = {"trial": "001-x-1", **TOUCH}
    head, scores = {**made.head, **times}, {"thesis": SCORE}
    store.finished(replace(made, head=head, frames=frames, touches=[touch], scores=scores))
    store.event(3.0, "fault", "the stage is gone", wall_time())
    store.close()
    return read_run(folder)


def exported(run: RunRecord, kind: str, out: Path) -> Path:
    assert teatbench(EXPORT, run.folder, kind, out) == 0
    return out


def test_csv_has_every_table_and_empty_fields_for_what_was_not_measured(
    run: RunRecord, tmp_path: Path
) -> None:
    out = exported(run, "csv", tmp_path)
    (row,) = csv.DictReader((out / "touches.csv").read_text(encoding="utf-8").splitlines())
    assert (row["trial"], row["refused"]) == ("001-x-1", "")
    assert (float(row["t_s"]), float(row["y_mm"])) == (1.25, -20.0)
    (reading,) = csv.DictReader((out / "bath.csv").read_text(encoding="utf-8").splitlines())
    assert (float(reading["temp_c"]), reading["external_c"]) == (33.0, "")
    tables = "facts events bath trials frames touches truth checks detections found scores skipped"
    assert {*tables.split(), "chain"} <= {path.stem for path in out.iterdir()}


@pytest.mark.slow
def test_parquet_keeps_types_and_nulls_and_names_its_run(run: RunRecord, tmp_path: Path) -> None:
    parquet = foreign("pyarrow.parquet", "pyarrow")
    out = exported(run, "parquet", tmp_path)
    touches = parquet.read_table(out / "touches.parquet")
    types = {"trial": "string", "t_s": "double", "packets": "int64"}
    assert {name: str(touches.schema.field(name).type) for name in types} == types
    assert touches.to_pylist()[0] | TOUCH == touches.to_pylist()[0]
    assert touches.to_pylist()[0]["refused"] is None
    assert parquet.read_table(out / "skipped.parquet").num_rows == 0
    assert run.head is not None
    about = {b"run": b"run", b"wall_digest": run.head.wall_digest.encode()}
    assert touches.schema.metadata | about == touches.schema.metadata


@pytest.fixture(scope="module")
def log(run: RunRecord, tmp_path_factory: pytest.TempPathFactory) -> Messages:
    out = exported(run, "mcap", tmp_path_factory.mktemp("mcap"))
    assert [path.name for path in out.iterdir()] == ["run.mcap"]
    return messages_of(out / "run.mcap")


def messages_of(path: Path) -> Messages:
    """All messages of an MCAP file, each read by the description that the file brings along."""
    found: Messages = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, content in reader.iter_decoded_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            row = (schema.name, message.log_time, plain(content))
            found.setdefault(channel.topic, []).append(row)
    return found


def plain(value: Any) -> Any:
    """A message by field, a repeated field as a list."""
    if isinstance(value, Message):
        return {field.name: plain(getattr(value, field.name)) for field in value.DESCRIPTOR.fields}
    return value if isinstance(value, str | bytes | int | float) else [plain(one) for one in value]


def test_mcap_has_every_schema(log: Messages) -> None:
    assert {name for rows in log.values() for name, _, _ in rows} == {
        kind.DESCRIPTOR.full_name for kind in MESSAGES
    }


def test_mcap_has_everything_on_the_benchs_time_line(run: RunRecord, log: Messages) -> None:
    start = datetime.fromisoformat(run.events[0]["wall_time"]).timestamp() - 0.5
    at = {topic: [round(ns / 1e9 - start, 6) for _, ns, _ in rows] for topic, rows in log.items()}
    first = {topic: [0.5] for topic in ("/tf", "/lenses/left", "/lenses/right")}
    captured = """/bath /trial /stage /truth /detections/thesis /answers/thesis /cameras/left
        /cameras/thermal_radiometric /cameras/depth"""
    there = first | {topic: [1.0] for topic in captured.split()}
    assert at == there | {"/events": [0.5, 3.0], "/arm": [1.25]}
    for rows in log.values():
        for _, ns, content in rows:
            for one in content.get("transforms", [content]):
                assert one["timestamp"] == {"seconds": ns // 10**9, "nanos": ns % 10**9}


def test_mcap_frames_are_the_files_byte_for_byte(run: RunRecord, log: Messages) -> None:
    ((schema, _, content),) = log["/cameras/left"]
    (path,) = (row["path"] for row in run.trials[0].frames if row["camera"] == "left")
    assert schema == "foxglove.CompressedImage"
    assert (content["format"], content["frame_id"]) == ("png", "left")
    assert content["data"] == (run.folder / path).read_bytes()


@pytest.mark.parametrize(
    ("camera", "frame"), [("thermal_radiometric", "thermal"), ("depth", "depth")]
)
def test_mcap_16_bit_frames_are_pixels_so_that_a_viewer_can_spread_them(
    log: Messages, camera: str, frame: str
) -> None:
    ((schema, _, content),) = log[f"/cameras/{camera}"]
    assert schema == "foxglove.RawImage"
    assert (content["encoding"], content["frame_id"]) == ("mono16", frame)
    assert (content["width"], content["height"], content["step"]) == (4, 3, 8)
    assert np.array_equal(np.frombuffer(content["data"], "<u2").reshape(3, 4), RADIOMETRIC)


def test_mcap_ties_the_cameras_to_the_world_and_tells_their_lenses(log: Messages) -> None:
    """A point of the world goes through ties and lens as it goes through the calibration."""
    known = read_calibration(RIGS / "calibration.toml")
    (ties,) = (content["transforms"] for _, _, content in log["/tf"])
    pairs = [(tie["parent_frame_id"], tie["child_frame_id"]) for tie in ties]
    assert pairs == [("world", "right"), ("right", "left"), ("left", "thermal")]
    point_m, left_from_world = (
        np.array([-0.05, 0.29, 0.13]),
        (known.world_from_right @ known.right_from_left).inverse(),
    )
    wanted = left_from_world.apply([[-50.0, 290.0, 130.0]])
    for tie in ties[:2]:
        turn = Rotation.from_quat([tie["rotation"][axis] for axis in "xyzw"])
        point_m = turn.inv().apply(point_m - [tie["translation"][axis] for axis in "xyz"])
    assert np.allclose(1000.0 * point_m, wanted[0], atol=1e-9)
    ((_, _, lens),) = log["/lenses/left"]
    pixel, _ = cv2.projectPoints(
        point_m, np.zeros(3), np.zeros(3), np.reshape(lens["K"], (3, 3)), np.array(lens["D"])
    )
    assert np.allclose(pixel.ravel(), known.left.project(wanted)[0], atol=1e-6)
    assert (lens["frame_id"], lens["distortion_model"]) == ("left", "plumb_bob")
    assert (lens["width"], lens["height"]) == (1360, 1024)
    assert np.array_equal(np.reshape(lens["P"], (3, 4))[:, :3], np.reshape(lens["K"], (3, 3)))


def test_mcap_places_are_metres_in_their_frames(log: Messages) -> None:
    (stage_is, _, stage), (_, _, arm) = log["/stage"][0], log["/arm"][0]
    assert (stage_is, stage["frame_id"]) == ("foxglove.PoseInFrame", "stage")
    assert stage["pose"]["position"] == {"x": 0.1, "y": 0.0, "z": -0.005}
    assert arm["frame_id"] == "world"
    assert arm["pose"]["position"] == {"x": 0.01, "y": -0.02, "z": 0.03}
    for topic in ("/truth", "/detections/thesis"):
        schema, _, ends = log[topic][0]
        assert schema == "foxglove.PosesInFrame"
        (pose,) = ends["poses"]
        assert pose["position"] == {"x": 0.001, "y": 0.002, "z": 0.003}


def test_mcap_events_answers_and_trials_say_what_the_record_says(log: Messages) -> None:
    events = [(row["name"], row["message"], row["level"]) for _, _, row in log["/events"]]
    assert events == [("state", "preparing", 2), ("fault", "the stage is gone", 4)]
    answer = log["/answers/thesis"][0][2]
    assert (answer["success"], answer["max_error_mm"], answer["seconds"]) == (1.0, 2.5, 0.1)
    assert math.isnan(log["/bath"][0][2]["external_c"]), "not measured"
    assert (log["/trial"][0][2]["id"], log["/trial"][0][2]["invalid"]) == ("001-x-1", "")


def test_a_rotten_frame_is_not_exported(run: RunRecord, tmp_path: Path, said: Said) -> None:
    copy = Path(shutil.copytree(run.folder, tmp_path / "run"))
    (copy / "frames" / "001-x-1" / "left.png").write_bytes(b"rot")
    wrong = said(2, f"{EXPORT} --despite-damage", copy, "mcap", tmp_path / "out").err
    assert "is not as it was written: 'teatbench store check" in wrong
    assert list((tmp_path / "out").iterdir()) == []


def test_a_run_without_a_calibration_has_neither_ties_nor_lenses_and_pixels_have_16_bits(
    tmp_path: Path, said: Said
) -> None:
    store = Store.create(tmp_path / "run", {})
    facts(store)
    done = trial(store, 1)
    store.finished(done)
    said(0, EXPORT, store.folder, "mcap", tmp_path)
    assert {topic.split("/")[1] for topic in messages_of(tmp_path / "run.mcap")} == {
        "bath", "trial", "answers", "detections", "truth", "cameras",
    }  # fmt: skip
    other = trial(store, 2)
    (store.folder / other.frames[0]["path"]).unlink()
    frames = store.frames("002-x-1", {"thermal_radiometric": np.zeros((3, 4), np.uint8)}, {})
    store.finished(replace(other, frames=frames))
    store.close()
    why = "thermal_radiometric.png can't be exported: it is no grey picture of 16 bits"
    assert why in said(2, EXPORT, store.folder, "mcap", tmp_path).err


@pytest.mark.parametrize(
    ("kind", "library"), [("parquet", "pyarrow"), ("mcap", "mcap"), ("mcap", "mcap_protobuf")]
)
def test_a_missing_library_is_reported_with_what_to_do(
    run: RunRecord, kind: str, library: str, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    for name in list(sys.modules):
        if name.partition(".")[0] in (library, "mcap_protobuf"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "bench.record.mcap", raising=False)  # it is imported anew
    monkeypatch.setitem(sys.modules, library, None)
    why = f"needs {library}, which can't be imported: "
    assert why in said(2, EXPORT, run.folder, kind, run.folder.parent / "out").err


SCHEMAS = {kind.DESCRIPTOR.full_name: kind for kind in MESSAGES}
FOXGLOVES = sorted(name for name in SCHEMAS if name.startswith("foxglove."))


@pytest.mark.parametrize("name", sorted(set(SCHEMAS) - set(FOXGLOVES)))
def test_our_own_hold_only_what_every_viewer_takes(name: str) -> None:
    """Lichtblick refuses JSON schemas with two types for a field, and gives an int64 as something
    that can't be plotted.
    """
    first, *others = SCHEMAS[name].DESCRIPTOR.fields
    assert (first.number, first.name) == (1, "timestamp")
    assert first.message_type
    assert first.message_type.full_name == "google.protobuf.Timestamp"
    assert {one.type for one in others} <= {first.TYPE_DOUBLE, first.TYPE_STRING, first.TYPE_UINT32}


@pytest.mark.parametrize("name", FOXGLOVES)
def test_descriptions_are_those_of_foxgloves_own_library(name: str) -> None:
    """Options for other languages' generators and names for JSON, which follow from the fields'
    names, say nothing of the bytes.
    """
    theirs = pytest.importorskip(
        "foxglove.messages", reason="foxglove-sdk, the referee, is not installed"
    )
    kind = getattr(theirs, name.removeprefix("foxglove."))
    ours = build_file_descriptor_set(SCHEMAS[name])
    sets = [FileDescriptorSet.FromString(kind.get_schema().data), ours]
    for file in [file for files in sets for file in files.file]:
        file.ClearField("options")
        for field in [field for message in file.message_type for field in message.field]:
            field.ClearField("json_name")
    files_of = [{file.name: file for file in files.file} for files in sets]
    assert files_of[0] == files_of[1]
