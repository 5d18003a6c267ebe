"""16-bit counts of thermal cameras: over UVC and video through OpenCV, and from files."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from instruments.camera.files import FileCamera, pictures_at
from instruments.camera.frame import Conversion, FrameError, Radiometry
from instruments.camera.opencv import OpenCvCamera, in_use, words
from instruments.camera.radiometric import PROFILES
from instruments.camera.settings import Settings
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, LinkError

COUNTS = (29000 + np.arange(48 * 64) % 997).astype(np.uint16).reshape(48, 64)
LEPTON = Settings(pixel_format="Y16", counts=True)


class Uvc:
    """A capture of OpenCV's with a Lepton behind it. ``converts``: its backend leaves no frame as
    it is; ``formats`` are what the camera takes; ``on``: automatic functions that stay on.
    """

    def __init__(
        self,
        *,
        converts: bool = False,
        formats: tuple[str, ...] = ("Y16 ", "YUYV"),
        as_bytes: bool = False,
        on: dict[int, float] | None = None,
    ) -> None:
        self.converts, self.formats, self.as_bytes, self.on = converts, formats, as_bytes, on or {}
        self.has: dict[int, float] = {
            cv2.CAP_PROP_CONVERT_RGB: 1.0,
            cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*"YUYV"),
            cv2.CAP_PROP_FRAME_WIDTH: 64.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 48.0,
        }

    def __call__(self, *_: object) -> Uvc:
        return self

    def set(self, prop: int, value: float) -> bool:
        if prop == cv2.CAP_PROP_FOURCC:
            letters = int(value).to_bytes(4, "little").decode()
            if letters not in self.formats:
                return False
        if (prop == cv2.CAP_PROP_CONVERT_RGB and self.converts) or prop in self.on:
            return False
        self.has[prop] = value
        return True

    def get(self, prop: int) -> float:
        return self.on.get(prop, self.has.get(prop, 0.0))

    def isOpened(self) -> bool:  # noqa: N802 - as OpenCV has it
        return True

    def getBackendName(self) -> str:  # noqa: N802 - as OpenCV has it
        return "V4L2"

    def grab(self) -> bool:
        return True

    def retrieve(self) -> tuple[bool, Any]:
        raw = self.has[cv2.CAP_PROP_CONVERT_RGB] == 0.0
        if not raw or self.has[cv2.CAP_PROP_FOURCC] != cv2.VideoWriter.fourcc(*"Y16 "):
            return True, np.full((48, 64, 3), 90, np.uint8)
        return True, COUNTS.view(np.uint8).reshape(1, -1) if self.as_bytes else COUNTS

    def release(self) -> None:
        pass


def opened(monkeypatch: pytest.MonkeyPatch, device: Uvc, settings: Settings) -> OpenCvCamera:
    """At the path of a file, so that no thread reads it."""
    monkeypatch.setattr("instruments.camera.opencv.cv2.VideoCapture", device)
    return OpenCvCamera("thermal", "there.avi", VirtualClock(), settings)


@pytest.mark.parametrize(
    ("name", "centikelvin", "as_bytes"),
    [("lepton", 1, False), ("lepton", 1, True), ("boson", 1, False), ("lepton-low-gain", 10, True)],
)
def test_y16_becomes_temperatures_to_the_last_count(
    monkeypatch: pytest.MonkeyPatch, name: str, centikelvin: int, as_bytes: bool
) -> None:
    camera = opened(monkeypatch, Uvc(as_bytes=as_bytes), LEPTON)
    camera.begin()
    frame = camera.take()
    assert frame.bits == 16
    profile = PROFILES[name]
    assert profile.pixel_format == LEPTON.pixel_format
    counts = COUNTS // centikelvin
    declared = Conversion(radiometry=Radiometry(profile.kelvin_per_count))
    seen = declared.temperatures(replace(frame, pixels=counts))
    assert np.array_equal(seen, counts * centikelvin)


def test_whoever_asks_for_counts_and_gets_pictures_is_refused_with_the_cause(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(DeviceError, match=r"converted pictures only.*CONVERT_RGB = 0.*V4L2"):
        opened(monkeypatch, Uvc(converts=True), LEPTON)
    with pytest.raises(DeviceError, match="pixel_format asked Y16, is YUYV"):
        opened(monkeypatch, Uvc(formats=("YUYV",)), LEPTON)
    plain = opened(monkeypatch, Uvc(), Settings(counts=True))
    plain.begin()
    with pytest.raises(ValueError, match=r"but a frame of 8 bits came.*Y16"):
        Conversion(radiometry=Radiometry(0.01)).temperatures(plain.take())


def test_a_video_of_16_bits_through_the_library(tmp_path: Path) -> None:
    path = str(tmp_path / "thermal.mkv")
    depth = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    fourcc = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(path, cv2.CAP_FFMPEG, fourcc, 9.0, (64, 48), depth)
    writer.write(COUNTS)
    writer.release()
    camera = OpenCvCamera("thermal", path, VirtualClock(), Settings(counts=True))
    camera.begin()
    assert np.array_equal(camera.take().pixels, COUNTS)
    camera.close()


def test_bytes_that_are_no_words_stay_as_they_are() -> None:
    picture = np.zeros((48, 64, 3), np.uint8)
    assert words(picture, 64, 48) is picture
    assert words(COUNTS, 64, 48) is COUNTS


AUTOMATIC = {
    "exposure = 3": cv2.CAP_PROP_AUTO_EXPOSURE,
    "white balance = 1": cv2.CAP_PROP_AUTO_WB,
    "focus = 1": cv2.CAP_PROP_AUTOFOCUS,
}


@pytest.mark.parametrize("name", AUTOMATIC)
def test_each_automatic_function_of_a_usb_camera_is_switched_off_or_told(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    prop, value = AUTOMATIC[name], float(name.split()[-1])
    monkeypatch.setattr("instruments.camera.opencv.LiveReader", lambda *_: None)
    device = Uvc()
    device.has[prop] = value
    monkeypatch.setattr("instruments.camera.opencv.cv2.VideoCapture", device)
    obeys = OpenCvCamera("left", 0, VirtualClock())
    assert "automatic" not in obeys.identity
    assert device.get(prop) != value
    monkeypatch.setattr("instruments.camera.opencv.cv2.VideoCapture", Uvc(on={prop: value}))
    with pytest.raises(DeviceError, match=f"can't be switched off: {name}.*auto = true"):
        OpenCvCamera("left", 0, VirtualClock())
    allowed = OpenCvCamera("left", 0, VirtualClock(), Settings(auto=True))
    assert f"automatic functions are on: {name}" in allowed.identity


# Files


def test_files_come_in_the_order_of_their_numbers_and_pages_one_by_one(tmp_path: Path) -> None:
    for number in (10, 2, 1):
        cv2.imwrite(str(tmp_path / f"t{number}.png"), COUNTS + np.uint16(number))
    cv2.imwritemulti(str(tmp_path / "u.tiff"), [COUNTS, COUNTS + np.uint16(7)])
    (tmp_path / "notes.txt").write_text("no picture", encoding="utf-8")
    camera = FileCamera("thermal", tmp_path, VirtualClock())
    seen = []
    for _ in range(5):
        camera.begin()
        frame = camera.take()
        assert frame.bits == 16
        seen.append(int(frame.pixels[0, 0]) - 29000)
    assert seen == [1, 2, 10, 0, 7]
    with pytest.raises(LinkError, match="its 4 files are used up"):
        camera.take()
    camera.close()
    camera.close()
    assert [path.name for path in pictures_at(tmp_path / "t?.png")] == ["t1.png", "t2.png"]


def test_files_that_are_no_pictures_are_said(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="no picture is there"):
        FileCamera("thermal", tmp_path, VirtualClock())
    (tmp_path / "a.png").write_bytes(b"\x89PNG cut")
    cv2.imwrite(str(tmp_path / "b.tiff"), COUNTS.astype(np.float32))
    camera = FileCamera("thermal", tmp_path, VirtualClock())
    for wrong in (r"a\.png is no picture", r"b\.tiff is a picture of float32"):
        camera.begin()
        with pytest.raises(FrameError, match=wrong):
            camera.take()


def _ends_meanwhile(look: Callable[[Any], Any], place: Any) -> Any:
    """Every process ends between the list of all and the look at its files."""
    if str(place).endswith("/fd"):
        raise FileNotFoundError(place)
    return look(place)


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs Linux's /proc")
def test_a_device_in_use_is_told_with_its_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "video9"
    path.touch()
    assert in_use(str(path)) == ""
    hold = "import sys; held = open(sys.argv[1]); print(flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", hold, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout
        other.stdout.readline()
        assert in_use(str(path)).endswith(f"(process {other.pid})")
        other.communicate()
    for name in ("scandir", "listdir"):
        monkeypatch.setattr(os, name, partial(_ends_meanwhile, getattr(os, name)))
    assert in_use(str(path)) == ""
