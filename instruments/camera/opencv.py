"""A camera through OpenCV: a device's number or path, a video file, or a stream (`http://` MJPEG,
`rtsp://`). Live sources are read without pause, files frame by frame, by PyAV if not MJPEG.
"""

from __future__ import annotations

import math
import os
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.camera.closing import CLOSE_S
from instruments.camera.frame import FrameError, FrameFault, RawFrame
from instruments.camera.settings import UNSEEN_SIZE, Settings, apply, hold_still
from instruments.clock import Clock
from instruments.errors import DeviceError, LinkError

if TYPE_CHECKING:
    from instruments.camera.video_file import VideoFile

Source = int | str
SILENCE_S = 5.0  # a stream that is silent for so long is gone
OPEN_S = 15.0  # a stream opens with its first frame
LOOK_S = 0.002
TIMEOUT_S = 2.0  # the longest exposure and interval that a frame of a fast source may take
LONGEST_WAIT_S = 4.5  # and of a slow one; less than the silence that ends a stream
INTERVALS = 3.0  # a frame under way, the one that is wanted, and a late one
SIZE = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
NUMBERS = {"fps": cv2.CAP_PROP_FPS, "exposure": cv2.CAP_PROP_EXPOSURE, "gain": cv2.CAP_PROP_GAIN}
# how backends call an exposure that isn't automatic: V4L2's own number, and OpenCV's before 4
MANUAL, MANUAL_OF_OLD = 1.0, 0.25
AUTO = {
    "exposure": (cv2.CAP_PROP_AUTO_EXPOSURE, (MANUAL, MANUAL_OF_OLD)),
    "white balance": (cv2.CAP_PROP_AUTO_WB, (0.0,)),
    "focus": (cv2.CAP_PROP_AUTOFOCUS, (0.0,)),
}


def is_live(source: Source) -> bool:
    """Whether frames come unasked: from a device or a stream, not a file."""
    return is_device(source) or _is_url(source)


def is_device(source: Source) -> bool:
    """Whether it is a camera of this machine."""
    return isinstance(source, int) or source.startswith("/dev/")


def _is_url(source: Source) -> bool:
    return isinstance(source, str) and "://" in source


def _size(capture: cv2.VideoCapture) -> tuple[int, int]:
    """Width and height, 0 where the backend gives none."""
    width, height = (capture.get(prop) for prop in SIZE)
    return round(width), round(height)


class LiveReader:
    """Fresh frames: a thread grabs all the time and decodes on request. Owns ``capture``."""

    def __init__(self, capture: cv2.VideoCapture, clock: Clock, name: str) -> None:
        self._capture = capture
        self._clock = clock
        self._lock = threading.Lock()
        self._wanted_s = math.inf
        self._got: tuple[NDArray[Any] | None, float] | None = None
        self._closing = False
        self._intervals_s: deque[float] = deque(maxlen=5)
        self.broken = False
        self._thread = threading.Thread(target=self._read, name=f"{name} camera", daemon=True)
        self._thread.start()

    def ask(self) -> None:
        """The next frame that arrives whole from now on is wanted."""
        with self._lock:
            self._got, self._wanted_s = None, self._clock.now()

    def wait_s(self, least_s: float) -> float:
        """How long to wait for a frame: some intervals of a slow source, which it has to show."""
        with self._lock:
            known_s = INTERVALS * max(self._intervals_s, default=math.inf)
        return max(least_s, min(known_s, LONGEST_WAIT_S))

    def answer(self, timeout_s: float) -> tuple[NDArray[Any] | None, float] | None:
        """The frame (None: undecodable) and its arrival; None where none came in ``timeout_s``."""
        end_s = self._clock.now() + timeout_s
        while self._clock.now() < end_s:
            with self._lock:
                if self._got is not None or self.broken:
                    return self._got
            self._clock.sleep(LOOK_S)
        return None

    def close(self) -> None:
        """Wait 2 s at most for the thread's end: it ends with its frame, or its source's time-out.
        May be called again.
        """
        self._closing = True
        self._thread.join(CLOSE_S)

    def _read(self) -> None:
        try:
            last_s = math.inf
            while not self._closing:
                began_s = self._clock.now()
                if not self._capture.grab():
                    self.broken = True
                    return
                arrived_s = self._clock.now()
                with self._lock:
                    self._intervals_s.extend([arrived_s - last_s] if last_s <= arrived_s else [])
                last_s = arrived_s
                if began_s < self._wanted_s:
                    continue
                good, image = self._capture.retrieve()
                whole = good and image is not None
                with self._lock:
                    if began_s >= self._wanted_s:  # not asked anew meanwhile
                        self._wanted_s = math.inf
                        self._got = np.asarray(image) if whole else None, arrived_s
        finally:
            self._capture.release()


