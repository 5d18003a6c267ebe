"""Recordings: what is written is read back, and every damage is named with its file and line."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from bench.record import recording
from bench.record.recording import (
    FIELDS,
    Recording,
    RecordingCameras,
    RecordingError,
    RecordingWriter,
    TruthRow,
)
from instruments.camera.frame import FrameSet
from instruments.errors import DeviceError
from textfiles.whole import replace_whole

HEAD = "frame,situation,teat,x_mm,y_mm,z_mm,visible\n"
TRUTH = (
    TruthRow("ideal", "1", (-110.2, 284.2, 134.2), True, 0.23),
    TruthRow("ideal", "2", (-161.9, 1 / 3, 137.6), False),
)


def frame_set(seed: int, *, thermal: bool = True) -> FrameSet:
    rng = np.random.default_rng(seed)
    left, right = rng.integers(0, 256, (2, 24, 32), dtype=np.uint8)
    if not thermal:
        return FrameSet(left, right)
    warm, kelvin = rng.integers(0, 256, (12, 16)), rng.integers(28000, 31000, (3, 4))
    depth, strength = rng.integers(0, 65536, (2, 6, 8), dtype=np.uint16)
    pictures = left, right, warm.astype(np.uint8), kelvin.astype(np.uint16)
    return FrameSet(*pictures, depth_dmm=depth, amplitude=strength)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A recording of two frames, the second without a thermal camera."""
    writer = RecordingWriter(tmp_path / "aufnahme ä")
    writer.add_calibration("# none\n")
    writer.add("0000", frame_set(0))
    writer.add_truth("0000", TRUTH)
    writer.add("0001", frame_set(1, thermal=False))
    return tmp_path / "aufnahme ä"


def test_raw_counts_are_no_temperatures(folder: Path) -> None:
    """A Lepton that isn't radiometric gives counts of about 8192: -191 degC."""
    frame = folder / "frames" / Recording(folder).frames[0]
    counts = np.random.default_rng(1).normal(8192, 60, (120, 160)).astype(np.uint16)
    png = cv2.imencode(".png", counts)[1].tobytes()
    (frame / "thermal_radiometric.png").write_bytes(png)
    with pytest.raises(
        RecordingError, match=r"radiometric\.png: -191 degC.*no hundredths of a kel"
    ):
        Recording(folder).load(frame.name)


def test_what_is_written_is_read_back(folder: Path) -> None:
    recording = Recording(folder)
    assert recording.frames == ("0000", "0001")
    assert recording.truth == {"0000": TRUTH}
    assert recording.calibration_path.read_text(encoding="utf-8") == "# none\n"
    for seed, name in enumerate(recording.frames):
        written, read = frame_set(seed, thermal=seed == 0), recording.load(name)
        for field in FIELDS:
            one, two = getattr(written, field), getattr(read, field)
            assert (one is None and two is None) or np.array_equal(one, two)


def test_a_folder_is_continued_and_nothing_half_written_counts_or_is_left(folder: Path) -> None:
    assert not list(folder.rglob("*.part"))
    assert sorted(p.name for p in folder.iterdir()) == ["calibration.toml", "frames", "truth.csv"]
    (folder / "making 0002").mkdir()
    (folder / "making 0002" / "left.png.part").write_bytes(b"x")
    assert "0002" not in Recording(folder).frames
    writer = RecordingWriter(folder)
    writer.add("0002", frame_set(2))
    writer.add_truth("0002", TRUTH)
    assert sorted(Recording(folder).truth) == ["0000", "0002"]
    assert Recording(folder).load("0002").left.shape == (24, 32)


