"""The rig file's cameras: each key reaches its camera, what a calibration declares is met, each fault
is shown in its place; and over a real wire one that loses packets. Streams are in test_new_rig.
"""

from __future__ import annotations

import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.config import ConfigError
from bench.rig.frame_capture import FrameTaker
from bench.rig.loading import LoadedRig, load_rig
from bench.rig.model import CamerasTable, Checks, OneCamera
from bench.rig.opening import conversion_of
from instruments.camera.cameras import CameraSet
from instruments.camera.frame import Conversion, Radiometry, Ranging
from instruments.camera.genicam import GenicamCamera
from instruments.camera.settings import Settings
from instruments.clock import RealClock
from tests.bench.commands import teatbench
from tests.conftest import ROOT
from tests.instruments.camera.peers import ADDRESS, gige_camera

HEAD = """
name = "cameras"
calibration = "calibration.toml"

[operator]
url = "console:"

[arm]
url = "COM1"

[bath]
url = "COM2"
profile = "julabo-presto"
"""

TABLES = """
[cameras.left]
url = "genicam:SERIAL"
resolution = [1360, 1024]
pixel_format = "Mono12p"
exposure = 8000
gain = 1.5
fps = 10
trigger = "hardware"
trigger_source = "Line2"
features = { GevSCPD = 1000, TriggerDelay = 12.5, ReverseX = true, LineMode = "Input" }
try = ["gain", "GevSCPD"]
turn_deg = 90
flip = "vertical"
mirrored = true
white = 4095
grey = "green"

[cameras.right]
url = "opencv:http://127.0.0.1:8080/right.mjpg"
try = true
"""


def rig_of(folder: Path, cameras: str) -> LoadedRig:
    (folder / "calibration.toml").write_text(
        (ROOT / "bench/rigs/calibration.toml").read_text(encoding="utf-8"), encoding="utf-8"
    )
    (folder / "rig.toml").write_text(HEAD + cameras, encoding="utf-8")
    return load_rig(folder / "rig.toml")


def test_every_key_reaches_its_camera(tmp_path: Path) -> None:
    cameras = rig_of(tmp_path, TABLES).rig.cameras
    assert cameras.note == "left genicam:SERIAL, right opencv:http://127.0.0.1:8080/right.mjpg"
    left, right = cameras.tables["left"], cameras.tables["right"]
    features: dict[str, bool | int | float | str] = {
        "GevSCPD": 1000,
        "TriggerDelay": 12.5,
        "ReverseX": True,
        "LineMode": "Input",
    }
    tries = frozenset({"gain", "GevSCPD"})
    assert left.settings == Settings(
        (1360, 1024), "Mono12p", 8000.0, 1.5, 10.0, features, "hardware", "Line2", tries
    )
    assert left.conversion() == Conversion("green", True, 90, "vertical", 4095)
    assert right.settings == Settings(tries=frozenset({"all"}))
    assert right.conversion() == Conversion()


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("", Conversion()),  # as delivered is as the calibration has it
        # the calibration's picture is a mirror image
        ("mirrored = false", Conversion(mirrored=True)),
        ("mirrored = true", Conversion()),
        ('polarity = "hot_is_white"', Conversion(inverted=True)),
        ('polarity = "hot_is_black"', Conversion()),
        # temperatures are never mirrored
        (
            "radiometric = { kelvin_per_count = 0.04 }",
            Conversion(mirrored=True, radiometry=Radiometry(0.04)),
        ),
        (
            "mirrored = false\nradiometric = { kelvin_per_count = 0.01, kelvin_at_zero = 273.15 }",
            Conversion(radiometry=Radiometry(0.01, 273.15)),
        ),
    ],
)
def test_the_thermal_picture_comes_as_the_calibration_declares_it(
    tmp_path: Path, keys: str, expected: Conversion
) -> None:
    rig = rig_of(tmp_path, f"{TABLES}{THERMAL}{keys}\n")
    assert rig.calibration.thermal.mirrored
    assert rig.calibration.thermal.polarity == "hot_is_black"
    assert conversion_of(rig.rig.cameras.tables["thermal"], rig.calibration) == expected