class OpenCvCamera:
    """``name``: its place in the rig. Raises LinkError, DeviceError for settings not taken."""

    def __init__(
        self,
        name: str,
        source: Source,
        clock: Clock,
        settings: Settings | None = None,
        *,
        timeout_s: float = TIMEOUT_S,
    ) -> None:
        self._name, self._source, self._clock = name, source, clock
        self._who = f"{name} camera at {source}"
        self._settings, self._timeout_s = settings or Settings(), timeout_s
        self._live: LiveReader | None = None
        self._file: cv2.VideoCapture | VideoFile | None = None
        self._begun_s: float | None = None
        self._open()

    def glance(self) -> None:
        """Raises LinkError where a live source broke off: its link, or its device's node, went."""
        if self._live is not None and self._live.broken:
            hint = "Check the camera's power and its cable."
            raise LinkError(self._who, "the stream broke off", hint=hint)

    def prepare(self) -> None:
        """Nothing is needed."""

    def begin(self) -> None:
        """Ask for a fresh frame, a file's next. Reopens a broken stream once. Raises LinkError."""
        if self._live is not None:
            if self._live.broken:
                self._live.close()
                self._open()
            self._live.ask()
            return
        self._begun_s = self._clock.now()
        if self._file is None or not self._file.grab():
            hint = "The file has ended, or was closed."
            raise LinkError(self._who, "gave no frame", asked="a frame", hint=hint)

    def take(self) -> RawFrame:
        """The frame; of a live source the next whole one, others are passed over and counted in it.
        Raises FrameError where none came in time or a file's can't be decoded.
        """
        if self._live is not None:
            return self._take_live(self._live)
        good, decoded = self._file.retrieve() if self._file is not None else (False, None)
        image = self._decoded(decoded if good else None)
        if image is None:
            raise self._fault(FrameFault.HALF, "a frame came that can't be decoded")
        return self._frame(image, self._begun_s or 0.0)

    def _take_live(self, live: LiveReader) -> RawFrame:
        wait_s, passed = live.wait_s(self._timeout_s), 0
        end_s = self._clock.now() + wait_s
        while (answer := live.answer(end_s - self._clock.now())) is not None:
            image = self._decoded(answer[0])
            if image is not None:
                return self._frame(image, answer[1], passed)
            passed += 1
            live.ask()
        if passed:
            what = f"no whole frame came, {passed} that can't be decoded"
            raise self._fault(FrameFault.HALF, what, wait_s)
        if live.broken:
            raise self._fault(FrameFault.DROPPED, "the stream broke off")
        raise self._fault(FrameFault.DROPPED, "no frame came", wait_s)

    def _decoded(self, image: NDArray[Any] | None) -> NDArray[Any] | None:
        """Pixels of what the library gave; None for a damaged frame."""
        if image is None or not image.size:
            return None
        if not self._is_jpeg:
            return np.asarray(image)
        decoded = cv2.imdecode(image, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        return None if decoded is None else np.asarray(decoded, dtype=np.uint8)

    def _frame(self, image: NDArray[Any], exposed_s: float, passed: int = 0) -> RawFrame:
        """A frame of the size that was opened. Raises FrameError for another."""
        if self._settings.counts:
            image = words(image, *self._size)
        height, width = image.shape[:2]
        if self._size[0] and (width, height) != self._size:
            opened = f"{self._size[0]} x {self._size[1]}"
            what = f"a frame of {width} x {height} came; it was opened with {opened}"
            raise self._fault(FrameFault.WRONG_SIZE, what)
        return RawFrame(image, exposed_s, 8 * image.itemsize, passed_over=passed)

    def close(self) -> None:
        """Let it go; may be called again."""
        if self._live is not None:
            self._live.close()
        if self._file is not None:
            self._file.release()
        self._file = None

    def _fault(self, fault: FrameFault, what: str, seconds: float | None = None) -> FrameError:
        hint = "Is it still connected, and is the network fast enough?"
        if fault is FrameFault.WRONG_SIZE:
            hint = "Have it keep one picture size; then open it again."
        return FrameError(fault, self._name, self._who, what, seconds=seconds, hint=hint)

    def _open(self) -> None:
        if _is_url(self._source):
            opening, reading = (round(1000 * limit_s) for limit_s in (OPEN_S, SILENCE_S))
            parameters = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, opening]
            parameters += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, reading]
            capture = cv2.VideoCapture(self._source, cv2.CAP_FFMPEG, parameters)
        else:
            capture = cv2.VideoCapture(self._source)
        try:
            notes = self._set_up(capture)
        except BaseException:
            capture.release()
            raise
        width, height = self._size
        known = f"{self._source} ({capture.getBackendName()}, {width} x {height})"
        self.identity = "; ".join([known, *notes])
        if is_live(self._source):
            self._live = LiveReader(capture, self._clock, self._name)
        elif self._scaled:
            from instruments.camera.video_file import VideoFile  # its library takes long to load

            capture.release()
            self._file = VideoFile(Path(str(self._source)), self._who, self._settings.counts)
        else:
            self._file = capture

    def _set_up(self, capture: cv2.VideoCapture) -> tuple[str, ...]:
        """Make the settings; notes about what did not take."""
        if not capture.isOpened():
            asked = f"cv2.VideoCapture({self._source!r})"
            hint = "Check its number, path or URL, and that no other program holds it."
            if used_by := in_use(self._source):
                hint = f"It is in use by {used_by}: end that program."
            raise LinkError(self._who, "can't be opened", asked=asked, hint=hint)
        notes = apply_settings(self._who, capture, self._settings)
        if is_device(self._source):
            notes = (*_held_still(self._who, capture, self._settings), *notes)
        is_ffmpeg = capture.getBackendName() == "FFMPEG"
        if is_ffmpeg:  # frames as they are stored
            capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0.0)
        self._size = _size(capture)
        # undecoded, since the library scales a frame of another size to the first one's
        codec = fourcc_name(capture.get(cv2.CAP_PROP_FOURCC))
        self._is_jpeg = codec == "MJPG" and is_ffmpeg and capture.set(cv2.CAP_PROP_FORMAT, -1)
        self._scaled = is_ffmpeg and not self._is_jpeg
        if not self._scaled or not _is_url(self._source):
            return notes
        what = f"{UNSEEN_SIZE}: the library scales frames of {codec} back"
        if not {"all", "resolution"} & self._settings.tries:
            hint = 'Have it send MJPEG; or try = ["resolution"] in the rig file: the report says'
            raise DeviceError(self._who, what, hint=f"{hint} so.")
        return (*notes, what)


