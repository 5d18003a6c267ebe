"""Left, right and perhaps thermal and depth camera as one: all begin, then each is taken and
converted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from instruments.camera.closing import close_within
from instruments.camera.frame import Conversion, FrameSet, RawFrame
from instruments.errors import InstrumentError, LimitError, ProtocolError

REQUIRED = ("left", "right")
KNOWN = (*REQUIRED, "thermal")  # those whose pictures are for people too
DEPTH = "depth"
CAN_GIVE = (*KNOWN, DEPTH)


class Camera(Protocol):
    """One camera with its settings made. ``prepare`` waits for what it needs; ``begin`` triggers,
    or asks for a fresh frame; ``take`` waits for it. They raise FrameError, or LinkError when the
    camera is gone. One that notices this without a frame may have ``glance()``, which raises it.
    """

    identity: str

    def prepare(self) -> None: ...
    def begin(self) -> None: ...
    def take(self) -> RawFrame: ...
    def close(self) -> None: ...


@dataclass(frozen=True, slots=True, eq=False)
class MakersLens:
    """One part's lens and place: ``size_px`` (columns, rows) of its pictures, camera ``matrix``
    (3, 3), ``distortion`` k1 k2 p1 p2 k3, 0 for rectified pictures. X_part = R X_left + T, mm.
    """

    size_px: tuple[int, int]
    matrix: NDArray[np.float64]
    distortion: Sequence[float] = (0.0,) * 5
    R: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    T_mm: Sequence[float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class MakersCalibration:
    """What the maker states of a group, by part: left, right, depth. ``sd``: his standard
    deviations by the names of a calibration file ("left fx": px, "stereo T1": mm), none for none.
    """

    lenses: Mapping[str, MakersLens]
    sd: Mapping[str, float] = field(default_factory=dict)


class CameraGroup(Protocol):
    """One device with several pictures at one time: ``parts`` of left, right, thermal, depth.
    `capture` exposes them all; it raises as `Camera` does. A group may also have
    ``makers_calibration() -> MakersCalibration``, for `teatbench calibrate import --rig`.
    """

    identity: str
    parts: tuple[str, ...]

    def capture(self) -> Mapping[str, RawFrame]: ...
    def close(self) -> None: ...


class CameraSet:
    """The cameras of a rig. Where one opener fails, the cameras that are open are closed again.
    ``group``: opens one device that gives several of them.
    """

    def __init__(
        self,
        openers: Mapping[str, Callable[[], Camera]],
        conversions: Mapping[str, Conversion],
        group: Callable[[], CameraGroup] | None = None,
    ) -> None:
        self._openers, self._open_group = dict(openers), group
        self._given = dict(conversions)
        self._cameras: dict[str, Camera] = {}
        self._group: CameraGroup | None = None
        if not group:
            self._check(tuple(openers))
        self._open()

    @property
    def identity(self) -> Mapping[str, str]:
        """Who each camera is."""
        group = dict.fromkeys(self._group.parts, self._group.identity) if self._group else {}
        return group | {name: camera.identity for name, camera in self._cameras.items()}

    def makers_calibration(self) -> MakersCalibration | None:
        """What the maker of the group states of it; None where he states nothing."""
        ask = getattr(self._group, "makers_calibration", None)
        found: MakersCalibration | None = ask() if ask else None
        return found

    def reopen(self) -> None:
        """Close all cameras and open them again with their settings. Raises as their openers."""
        self.close()
        self._open()

    def glance(self) -> None:
        """Raises LinkError where a camera has noticed that it is gone; asks for no frame."""
        for camera in (*self._cameras.values(), self._group):
            getattr(camera, "glance", lambda: None)()

    def capture(self) -> FrameSet:
        """Expose all cameras together. Raises FrameError, LinkError, ProtocolError."""
        for camera in self._cameras.values():
            camera.prepare()
        for camera in self._cameras.values():
            camera.begin()
        raw = dict(self._group.capture()) if self._group else {}
        raw |= {name: camera.take() for name, camera in self._cameras.items()}
        images: dict[str, Any] = {}
        try:
            for name, frame in raw.items():
                conversion = self._given.get(name) or Conversion()
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
        group, self._group = self._group, None
        closers = [camera.close for camera in cameras.values()]
        close_within([*closers, group.close] if group else closers)

    @staticmethod
    def _check(names: Sequence[str]) -> None:
        wrong = [name for name in names if name not in CAN_GIVE]
        missing = [name for name in REQUIRED if name not in names]
        if wrong or missing or len(set(names)) < len(names):
            got = ", ".join(names) or "none"
            raise ValueError(f"a rig has cameras left, right, perhaps thermal and depth, got {got}")

    def _open(self) -> None:
        try:
            if self._open_group:
                self._group = self._open_group()
                self._check((*self._group.parts, *self._openers))
            for name, opener in self._openers.items():
                self._cameras[name] = opener()
        except (InstrumentError, ValueError) as error:
            self.close()
            if isinstance(error, ValueError):
                hint = "Name the other cameras in the rig file."
                raise LimitError("cameras", str(error), hint=hint) from error
            raise