def test_another_calibration_asks_for_another_picture(tmp_path: Path) -> None:
    table = 'url = "opencv:2"\nmirrored = true\npolarity = "hot_is_black"'
    rig = rig_of(tmp_path, f"{TABLES}\n[cameras.thermal]\n{table}\n")
    thermal = replace(rig.calibration.thermal, mirrored=False, polarity="hot_is_white")
    other = replace(rig.calibration, thermal=thermal)
    asked = conversion_of(rig.rig.cameras.tables["thermal"], other)
    assert asked == Conversion(mirrored=True, inverted=True)


THERMAL_GIGE = '\n[cameras.thermal]\nurl = "genicam:FLIR"\n'
ALL, THERMAL = '[cameras]\nurl = "{}"\n', '\n[cameras.thermal]\nurl = "opencv:2"\n'
NO_GAIN = "radiometric = { kelvin_per_count = 0 }\n"
LEFT, RIGHT = TABLES.split("[cameras.right]")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("gain = 1.5", "gian = 1.5", 'cameras.left.gian: unknown key; did you mean "gain"?'),
        ('"genicam:SERIAL"', '"SERIAL"', "cameras.left.url: not a camera; allowed:"),
        (
            "genicam:SERIAL",
            "opencv:0",
            'cameras.left: features is for cameras of the kind "genicam:"',
        ),
        ('["gain", "GevSCPD"]', '["gein"]', 'cameras.left.try: "gein" is no setting'),
        ("turn_deg = 90", "turn_deg = 45", "cameras.left.turn_deg"),
        (
            LEFT,
            ALL.format("opencv:0,1") + LEFT,
            "cameras: either url for all cameras or a table for each, not both",
        ),
        (f"[cameras.right]{RIGHT}", "", "cameras: no url for all cameras, and no [cameras.right]"),
        (TABLES, ALL.format("genicam:X"), "cameras.url: not a camera; allowed:"),
        (
            RIGHT,
            f"{RIGHT}\n[cameras.checks]\nblack = 3\n",
            'cameras.checks.black: unknown key; did you mean "black_dn"?',
        ),
        *(
            (RIGHT, RIGHT + more, message)
            for more, message in {
                THERMAL + NO_GAIN: "kelvin_per_count: input should be greater than 0",
                THERMAL + 'radiometric = { profile = "leptom" }\n': 'did you mean "lepton"?',
                THERMAL + "radiometric = {}\n": "either profile or kelvin_per_count",
                THERMAL
                + 'shutter = "NUCAction"\n': 'shutter is for cameras of the kind "genicam:"',
                THERMAL_GIGE + "shutter = true\n": "needs a radiometric profile that knows the com",
                '\n[cameras.depth]\nurl = "opencv:3"\n': 'a depth camera is of the kind "genicam:"',
            }.items()
        ),
    ],
)
def test_each_fault_is_shown_in_its_place(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in TABLES
    with pytest.raises(ConfigError) as caught:
        rig_of(tmp_path, TABLES.replace(old, new))
    assert message in str(caught.value)


@pytest.mark.slow
def test_lost_packets_are_passed_over_and_counted(clock: RealClock) -> None:
    """About one frame in six of the left camera has holes; every set given out is whole."""
    checks = Checks(swapped=False, frozen=False)
    table = CamerasTable(url="emulator:", max_skew_s=60.0, retries=20, retry_s=0.0, checks=checks)
    events: list[str] = []
    with gige_camera("-r", "1"):
        openers = {
            "left": lambda: GenicamCamera("left", ADDRESS, clock, Settings(fps=100.0)),
            "right": lambda: GenicamCamera("right", "Fake_1", clock, Settings(fps=100.0)),
        }
        with closing(CameraSet(openers, {})) as cameras:
            taker = FrameTaker(
                cameras, table, None, clock.sleep, lambda _, text: events.append(text)
            )
            for _ in range(200):
                frames = taker.take()
                assert frames.left.shape == (512, 512)
                if taker.counts["left: lost packets"] >= 2:
                    break
    assert taker.counts["left: lost packets"] >= 2
    assert sum(taker.counts.values()) >= len(events) > 0
    told = r"left camera: lost packets: (1 damaged frame was|\d+ damaged frames were) passed over"
    assert re.search(told, " ".join(events))


FILES = """
[cameras]
settle_s = 0

[cameras.left]
url = "files:left"

[cameras.right]
url = "files:right"

[cameras.thermal]
url = "files:thermal.tiff"
radiometric = { profile = "lepton" }

[cameras.depth]
url = "files:thermal.tiff"
mm_per_count = 0.2
no_measurement = 30007
"""


def test_files_of_16_bits_go_end_to_end_into_a_recording(tmp_path: Path) -> None:
    chance = np.random.default_rng(3)
    counts = [(30000 + chance.integers(0, 800, (24, 32))).astype(np.uint16) for _ in range(2)]
    cv2.imwritemulti(str(tmp_path / "thermal.tiff"), counts)
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        for number in range(2):
            picture = chance.integers(0, 255, (48, 64)).astype(np.uint8)
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), picture)
    rig = tmp_path / "rig.toml"
    rig.write_text(HEAD + FILES, encoding="utf-8")
    out = tmp_path / "recording"
    assert teatbench("camera grab {} --out {} --count 2", rig, out) == 0
    for number, asked in enumerate(counts):
        path = out / "frames" / f"{number:04d}" / "thermal_radiometric.png"
        assert np.array_equal(np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)), asked)
        depth = np.asarray(cv2.imread(str(path.with_name("depth.png")), cv2.IMREAD_UNCHANGED))
        assert np.array_equal(depth, np.where(asked == 30007, 0, 2 * asked))
    assert teatbench("camera grab {} --out {} --count 3", rig, tmp_path / "more") == 3, "used up"