def test_a_frame_whose_truth_cannot_be_written_is_not_left_without_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, writer = Recording(folder).frames, RecordingWriter(folder)

    def full(path: Path, data: bytes) -> None:
        if path.name == "truth.csv":
            raise OSError(errno.ENOSPC, "No space left on device")
        replace_whole(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(recording, "replace_whole", full)
        with pytest.raises(OSError, match="No space"):
            writer.add("0002", frame_set(2), TRUTH)
    assert Recording(folder).frames == before
    writer.add("0002", frame_set(2), TRUTH)
    assert "0002" in Recording(folder).truth


@pytest.mark.parametrize("name", ["", "a/b", "a:b", "..", "a ", "a?b", "a\nb"])
def test_a_frame_id_that_a_file_system_refuses(folder: Path, name: str) -> None:
    with pytest.raises(RecordingError, match="a frame's id must be"):
        RecordingWriter(folder).add(name, frame_set(1))


def test_a_frame_or_its_truth_twice_is_refused(folder: Path) -> None:
    writer = RecordingWriter(folder)
    with pytest.raises(RecordingError, match="there is such a frame already"):
        writer.add("0000", frame_set(0))
    with pytest.raises(RecordingError, match="has its truth already"):
        writer.add_truth("0000", TRUTH)
    with pytest.raises(RecordingError, match="no such frame was added"):
        writer.add_truth("0009", TRUTH)
    with pytest.raises(RecordingError, match="each teat once"):
        writer.add_truth("0001", (TRUTH[0], TRUTH[0]))
    with pytest.raises(RecordingError, match="can't hold commas"):
        writer.add_truth("0001", (TruthRow("a,b", "1", (0.0, 0.0, 0.0), True),))


def put(path: Path, picture: Any) -> None:
    """A PNG; OpenCV writes only to the ASCII paths of Windows."""
    path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def test_colour_and_sixteen_bits_are_read_as_grey(folder: Path) -> None:
    put(folder / "frames/0000/left.png", np.full((24, 32, 3), (0, 255, 0), dtype=np.uint8))
    put(folder / "frames/0000/right.png", np.full((24, 32), 65535, dtype=np.uint16))
    frames = Recording(folder).load("0000")
    assert (frames.left[0, 0], frames.right[0, 0]) == (150, 255)


@pytest.mark.parametrize("name", ["frames/0000/left.png", "truth.csv"])
def test_a_folder_in_place_of_a_file_is_named_in_words(folder: Path, name: str) -> None:
    path = folder / name
    path.unlink()
    path.mkdir()
    with pytest.raises(RecordingError, match=r": (can't be read: )?[A-Z][a-z ]+$"):
        Recording(folder).load("0000")


def test_a_folder_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="there is no such folder"):
        Recording(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match=r"is no recording: there is no folder frames in it"):
        Recording(tmp_path)
    (tmp_path / "script.toml").touch()
    with pytest.raises(RecordingError, match=r"script\.toml: is a file"):
        Recording(tmp_path / "script.toml")
    (tmp_path / "frames").mkdir()
    with pytest.raises(RecordingError, match=r"holds no frames"):
        Recording(tmp_path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda frame: (frame / "right.png").unlink(), r"0000.right\.png: missing"),
        (
            lambda frame: (frame / "left.png").write_bytes(b"not an image"),
            r"left\.png: is not an image .*12 bytes",
        ),
        (
            lambda frame: put(frame / "thermal_radiometric.png", np.zeros((3, 4), np.uint8)),
            r"thermal_radiometric\.png: must be 16-bit grey",
        ),
        (
            lambda frame: (frame / "depth.png").unlink(),
            r"0000: a frame set's amplitude goes with a depth",
        ),
    ],
)
def test_damaged_images_are_named(
    folder: Path, damage: Callable[[Path], object], message: str
) -> None:
    damage(folder / "frames/0000")
    with pytest.raises(RecordingError, match=message):
        Recording(folder).load("0000")
    with pytest.raises(RecordingError, match=r"no frame '7'"):
        Recording(folder).load("7")


ONE = "0000,ideal,1,1,2,3,1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,teat\n", r"truth\.csv:1: the column\(s\) situation, x_mm"),
        ("", r"truth\.csv:1: the column"),
        (
            HEAD + ONE + "0000,ideal,2,1,2,3.2,1\n",
            r":3: the ends of teats '1' and '2' .* are 0.20 mm",
        ),
        (HEAD + ONE + ONE, r":3: teat '1' of frame '0000' stands here a second time"),
        (HEAD + "0000,ideal,1,1,2,x,1\n", r":2: z_mm must be a number in mm, is 'x'"),
        (HEAD + "0000,ideal,1,1,nan,3,1\n", r":2: y_mm must be finite"),
        (HEAD + "0000,ideal,1,1,2,3,yes\n", r":2: visible must be 0 or 1, is 'yes'"),
        (HEAD + "0000,ideal,1,1,2\n", r":2: has another number of values"),
        (HEAD + "0000,ideal,1,1,2,3,1,4\n", r":2: has another number of values"),
        (
            HEAD + ONE + "0000,other,2,1,2,3,1\n",
            ":3: frame '0000' is 'other' here and 'ideal' above",
        ),
        (HEAD + "0007,ideal,1,1,2,3,1\n", ":2: names frame '0007', but frames/ has no such folder"),
        (HEAD.strip() + ",u_mm\n0000,ideal,1,1,2,3,1,-1\n", ":2: u_mm, a standard uncertainty"),
        (HEAD + '0000,"ideal,1,1,2,3,1\n', r"truth\.csv:2: is not a table"),
        (HEAD + "\xff\xfe\n", "is not UTF-8 text"),
    ],
)
def test_a_damaged_truth_is_named_with_its_line(folder: Path, text: str, message: str) -> None:
    (folder / "truth.csv").write_text(text, encoding="latin-1")
    with pytest.raises(RecordingError, match=message):
        Recording(folder)


def test_cameras_play_a_recording_once(folder: Path) -> None:
    cameras = RecordingCameras(Recording(folder))
    assert np.array_equal(cameras.capture().left, frame_set(0).left)
    assert cameras.capture().thermal is None
    with pytest.raises(DeviceError, match="all 2 frames have been played"):
        cameras.capture()
    assert "aufnahme" in cameras.identity["left"]
    cameras.close()
