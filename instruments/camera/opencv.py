"""Real cameras through OpenCV: a device's number, a video file, or a stream's URL for each of left, right and thermal.

May not know what the pictures show, nor the scene that emulated cameras look at.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.camera.frame import FrameSet, grey8
from instruments.errors import DeviceError, LinkError, ProtocolError

Source = int | str
REQUIRED = ("left", "right")
KNOWN = (*REQUIRED, "thermal")


class Timed(Protocol):
    """What tells the time."""

    def now(self) -> float:
        """Seconds."""
        ...


class OpenCvCameras:
    """One `cv2.VideoCapture` for each source; ``sources`` maps left, right and perhaps thermal to a device number, path or URL.

    Raises LinkError for a source that doesn't open or stops answering, DeviceError for a set of cameras that can't serve.
    """

    def __init__(self, sources: Mapping[str, Source], clock: Timed) -> None:
        wrong = [name for name in sources if name not in KNOWN]
        missing = [name for name in REQUIRED if name not in sources]
        if wrong or missing:
            said = f"needs sources for {', '.join(REQUIRED)} and perhaps thermal, got {', '.join(sources) or 'none'}"
            raise DeviceError("OpenCV cameras", said, hint="Correct the cameras in the rig file.")
        self._clock = clock
        self._sources = dict(sources)
        self._open: dict[str, cv2.VideoCapture] = {}
        try:
            for name, source in self._sources.items():
                self._open[name] = _opened(name, source)
        except LinkError:
            self.close()
            raise

    @property
    def identity(self) -> Mapping[str, str]:
        """Source, backend and picture size of each camera."""
        return {name: self._described(name, camera) for name, camera in self._open.items()}

    def capture(self) -> FrameSet:
        """Expose all cameras as nearly together as OpenCV can (grab all, then decode). Raises LinkError, ProtocolError."""
        exposed_s: dict[str, float] = {}
        for name, camera in self._open.items():
            if not camera.grab():
                hint = "Is it still connected? A file or stream may have ended."
                raise LinkError(self._who(name), "gave no frame", asked="a frame", hint=hint)
            exposed_s[name] = self._clock.now()
        images = {name: self._decoded(name, camera) for name, camera in self._open.items()}
        return FrameSet(images["left"], images["right"], images.get("thermal"), None, exposed_s, self.identity)

    def close(self) -> None:
        """Let all cameras go; may be called again."""
        for camera in self._open.values():
            camera.release()
        self._open.clear()

    def _decoded(self, name: str, camera: cv2.VideoCapture) -> NDArray[np.uint8]:
        good, image = camera.retrieve()
        if not good or image is None:
            raise ProtocolError(self._who(name), "sent a frame that can't be decoded", asked="a frame", hint="Try another pixel format.")
        try:
            return grey8(np.asarray(image))
        except ValueError as fault:
            raise ProtocolError(self._who(name), str(fault), asked="a frame") from fault

    def _who(self, name: str) -> str:
        return f"{name} camera at {self._sources[name]}"

    def _described(self, name: str, camera: cv2.VideoCapture) -> str:
        width, height = (round(camera.get(prop)) for prop in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        return f"{self._sources[name]} ({camera.getBackendName()}, {width} x {height})"


def _opened(name: str, source: Source) -> cv2.VideoCapture:
    camera = cv2.VideoCapture(source)
    if not camera.isOpened():
        camera.release()
        hint = "Check its number, path or URL, and that no other program holds it."
        raise LinkError(f"{name} camera at {source}", "can't be opened", asked=f"cv2.VideoCapture({source!r})", hint=hint)
    return camera
