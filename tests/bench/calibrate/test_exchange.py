"""Calibrations of other programs: read as those write them, or refused by the name of what can't be;
no file, however damaged, ends in a traceback.
"""

from __future__ import annotations

import json
import math
import os
import re
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from bench.calibrate import mat_values
from bench.calibrate.exchange import read_foreign, write_bouguet, write_opencv, write_ros
from bench.config import ConfigError
from bench.rig.loading import RIGS
from detector.calibration import Part, load_calibration
from detector.geometry import Camera, Motion
from tests.bench.commands import Said
from tests.conftest import ROOT
from tests.examples import examples, few
from tests.mutants import mutants

CASES = ROOT / "tests" / "data" / "cases"
KC = (-0.2, 0.1, 0.001, -0.001, 0.0)
LENS = Camera((1280, 960), (1000.0, 1000.0), (640.0, 480.0), 0.0, KC)
APART = Motion(np.eye(3), np.array([-120.0, 0.0, 0.0]))
# a list may then be longer or shorter
GOOD = (CASES / "good.yaml").read_text(encoding="utf-8").replace("  cols: 5\n", "")
STEREO = (CASES / "size_seq.yml").read_text(encoding="utf-8")


def taken(kind: str, text: str | bytes, folder: Path) -> Part:
    path = folder / ("calib.mat" if kind in ("bouguet", "matlab") else "calib.yml")
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_foreign([path], kind)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind", "why"),
    [
        ("fish_cammodel.yaml", "ros", "camera_model is 'equidistant'; only plumb_bob"),
        ("ktrans.yaml", "ros", "camera_matrix is no camera matrix: its lower row must be 0 0 1.*It is transposed"),
        ("nan.yaml", "ros", "distortion_coefficients must be finite numbers, number 1 is nan"),
        ("bfc1.mat", "bouguet", "fc_left has 1 numbers; 2 are wanted"),
    ],
)  # fmt: skip
def test_cases_from_the_field_are_refused_by_name(name: str, kind: str, why: str) -> None:
    with pytest.raises(ConfigError, match=f"{name}: {why}"):
        read_foreign([CASES / name], kind)


def test_a_size_as_c_plus_plus_writes_it() -> None:
    part = read_foreign([CASES / "size_seq.yml"], "opencv")
    assert part.left == part.right == LENS
    assert part.right_from_left is not None
    assert part.right_from_left.T.tolist() == [-120.0, 0.0, 0.0]


@pytest.mark.slow
def test_a_baseline_in_metres_is_said_at_import_and_by_the_world(
    tmp_path: Path, said: Said
) -> None:
    cameras, world = tmp_path / "c.toml", tmp_path / "w.toml"
    at_import = said(
        0, "calibrate import {} --format opencv --out {}", CASES / "metres.yml", cameras
    )
    assert "a baseline of 0.12 mm looks like metres: 120 mm are meant" in at_import.err
    given = CASES / "good.csv", cameras, world
    found = said(1, "calibrate world {} --cameras {} --out {}", *given)
    assert "wrong unit: lengths come out 1000 times too short against the arm" in found.err
    assert "in metres" in found.err