def in_use(source: Source) -> str:
    """Which other program of this user holds a device of Linux: name and number; "" for none."""
    path = f"/dev/video{source}" if isinstance(source, int) else source
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it ends meanwhile, or is another user's
            held = [str(link.readlink()) for link in (process / "fd").iterdir()]
            if process.name != str(os.getpid()) and path in held:
                name = (process / "comm").read_text(encoding="utf-8").strip()
                return f"{name} (process {process.name})"
    return ""


def apply_settings(who: str, capture: cv2.VideoCapture, settings: Settings) -> tuple[str, ...]:
    """Write and read back; notes about tries. Raises DeviceError for what did not take."""

    def set_fourcc(name: str) -> None:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*name[:4].ljust(4)))

    def set_size(size: tuple[int, int]) -> None:
        for prop, value in zip(SIZE, size, strict=True):
            capture.set(prop, value)

    ways: dict[str, tuple[Callable[[Any], object], Callable[[], object]]] = {
        "pixel_format": (set_fourcc, lambda: fourcc_name(capture.get(cv2.CAP_PROP_FOURCC))),
        "resolution": (set_size, partial(_size, capture)),
    }
    for name, prop in NUMBERS.items():
        ways[name] = partial(capture.set, prop), partial(capture.get, prop)
    if settings.counts:
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0.0)
        if capture.get(cv2.CAP_PROP_CONVERT_RGB) != 0.0:
            what = "temperatures are asked for (radiometric), but it gives converted pictures only"
            hint = f"OpenCV's backend {capture.getBackendName()} can't leave frames as they are."
            asked = "CAP_PROP_CONVERT_RGB = 0"
            raise DeviceError(who, what, asked=asked, hint=f"{hint} Use another one, or genicam:.")
    return apply(who, settings, ways)


def _held_still(who: str, capture: cv2.VideoCapture, settings: Settings) -> tuple[str, ...]:
    def state(prop: int, off: tuple[float, ...], switch_off: bool) -> str:
        if switch_off:
            any(capture.set(prop, value) for value in off)
        value = capture.get(prop)
        return "" if value <= 0.0 or value in off else f"= {value:g}"

    return hold_still(who, settings, {name: partial(state, *how) for name, how in AUTO.items()})


def words(image: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """16-bit counts that a backend handed over as bytes, of any shape; else ``image``."""
    if image.dtype == np.uint8 and image.size == 2 * width * height:
        return np.frombuffer(image.tobytes(), dtype="<u2").reshape(height, width)
    return image


def fourcc_name(code: float) -> str:
    """The four letters of a pixel format's number; "none" where the backend gives none."""
    if not math.isfinite(code) or code <= 0:
        return "none"
    return int(code).to_bytes(4, "little").decode("latin-1").strip()
