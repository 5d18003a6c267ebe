"""A camera, or several pictures of one device, of another package as the bench's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instruments.camera.cameras import CAN_GIVE, Camera, CameraGroup, MakersCalibration, MakersLens
from instruments.camera.frame import FrameError, FrameFault, RawFrame, no_picture
from instruments.clock import Clock
from instruments.drivers.border import Plugged, PluginBoundary
from instruments.drivers.entry_points import Plugin, one_line
from instruments.errors import DeviceError, LimitError

CAPTURE_S = 30.0  # a long exposure, and a slow link
OFF_S = 2.0  # of its clock, at the most


class PluggedCamera(Plugged):
    """As `instruments.camera.cameras.Camera`; whatever it raises but a lost link costs a frame."""

    def __init__(self, plugged: Plugin, name: str, clock: Clock) -> None:
        self.who, self._name = f"{name} camera {plugged.name}", name
        self._border: PluginBoundary[Camera] = PluginBoundary(plugged, self.who, clock)
        with self._border.opening():
            who = self._border.call("identity", lambda camera: one_line(str(camera.identity)))
        self.identity, self._asked_s = f"{who} ({plugged})", clock.now()

    def prepare(self) -> None:
        self._border.call("prepare", lambda camera: camera.prepare())

    def begin(self) -> None:
        self._asked_s = self._border.clock.now()
        self._border.call("begin", lambda camera: camera.begin())

    def take(self) -> RawFrame:
        """The frame. Raises FrameError for none, LinkError where it is gone."""
        try:
            return self._border.call("take", self._taken, CAPTURE_S)
        except DeviceError as error:  # an exception of its own: the next frame may come
            raise _dropped(self._name, error) from error

    def _taken(self, camera: Camera) -> RawFrame:
        return checked(self._border, self._name, camera.take(), self._asked_s)


class PluggedGroup(Plugged):
    """As `instruments.camera.cameras.CameraGroup`."""

    def __init__(self, plugged: Plugin, clock: Clock) -> None:
        self.who = f"cameras {plugged.name}"
        self._border: PluginBoundary[CameraGroup] = PluginBoundary(plugged, self.who, clock)
        with self._border.opening():
            given = self._border.call("parts", lambda group: tuple(map(str, group.parts)))
            if not given or not set(given) <= set(CAN_GIVE):
                what = f"its parts are {given}; a group gives some of {', '.join(CAN_GIVE)}"
                raise LimitError(self.who, what, hint=f"Correct {plugged}.")
            who = self._border.call("identity", lambda group: one_line(str(group.identity)))
        self.parts: tuple[str, ...] = given
        self.identity = f"{who} ({plugged})"

    def capture(self) -> Mapping[str, RawFrame]:
        """A frame of each part. Raises FrameError for one that is missing, LinkError."""
        try:
            return self._border.call("capture", self._captured, CAPTURE_S)
        except DeviceError as error:
            raise _dropped(self.parts[0], error) from error

    def _captured(self, group: CameraGroup) -> Mapping[str, RawFrame]:
        asked_s = self._border.clock.now()
        if not isinstance(given := group.capture(), Mapping):
            raise self._border.broken("its capture is no mapping of parts to frames", given)
        if lost := [part for part in self.parts if part not in given]:
            what, hint = f"it gave no {lost[0]} frame", self._border.look.removesuffix(".")
            raise FrameError(FrameFault.DROPPED, lost[0], self.who, what, hint=hint)
        return {part: checked(self._border, part, given[part], asked_s) for part in self.parts}

    def makers_calibration(self) -> MakersCalibration | None:
        """What its maker states; None without such a method. Raises ProtocolError, LinkError."""
        return self._border.call("makers_calibration", self._stated)

    def _stated(self, group: CameraGroup) -> MakersCalibration | None:
        given = getattr(group, "makers_calibration", lambda: None)()
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


def _dropped(name: str, error: DeviceError) -> FrameError:
    """No frame of the camera ``name``: the next one may come."""
    hint = (error.hint or "").removesuffix(".") or None
    return FrameError(FrameFault.DROPPED, name, error.who, error.what, hint=hint)


def checked(border: PluginBoundary[Any], name: str, frame: object, asked_s: float) -> RawFrame:
    """A frame that can be one of the camera ``name``. Raises ProtocolError; FrameError for one that
    was exposed before it was asked for, or is yet to be.
    """
    if not isinstance(frame, RawFrame):
        raise border.broken(f"its {name} frame is no RawFrame", frame)
    for what, seen in no_picture(frame):
        raise border.broken(f"its {name} frame {what}", seen)
    exposed_s, now_s = border.number(frame.exposed_s, "exposed_s"), border.clock.now()
    if not asked_s - OFF_S < exposed_s < now_s + OFF_S:
        what = f"exposed at {exposed_s:.3f} s of the bench's clock, asked for at {asked_s:.3f} s"
        raise FrameError(FrameFault.LATE, name, border.who, what, hint=f"Correct {border.plugged}")
    amplitude = None if frame.amplitude is None else _own(frame.amplitude)
    kept = (_own(frame.pixels), exposed_s, int(frame.bits), frame.ranging)
    return RawFrame(*kept, amplitude, int(frame.passed_over))


def _own(pixels: NDArray[Any]) -> NDArray[Any]:
    """A copy, as the driver may fill its buffer again; in this machine's order of bytes."""
    return np.array(pixels, dtype=pixels.dtype.newbyteorder("="))