ROS_SISTERS = [
    ("distortion_model: plumb_bob", "distortion_model: equidistant", "distortion_model is 'equidistant'"),
    ("distortion_model: plumb_bob", "distortion_model: kannala_brandt", "distortion_model is 'kannala"),
    ("distortion_model: plumb_bob", "camera_model: omni", "camera_model is 'omni'"),
    ("distortion_model: plumb_bob", "distortion_model: [1]", "distortion_model must be a text"),
    ("0, 0, 1]\ndist", "0, 0, 2]\ndist", "its lower row must be 0 0 1"),
    ("[1000, 0, 640,", "[1000, 0, .inf,", "camera_matrix must be finite numbers, number 3 is inf"),
    ("[1000, 0, 640,", "[2000, 0, 640,", "camera_matrix can't be of a camera: 2000 and 1000 px differ"),
    ("[1000, 0, 640, 0, 1000,", "[4.8, 0, 640, 0, 4.8,", "no focal lengths for a picture of .*millimetres"),
    ("[1000, 0, 640,", "[1000, 0, -640,", r"the centre \(-640, 480\) lies far outside"),
    ("[1000, 0, 640,", "[-1000, 0, 640,", "focal lengths above zero"),
    ("[-0.2, 0.1, 0.001, -0.001, 0.0]", "[-0.2, 0.1, 0.001]", "has 3 coefficients; there may be 4, 5, 8, 12, 14"),
    ("[-0.2, 0.1, 0.001, -0.001, 0.0]", "[-2.0, 0.1, 0.001, -0.001, 0.0]", "folds the picture"),
    ("[-0.2, 0.1, 0.001, -0.001, 0.0]", "[-0.2, 0.1, 0, 0, 0, 1, 0, 0]", "8 coefficients; only k1 k2 p1 p2 k3"),
    ("image_width: 1280", "image_width: 1280.5", "image_width must be whole numbers, has 1280.5"),
    ("image_width: 1280", "image_width: 0", "image_width, image_height must be 1 to 65535 pixels"),
    ("image_width: 1280", "image_width: yes", "image_width must be numbers, has True"),
    ("image_width: 1280", "binning_x: 2\nimage_width: 1280", "binning_x is 2: K is of pictures without"),
    ("image_width: 1280", "roi: {x_offset: 64, y_offset: 0}\nimage_width: 1280", "roi has x_offset 64: .*part of the sensor"),
    ("image_width: 1280", "image_width: 1280\nimage_width: 640", "'image_width' is there twice"),
    ("camera_name: cam", "camera_name: &a [*a]", "an alias stands for what it is in"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "why"), ROS_SISTERS)
def test_what_no_camera_has_is_refused_by_name(
    old: str, new: str, why: str, tmp_path: Path
) -> None:
    assert old in GOOD
    with pytest.raises(ConfigError, match=why):
        taken("ros", GOOD.replace(old, new, 1), tmp_path)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("", ""),
        (
            "image_width: 1280",
            "roi: {x_offset: 0, width: 1280, do_rectify: false}\nimage_width: 1280",
        ),
        ("distortion_model: plumb_bob", "camera_model: pinhole"),
        ("image_width: 1280", "binning_x: 1\nbinning_y: 0\nimage_width: 1280"),
        ("image_width: 1280\nimage_height: 960", "width: 1280\nheight: 960"),
        ("-0.001, 0.0]", "-0.001]"),
        ("-0.001, 0.0]", "-0.001, 0.0, 0, 0, 0]"),
        ("[-0.2,", "[-2e-1,"),
        ("image_width", "# \N{BYTE ORDER MARK}\nimage_width"),
    ],
)
def test_a_sound_camera_info_is_read(old: str, new: str, tmp_path: Path) -> None:
    assert old in GOOD
    assert taken("ros", GOOD.replace(old, new, 1), tmp_path).left == LENS


STORED: dict[str, Any] = {"M1": LENS.matrix, "M2": LENS.matrix, "R": APART.R, "T": APART.T}


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
@pytest.mark.parametrize("as_list", [False, True])
def test_opencvs_file_storage_in_each_of_its_forms(
    ending: str, as_list: bool, tmp_path: Path
) -> None:
    path = tmp_path / f"stereo.{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in STORED.items():
        storage.write(name, value)
    for name in ("D1", "D2"):
        storage.write(name, np.array([KC]))
    storage.startWriteStruct("image_size", cv2.FileNode_SEQ)
    for value in (1280, 960):
        storage.write("", value)
    storage.endWriteStruct()
    storage.release()
    if as_list and ending == "json":
        values = json.loads(path.read_text(encoding="utf-8"))
        values["D1"] = list(KC)
        path.write_text(json.dumps(values), encoding="utf-8")
    part = read_foreign([path], "opencv")
    assert part.left == part.right == LENS
    assert part.right_from_left is not None
    assert part.right_from_left.T.tolist() == [-120.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("image_size: [ 1280, 960 ]", "image_size: [ 1280 ]", "image_size has 1 numbers; 2 are wanted"),
        ("image_size: [ 1280, 960 ]", "a: 1", "lacks image_size; say it with `image_size`"),
        ("cols: 3", "cols: 4", "M1 has 9 numbers for 3 x 4"),
        ("T: !!opencv-matrix", "T: nothing\nU: !!opencv-matrix", "T must be numbers, has 'nothing'"),
        ("M2:", "X2:", "lacks M2; wanted: the stereo pair's"),
        ("M2:", "fisheye_model: 1\nM2:", "fisheye_model is set"),
        ("-120.", ".Nan", "T must be .*number"),
        ("R: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1.", "R: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ -1.", "R and T are no motion"),
        ("%YAML", "<!DOCTYPE x>", "declares entities"),
    ],
)  # fmt: skip
def test_what_no_stereo_file_has_is_refused_by_name(
    old: str, new: str, why: str, tmp_path: Path
) -> None:
    assert old in STEREO
    with pytest.raises(ConfigError, match=why):
        taken("opencv", STEREO.replace(old, new, 1), tmp_path)


