"""Left, right and perhaps thermal and depth camera as one: all begin, then each is taken and
converted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from instruments.camera.closing import close_within
from instruments.camera.frame import Conversion, FrameSet, RawFrame
from instruments.errors import InstrumentError, ProtocolError

REQUIRED = ("left", "right")
KNOWN = (*REQUIRED, "thermal")  # those whose pictures are for people too
DEPTH = "depth"


class Camera(Protocol):
    """One camera with its settings made. ``prepare`` waits for what it needs; ``begin`` triggers,
    or asks for a fresh frame; ``take`` waits for it. They raise FrameError, or LinkError when the
    camera is gone.
    """

    identity: str

    def prepare(self) -> None: ...
    def begin(self) -> None: ...
    def take(self) -> RawFrame: ...
    def close(self) -> None: ...


class CameraSet:
    """The cameras of a rig. Where one opener fails, the cameras that are open are closed again."""

    def __init__(
        self, openers: Mapping[str, Callable[[], Camera]], conversions: Mapping[str, Conversion]
    ) -> None:
        wrong = [name for name in openers if name not in (*KNOWN, DEPTH)]
        missing = [name for name in REQUIRED if name not in openers]
        if wrong or missing:
            got = ", ".join(openers) or "none"
            raise ValueError(f"a rig has cameras left, right, perhaps thermal and depth, got {got}")
        self._openers = dict(openers)
        self._conversions = {name: conversions.get(name, Conversion()) for name in openers}
        self._cameras: dict[str, Camera] = {}
        self._open()

    @property
    def identity(self) -> Mapping[str, str]:
        """Who each camera is."""
        return {name: camera.identity for name, camera in self._cameras.items()}

    def reopen(self) -> None:
        """Close all cameras and open them again with their settings. Raises as their openers."""
        self.close()
        self._open()

    def capture(self) -> FrameSet:
        """Expose all cameras together. Raises FrameError, LinkError, ProtocolError."""
        for camera in self._cameras.values():
            camera.prepare()
        for camera in self._cameras.values():
            camera.begin()
        raw = {name: camera.take() for name, camera in self._cameras.items()}
        images: dict[str, Any] = {}
        try:
            for name, frame in raw.items():
                conversion = self._conversions[name]
                if name == "thermal" and conversion.radiometry is not None:
                    images["thermal_ck"] = conversion.temperatures(frame)
                elif name == DEPTH:
                    images["depth_dmm"], images["amplitude"] = conversion.depth(frame)
                else:
                    images[name] = conversion.picture(frame)
        except ValueError as fault:
            hint = "Correct what the rig file declares of the cameras."
            raise ProtocolError("cameras", str(fault), asked="a frame", hint=hint) from fault
        exposed_s = {name: frame.exposed_s for name, frame in raw.items()}
        images["passed_over"] = {
            name: one.passed_over for name, one in raw.items() if one.passed_over
        }
        return FrameSet(**images, exposed_s=exposed_s, identity=self.identity)

    def close(self) -> None:
        """Let all cameras go, side by side, in 2 s at most; may be called again."""
        cameras, self._cameras = self._cameras, {}
        close_within([camera.close for camera in cameras.values()])

    def _open(self) -> None:
        try:
            for name, opener in self._openers.items():
                self._cameras[name] = opener()
        except InstrumentError:
            self.close()
            raise
