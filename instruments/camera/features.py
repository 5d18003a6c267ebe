"""A GenICam camera's features by name: asked for, read back, and explained where a camera has no such feature.

May not know frames.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from typing import Any

from instruments.camera.settings import ReadBack, Settings, Value
from instruments.errors import DeviceError


def set_all(who: str, camera: Any, settings: Settings, failure: type[Exception]) -> tuple[str, ...]:
    """Ask for each setting, then read each back; gives notes about tries. ``failure`` is what the library raises.

    Raises DeviceError for what did not take.
    """
    back = ReadBack(who, settings.tries)
    asked: list[tuple[str, Value | tuple[int, int], Callable[[], object], Callable[[], object]]] = []
    if settings.pixel_format is not None:
        name = settings.pixel_format
        asked.append(("pixel_format", name, lambda: camera.set_pixel_format_from_string(name), camera.get_pixel_format_as_string))
    if settings.resolution is not None:
        width, height = settings.resolution
        asked.append(("resolution", (width, height), lambda: camera.set_region(0, 0, width, height), lambda: _size(camera)))
    if settings.fps is not None:
        fps = settings.fps
        asked.append(("fps", fps, lambda: camera.set_frame_rate(fps), camera.get_frame_rate))
    if settings.exposure is not None:
        exposure_us = settings.exposure
        asked.append(("exposure", exposure_us, lambda: _manual_exposure(camera, exposure_us), camera.get_exposure_time))
    if settings.gain is not None:
        gain = settings.gain
        asked.append(("gain", gain, lambda: camera.set_gain(gain), camera.get_gain))
    for feature, value in settings.features.items():
        asked.append((feature, value, *_by_name(who, camera.get_device(), feature, value)))
    _ask(asked, back, failure)
    return back.finish()


def _ask(
    asked: list[tuple[str, Value | tuple[int, int], Callable[[], object], Callable[[], object]]], back: ReadBack, failure: type[Exception]
) -> None:
    taken = []
    for name, value, write, read in asked:
        try:
            write()
            taken.append((name, value, read))
        except (failure, DeviceError) as error:
            back.refused(name, f"{name} was refused: {error.what if isinstance(error, DeviceError) else _told(error)}")
    for name, value, read in taken:  # all set before any is read: one may change another
        try:
            back.compare(name, value, read())
        except failure as error:
            back.refused(name, f"{name} can't be read back: {_told(error)}")


def _manual_exposure(camera: Any, exposure_us: float) -> None:
    if camera.is_exposure_auto_available():
        camera.set_exposure_time_auto(0)
    camera.set_exposure_time(exposure_us)


def _size(camera: Any) -> tuple[int, int]:
    region = camera.get_region()
    return int(region.width), int(region.height)


def _by_name(who: str, device: Any, name: str, value: Value) -> tuple[Callable[[], object], Callable[[], object]]:
    """How a feature is written and read, whatever its kind; both raise DeviceError where the camera has none of that name."""

    def node() -> Any:
        found = device.get_feature(name)
        if found is None or not hasattr(found, "set_value_from_string"):
            near = difflib.get_close_matches(name, list(feature_names(device)), n=1, cutoff=0.8)
            raise DeviceError(who, f'the camera has no feature "{name}"' + (f'; did you mean "{near[0]}"?' if near else ""))
        return found

    def write() -> None:
        node().set_value_from_string(("true" if value else "false") if isinstance(value, bool) else str(value))

    return write, lambda: node().get_value_as_string()


def feature_names(device: Any) -> list[str]:
    """All features that a camera lists, by its categories."""
    names: list[str] = []
    open_, seen = ["Root"], set()
    while open_:
        name = open_.pop()
        found = device.get_feature(name)
        if found is None or name in seen:
            continue
        seen.add(name)
        if hasattr(found, "get_features"):
            open_ += list(found.get_features())
        else:
            names.append(name)
    return sorted(names)


def _told(error: Exception) -> str:
    return str(getattr(error, "message", error))