CAM = """  camera_model: pinhole
  distortion_coeffs: [-0.2, 0.1, 0.001, -0.001]
  distortion_model: radtan
  intrinsics: [1000.0, 1000.0, 640.0, 480.0]
  resolution: [1280, 960]
"""
KALIBR = f"""cam0:
{CAM}cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.12]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
{CAM}"""


def test_kalibrs_camchain_is_read_in_millimetres(tmp_path: Path) -> None:
    part = taken("kalibr", KALIBR, tmp_path)
    assert part.left == part.right == LENS
    assert part.right_from_left is not None
    assert part.right_from_left.T.tolist() == [-120.0, 0.0, 0.0]
    for old, new, why in (
        ("radtan", "equidistant", "distortion_model is 'equidistant'"),
        ("pinhole", "eucm", "camera_model is 'eucm'"),
        ("0.0, 0.0, 0.0, 1.0", "0.0, 0.0, 0.1, 1.0", "T_cn_cnm1 must have 0 0 0 1"),
        ("cam1:", "cam2:", "cam1 is missing"),
        ("[1280, 960]", "[1280]", "resolution has 1 numbers; 2 are wanted"),
    ):
        with pytest.raises(ConfigError, match=why):
            taken("kalibr", KALIBR.replace(old, new, 1), tmp_path)


def matlab(**changes: Any) -> dict[str, Any]:
    camera = {
        "RadialDistortion": [-0.2, 0.1],
        "TangentialDistortion": [0.001, -0.001],
        "IntrinsicMatrix": [[1000.0, 0, 0], [0, 1000.0, 0], [641.0, 481.0, 1.0]],
        "ImageSize": [960.0, 1280.0],
        "WorldUnits": "millimeters",
    }
    turn = np.array(Motion.from_vectors([0.0, 0.1, 0.0], [0.0, 0.0, 0.0]).R)
    stereo = {"RotationOfCamera2": turn.T, "TranslationOfCamera2": [[-120.0, 0.0, 0.0]]}
    for key, value in changes.items():
        (stereo if key in stereo or key == "PoseCamera2" else camera)[key] = value
    return {"s": stereo | {"CameraParameters1": camera, "CameraParameters2": camera}}


@pytest.mark.skipif(sys.platform == "win32", reason="it limits no addresses")
def test_a_mat_file_is_read_where_the_system_allows_less_memory_than_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(_: int, limits: tuple[int, int]) -> None:
        raise ValueError("not allowed to raise maximum limit")

    monkeypatch.setattr("resource.setrlimit", refused)
    assert mat_values.main(str(CASES / "bfc1.mat")) == 0
    assert "fc_left" in json.loads(capsys.readouterr().out)


@pytest.mark.weekly
def test_matlabs_structure_counts_pixels_from_one_and_transposes(tmp_path: Path) -> None:
    path = tmp_path / "stereo.mat"
    savemat(path, matlab())
    part = read_foreign([path], "matlab")
    assert part.left == LENS
    assert part.right_from_left is not None
    np.testing.assert_allclose(part.right_from_left.om, [0.0, 0.1, 0.0], atol=1e-12)
    turn = {"R": np.eye(3), "Translation": [[-0.12, 0.0, 0.0]]}
    K = [[1000.0, 0, 641.0], [0, 1000.0, 481.0], [0, 0, 1.0]]
    savemat(path, matlab(PoseCamera2=turn, WorldUnits="m", K=K))
    part = read_foreign([path], "matlab")
    assert part.right_from_left is not None
    assert part.right_from_left.T.tolist() == [-120.0, 0.0, 0.0]
    for changes, why in (
        ({"WorldUnits": "furlongs"}, "WorldUnits is 'furlongs'"),
        ({"IntrinsicMatrix": np.transpose(matlab()["s"]["CameraParameters1"]["IntrinsicMatrix"])}, "lower row"),
        ({"RadialDistortion": [0.1]}, "RadialDistortion has 1 numbers; 2 or 3 are wanted"),
    ):  # fmt: skip
        savemat(path, matlab(**changes))
        with pytest.raises(ConfigError, match=why):
            read_foreign([path], "matlab")
    savemat(path, {"a": 1.0})
    with pytest.raises(ConfigError, match="0 structures with CameraParameters1"):
        read_foreign([path], "matlab")


