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
from scipy.spatial.transform import Rotation

from bench.cli.main import main
from bench.config import read_calibration
from bench.record.mcap import MESSAGES
from bench.record.reader import RunRecord, read_run
from bench.record.writer import Store
from bench.rig.loading import RIGS
from bench.scoring.scene import score_scene
from instruments.clock import wall_time
from tests.bench.mcap_reading import messages_of
from tests.bench.record.test_record import facts, trial

RADIOMETRIC = np.arange(29_300, 29_312, dtype=np.uint16).reshape(3, 4)
SCORE = score_scene(
    [[1.5, 0.0, 0.0], [60.0, 2.5, 0.0]], [[0.0, 0.0, 0.0], [60.0, 0.0, 0.0]], [True, True],
    u_mm=0.2, seconds=0.1, limit_mm=5.0, time_limit_s=2.0,
)  # fmt: skip
TOUCH: dict[str, Any] = {
    "teat": "1",
    "touch": 1,
    "t_s": 1.25,
    "x_mm": 10.0,
    "y_mm": -20.0,
    "z_mm": 30.0,
}
TOUCH |= {"spread_mm": 0.1, "packets": 40, "counts": "[1, 2]"}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunRecord:
    folder = tmp_path_factory.mktemp("exports") / "run"
    store = Store.create(
        folder, {"calibration.toml": (RIGS / "calibration.toml").read_text(encoding="utf-8")}
    )
    facts(store)
    store.event(0.5, "state", "preparing", wall_time())
    made = trial(store, 1)
    frames = store.frames(
        "001-x-1",
        {"left": np.full((6, 8), 1, np.uint8), "thermal_radiometric": RADIOMETRIC},
        {"left": 1.0},
    )
    times: dict[str, Any] = {"started_s": 0.75, "captured_s": 1.0, "ended_s": 2.0}
    times |= {"stage_mm": "[100.0, 0.0, -5.0]", "bath_c": 33.0, "bath_state": "stable"}
    touch = {"trial": "001-x-1", **TOUCH}
    head, scores = {**made.head, **times}, {"thesis": SCORE}
    store.finished(replace(made, head=head, frames=frames, touches=[touch], scores=scores))
    store.event(3.0, "fault", "the stage is gone", wall_time())
    store.close()
    return read_run(folder)


def exported(run: RunRecord, kind: str, out: Path) -> Path:
    assert main(["store", "export", str(run.folder), "--format", kind, "--out", str(out)]) == 0
    return out


def test_csv_has_every_table_and_empty_fields_for_what_was_not_measured(
    run: RunRecord, tmp_path: Path
) -> None:
    out = exported(run, "csv", tmp_path)
    with (out / "touches.csv").open(encoding="utf-8", newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["trial"], float(row["t_s"]), float(row["y_mm"]), row["refused"]) == (
        "001-x-1",
        1.25,
        -20.0,
        "",
    )
    with (out / "bath.csv").open(encoding="utf-8", newline="") as file:
        (reading,) = csv.DictReader(file)
    assert (float(reading["temp_c"]), reading["external_c"]) == (33.0, "")
    tables = "facts events bath trials frames touches truth checks detections found scores skipped"
    assert {*tables.split(), "chain"} <= {path.stem for path in out.iterdir()}