def test_a_depth_camera_says_its_counts_itself_or_the_rig_file_does(tmp_path: Path) -> None:
    def table(keys: str) -> OneCamera:
        rig = rig_of(tmp_path, f"{TABLES}\n[cameras.depth]\n{keys}\n")
        return rig.rig.cameras.tables["depth"]

    camera = table('url = "genicam:TOF"')
    assert (camera.settings.depth, conversion_of(camera, None)) == (True, Conversion())
    declared = table('url = "genicam:TOF"\nmm_per_count = 0.25\nmm_at_zero = 50.0\nturn_deg = 180')
    expected = Conversion(turn_deg=180, ranging=Ranging(0.25, 50.0, 0))
    assert conversion_of(declared, None) == expected
    assert table('url = "files:deep"').conversion().ranging == Ranging(0.1)


def test_a_radiometric_profile_sets_the_camera_and_keys_of_the_rig_go_first(tmp_path: Path) -> None:
    keys = 'radiometric = { profile = "flir-a" }\nshutter = true\nshutter_s = 0.5\n'
    asked = rig_of(tmp_path, TABLES + THERMAL_GIGE + keys).rig.cameras.tables["thermal"].settings
    assert (asked.pixel_format, asked.counts) == ("Mono16", True)
    assert dict(asked.features) == {"IRFormat": "TemperatureLinear10mK"}
    assert (asked.shutter, asked.shutter_s) == ("NUCAction", 0.5)
    own = 'pixel_format = "Mono14"\nfeatures = { IRFormat = "Radiometric" }\nshutter = "Close"\n'
    keys = 'radiometric = { profile = "flir-a" }\n' + own
    asked = rig_of(tmp_path, TABLES + THERMAL_GIGE + keys).rig.cameras.tables["thermal"].settings
    assert (asked.pixel_format, asked.features["IRFormat"]) == ("Mono14", "Radiometric")
    assert asked.shutter == "Close"