BOMB = "a: &a [1,1,1,1,1,1,1,1,1,1]\n" + "".join(
    f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


NO_YAML = [
    (BOMB, "aliases stand for more than 100000 values"),
    ("a: " + "[" * 5000, "lists in lists without end"),
    ("a: " + "1" * 5000, "not YAML"),
    ("a: 2026-13-45\n", "not YAML"),
    ("a: !!python/object/apply:os.system [ls]\n", "calib.yml:1: not YAML: could not determine"),
    ('a: "\\ud800"\n', "not"),
    ("a: {b: 1\n", "calib.yml:2: not YAML"),
    ("[1, 2]\n", "must be a table of names and values"),
    ("", "must be a table of names and values, is nothing"),
]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["opencv", "ros", "kalibr"])
def test_no_yaml_leaves_the_door_as_anything_else(kind: str, tmp_path: Path) -> None:
    assert len(BOMB) < 487
    for text, why in NO_YAML:
        with pytest.raises(ConfigError, match=why):
            taken(kind, text, tmp_path)


def shipped(kind: str, folder: Path) -> bytes:
    """A sound file of each format, as its own program writes it."""
    part, path = load_calibration(RIGS / "calibration.toml").part, folder / "sound"
    write = {"opencv": write_opencv, "bouguet": write_bouguet}
    if kind == "ros":
        write_ros(part, path, "left")
    elif kind == "kalibr":
        path.write_text(KALIBR, encoding="utf-8")
    elif kind == "matlab":
        savemat(path, matlab(), appendmat=False)
    else:
        path = path.with_suffix(".yml")
        write[kind](part, path)
    return path.read_bytes()


def read_mutants(kind: str, count: int, folder: Path, seed: int = 0) -> tuple[int, set[str]]:
    """How many of ``count`` mutants were read, and what was said of the others."""
    read, said = 0, set()
    for data in mutants(shipped(kind, folder), count, seed):
        try:
            part = taken(kind, data, folder)
        except ConfigError as error:
            said.add(re.sub(r"\d+", "0", str(error)))
            continue
        read += 1
        for camera in (part.left, part.right):
            assert camera is None or all(map(math.isfinite, camera.lens))
    return read, said


TEXTS = ("opencv", "ros", "kalibr")


@pytest.mark.slow
@pytest.mark.parametrize("kind", few([*TEXTS, "bouguet", "matlab"], 2))
def test_mutants_of_each_format_are_read_or_named(kind: str, tmp_path: Path) -> None:
    read, said = read_mutants(kind, examples(15) if kind in TEXTS else 2, tmp_path)
    assert read or said
    assert all("calib." in each for each in said)


@pytest.mark.slow
def test_what_kills_the_library_is_a_refusal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reader that ends by a signal, as scipy's did of 92 in 10 000 damaged files."""
    (tmp_path / "site").mkdir()
    dies = "import os, signal\nos.kill(os.getpid(), signal.SIGKILL)\n"
    dies = dies if hasattr(os, "fork") else "import os\nos._exit(3)\n"
    (tmp_path / "site" / "sitecustomize.py").write_text(dies, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "site"))
    path = tmp_path / "b.mat"
    path.write_bytes((CASES / "bfc1.mat").read_bytes())
    with pytest.raises(ConfigError, match=r"b\.mat: can't be read as a \.mat file"):
        read_foreign([path], "bouguet")


def test_what_is_written_passes_the_loader_first(
    tmp_path: Path, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even where a reader lets a value through that no calibration has."""
    lens = Camera((1280, 960), (1000.0, 1000.0), (math.nan, 480.0))
    monkeypatch.setattr("bench.calibrate.exchange.read_ros", lambda *_: Part(left=lens))
    given = CASES / "good.yaml", tmp_path / "o.toml"
    found = said(2, "calibrate import {} --format ros --out {}", *given)
    assert "not written, for it can't be" in found.err
    assert not (tmp_path / "o.toml").exists()