def test_parquet_keeps_types_and_nulls_and_names_its_run(run: RunRecord, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra 'export' is not installed")
    out = exported(run, "parquet", tmp_path)
    touches = parquet.read_table(out / "touches.parquet")
    assert {name: str(touches.schema.field(name).type) for name in ("trial", "t_s", "packets")} == {
        "trial": "string",
        "t_s": "double",
        "packets": "int64",
    }
    assert touches.to_pylist()[0] | TOUCH == touches.to_pylist()[0]
    assert touches.to_pylist()[0]["refused"] is None
    assert parquet.read_table(out / "skipped.parquet").num_rows == 0
    assert run.head is not None
    assert (
        touches.schema.metadata | {b"run": b"run", b"wall_digest": run.head.wall_digest.encode()}
        == touches.schema.metadata
    )


@pytest.fixture(scope="module")
def log(
    run: RunRecord, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, list[tuple[str, int, Any]]]:
    """All messages of the MCAP file by topic: schema, time in ns, content."""
    reader = pytest.importorskip("mcap.reader", reason="the extra 'export' is not installed")
    out = exported(run, "mcap", tmp_path_factory.mktemp("mcap"))
    assert [path.name for path in out.iterdir()] == ["run.mcap"]
    return messages_of(out / "run.mcap", reader)


def test_mcap_has_every_schema(log: dict[str, list[tuple[str, int, Any]]]) -> None:
    assert {name for rows in log.values() for name, _, _ in rows} == {
        kind.DESCRIPTOR.full_name for kind in MESSAGES
    }


def test_mcap_has_everything_on_the_benchs_time_line(
    run: RunRecord, log: dict[str, list[tuple[str, int, Any]]]
) -> None:
    start = datetime.fromisoformat(run.events[0]["wall_time"]).timestamp() - 0.5
    at = {topic: [round(ns / 1e9 - start, 6) for _, ns, _ in rows] for topic, rows in log.items()}
    assert at == {
        "/tf": [0.5],
        "/lenses/left": [0.5],
        "/lenses/right": [0.5],
        "/events": [0.5, 3.0],
        "/bath": [1.0],
        "/trial": [1.0],
        "/stage": [1.0],
        "/arm": [1.25],
        "/truth": [1.0],
        "/detections/thesis": [1.0],
        "/answers/thesis": [1.0],
        "/cameras/left": [1.0],
        "/cameras/thermal_radiometric": [1.0],
    }
    for rows in log.values():
        for _, ns, content in rows:
            for one in content.get("transforms", [content]):
                assert one["timestamp"] == {"seconds": ns // 10**9, "nanos": ns % 10**9}


def test_mcap_frames_are_the_files_byte_for_byte(
    run: RunRecord, log: dict[str, list[tuple[str, int, Any]]]
) -> None:
    ((schema, _, content),) = log["/cameras/left"]
    (path,) = (row["path"] for row in run.trials[0].frames if row["camera"] == "left")
    assert (schema, content["format"], content["frame_id"]) == (
        "foxglove.CompressedImage",
        "png",
        "left",
    )
    assert content["data"] == (run.folder / path).read_bytes()


def test_mcap_radiometric_frames_are_pixels_so_that_a_viewer_can_spread_them(
    log: dict[str, list[tuple[str, int, Any]]],
) -> None:
    ((schema, _, content),) = log["/cameras/thermal_radiometric"]
    assert (schema, content["encoding"], content["frame_id"]) == (
        "foxglove.RawImage",
        "mono16",
        "thermal",
    )
    assert (content["width"], content["height"], content["step"]) == (4, 3, 8)
    assert np.array_equal(np.frombuffer(content["data"], "<u2").reshape(3, 4), RADIOMETRIC)


def test_mcap_ties_the_cameras_to_the_world_and_tells_their_lenses(
    log: dict[str, list[tuple[str, int, Any]]],
) -> None:
    """A point of the world goes through the ties and the lens as it goes through the
    calibration.
    """
    known = read_calibration(RIGS / "calibration.toml")
    (ties,) = (content["transforms"] for _, _, content in log["/tf"])
    assert [(tie["parent_frame_id"], tie["child_frame_id"]) for tie in ties] == [
        ("world", "right"),
        ("right", "left"),
        ("left", "thermal"),
    ]
    point_m, wanted = (
        np.array([-0.05, 0.29, 0.13]),
        (known.world_from_right @ known.right_from_left).inverse().apply([[-50.0, 290.0, 130.0]]),
    )
    for tie in ties[:2]:
        turn = Rotation.from_quat([tie["rotation"][axis] for axis in "xyzw"])
        point_m = turn.inv().apply(point_m - [tie["translation"][axis] for axis in "xyz"])
    assert np.allclose(1000.0 * point_m, wanted[0], atol=1e-9)
    ((_, _, lens),) = log["/lenses/left"]
    pixel, _ = cv2.projectPoints(
        point_m, np.zeros(3), np.zeros(3), np.reshape(lens["K"], (3, 3)), np.array(lens["D"])
    )
    assert np.allclose(pixel.ravel(), known.left.project(wanted)[0], atol=1e-6)
    assert (lens["frame_id"], lens["width"], lens["height"], lens["distortion_model"]) == (
        "left",
        1360,
        1024,
        "plumb_bob",
    )
    assert np.array_equal(np.reshape(lens["P"], (3, 4))[:, :3], np.reshape(lens["K"], (3, 3)))


def test_mcap_places_are_metres_in_their_frames(log: dict[str, list[tuple[str, int, Any]]]) -> None:
    stage, arm = log["/stage"][0], log["/arm"][0]
    assert (stage[0], stage[2]["frame_id"], stage[2]["pose"]["position"]) == (
        "foxglove.PoseInFrame",
        "stage",
        {"x": 0.1, "y": 0.0, "z": -0.005},
    )
    assert (arm[2]["frame_id"], arm[2]["pose"]["position"]) == (
        "world",
        {"x": 0.01, "y": -0.02, "z": 0.03},
    )
    for topic in ("/truth", "/detections/thesis"):
        assert log[topic][0][0] == "foxglove.PosesInFrame"
        assert [pose["position"] for pose in log[topic][0][2]["poses"]] == [
            {"x": 0.001, "y": 0.002, "z": 0.003}
        ]


def test_mcap_events_answers_and_trials_say_what_the_record_says(
    log: dict[str, list[tuple[str, int, Any]]],
) -> None:
    assert [(row["name"], row["message"], row["level"]) for _, _, row in log["/events"]] == [
        ("state", "preparing", 2),
        ("fault", "the stage is gone", 4),
    ]
    answer = log["/answers/thesis"][0][2]
    assert (answer["success"], answer["max_error_mm"], answer["seconds"]) == (1.0, 2.5, 0.1)
    assert math.isnan(log["/bath"][0][2]["external_c"]), "not measured"
    assert (log["/trial"][0][2]["id"], log["/trial"][0][2]["invalid"]) == ("001-x-1", "")


def test_a_rotten_frame_is_not_exported(
    run: RunRecord, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mcap", reason="the extra 'export' is not installed")
    copy = Path(shutil.copytree(run.folder, tmp_path / "run"))
    (copy / "frames" / "001-x-1" / "left.png").write_bytes(b"rot")
    export = ["store", "export", str(copy), "--format", "mcap", "--out", str(tmp_path / "out")]
    assert main([*export, "--despite-damage"]) == 2
    assert "is not as it was written: 'teatbench store check" in capsys.readouterr().err
    assert list((tmp_path / "out").iterdir()) == []


def test_a_run_without_a_calibration_has_neither_ties_nor_lenses_and_pixels_have_16_bits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reader = pytest.importorskip("mcap.reader", reason="the extra 'export' is not installed")
    store = Store.create(tmp_path / "run", {})
    facts(store)
    done = trial(store, 1)
    store.finished(done)
    export = ["store", "export", str(store.folder), "--format", "mcap", "--out", str(tmp_path)]
    assert main(export) == 0
    assert {topic.split("/")[1] for topic in messages_of(tmp_path / "run.mcap", reader)} == {
        "bath", "trial", "answers", "detections", "truth", "cameras",
    }  # fmt: skip
    other = trial(store, 2)
    (store.folder / other.frames[0]["path"]).unlink()
    frames = store.frames("002-x-1", {"thermal_radiometric": np.zeros((3, 4), np.uint8)}, {})
    store.finished(replace(other, frames=frames))
    store.close()
    assert main(export) == 2
    why = "thermal_radiometric.png can't be exported: it is no grey picture of 16 bits"
    assert why in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kind", "library"), [("parquet", "pyarrow"), ("mcap", "mcap"), ("mcap", "mcap_protobuf")]
)
def test_a_missing_library_is_told_with_what_to_do(
    run: RunRecord,
    tmp_path: Path,
    kind: str,
    library: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in [
        name for name in sys.modules if name.partition(".")[0] in (library, "mcap_protobuf")
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "bench.record.mcap", raising=False)  # it is imported anew
    monkeypatch.setitem(sys.modules, library, None)
    assert main(["store", "export", str(run.folder), "--format", kind, "--out", str(tmp_path)]) == 2
    assert f"needs {library}, which can't be imported: " in capsys.readouterr().err
