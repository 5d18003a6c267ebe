"""A camera, or several pictures of one device, of another package as the bench's own."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from instruments.camera.cameras import CAN_GIVE, Camera, CameraGroup, MakersCalibration, MakersLens
from instruments.camera.frame import FrameError, FrameFault, Ranging, RawFrame
from instruments.clock import Clock
from instruments.drivers.border import PluginBoundary
from instruments.drivers.entry_points import Plugin
from instruments.errors import DeviceError, LimitError

CAPTURE_S = 30.0  # a long exposure, and a slow link
MOST_VALUES = 200_000_000  # of a picture: no sensor has as many


class PluggedCamera:
    """As `instruments.camera.cameras.Camera`; whatever it raises but a lost link costs a frame."""

    def __init__(self, plugged: Plugin, name: str, clock: Clock) -> None:
        self.who, self._name = f"{name} camera {plugged.name}", name
        self._border: PluginBoundary[Camera] = PluginBoundary(plugged, self.who, clock)
        with self._border.opening():
            who = self._border.call("identity", lambda camera: str(camera.identity))
        self.identity = f"{who} ({plugged})"

    def prepare(self) -> None:
        self._border.call("prepare", lambda camera: camera.prepare())

    def begin(self) -> None:
        self._border.call("begin", lambda camera: camera.begin())

    def take(self) -> RawFrame:
        """The frame. Raises FrameError for none, LinkError where it is gone."""
        try:
            return self._border.call(
                "take", lambda camera: checked(self._border, camera.take()), CAPTURE_S
            )
        except DeviceError as error:  # an exception of its own: the next frame may come
            raise FrameError(FrameFault.DROPPED, self._name, self.who, error.what) from error

    def close(self) -> None:
        self._border.forget()


class PluggedGroup:
    """As `instruments.camera.cameras.CameraGroup`."""

    def __init__(self, plugged: Plugin, clock: Clock) -> None:
        self.who = f"cameras {plugged.name}"
        self._border: PluginBoundary[CameraGroup] = PluginBoundary(plugged, self.who, clock)
        with self._border.opening():
            given = self._border.call("parts", lambda group: tuple(map(str, group.parts)))
            if not given or not set(given) <= set(CAN_GIVE):
                what = f"its parts are {given}; a group gives some of {', '.join(CAN_GIVE)}"
                raise LimitError(self.who, what, hint=f"{plugged}.")
            who = self._border.call("identity", lambda group: str(group.identity))
        self.parts: tuple[str, ...] = given
        self.identity = f"{who} ({plugged})"

    def capture(self) -> Mapping[str, RawFrame]:
        """A frame of each part. Raises FrameError for one that is missing, LinkError."""
        try:
            return self._border.call("capture", self._captured, CAPTURE_S)
        except DeviceError as error:
            raise FrameError(FrameFault.DROPPED, self.parts[0], self.who, error.what) from error

    def _captured(self, group: CameraGroup) -> Mapping[str, RawFrame]:
        given = dict(group.capture())
        if lost := [part for part in self.parts if part not in given]:
            raise FrameError(FrameFault.DROPPED, lost[0], self.who, f"it gave no {lost[0]} frame")
        return {part: checked(self._border, given[part]) for part in self.parts}

    def makers_calibration(self) -> MakersCalibration | None:
        """What its maker states; None without such a method. Raises ProtocolError, LinkError."""
        return self._border.call("makers_calibration", self._stated)

    def _stated(self, group: CameraGroup) -> MakersCalibration | None:
        ask = getattr(group, "makers_calibration", None)
        given = ask() if ask else None
        if given is not None and not isinstance(given, MakersCalibration):
            raise self._border.broken("its maker's calibration is no MakersCalibration", given)
        if given is None:
            return None
        what: object = "lenses"
        try:
            lenses = {}
            for what, one in given.lenses.items():
                lenses[str(what)] = MakersLens(
                    (int(one.size_px[0]), int(one.size_px[1])),
                    np.asarray(one.matrix, dtype=np.float64),
                    tuple(map(float, one.distortion)),
                    np.asarray(one.R, dtype=np.float64),
                    tuple(map(float, one.T_mm)),
                )
            what = "sd"
            return MakersCalibration(lenses, {str(n): float(sd) for n, sd in given.sd.items()})
        except (TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
            raise self._border.broken(f"its maker's calibration: {what}: {error}", given) from error

    def close(self) -> None:
        self._border.forget()


def checked(
    border: PluginBoundary[Camera] | PluginBoundary[CameraGroup], frame: object
) -> RawFrame:
    """A frame that can be one. Raises ProtocolError."""
    if not isinstance(frame, RawFrame):
        raise border.broken("its frame is no RawFrame", frame)
    for one in [frame.pixels] if frame.amplitude is None else [frame.pixels, frame.amplitude]:
        if not isinstance(one, np.ndarray):
            raise border.broken("its frame's pixels are no array of NumPy", one)
        known = one.dtype in (np.uint8, np.uint16) or (frame.ranging and one.dtype.kind in "uif")
        if one.ndim not in (2, 3) or not 0 < one.size <= MOST_VALUES or not known:
            raise border.broken("its frame is no picture of 8 or 16 bits", (one.shape, one.dtype))
    if not isinstance(frame.ranging, Ranging | None) or frame.bits not in range(1, 33):
        raise border.broken("its frame has no such bits or ranging", (frame.bits, frame.ranging))
    border.number(frame.exposed_s, "exposed_s")
    return frame
