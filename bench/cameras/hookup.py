"""Opens the cameras that a rig file names: all by one URL, or each by its table, set and read back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bench.cameras.tables import Cameras as Tables
from bench.cameras.tables import OneCamera, ThermalTable
from bench.devices import Cameras
from detector.calibration import Calibration
from instruments.camera.cameras import KNOWN, Camera, CameraSet
from instruments.camera.conversion import Conversion
from instruments.camera.genicam import GenicamCamera
from instruments.camera.opencv import OpenCvCamera
from instruments.camera.recording import Recording, RecordingCameras
from instruments.clock import Clock
from instruments.errors import DeviceError


def open_cameras(tables: Tables, calibration: Calibration | None, folder: Path, clock: Clock) -> Cameras:
    """The cameras of a rig file in ``folder``; paths are taken from there. Raises InstrumentError, RecordingError."""
    kind, _, rest = tables.url.partition(":")
    if kind == "recording":
        return RecordingCameras(Recording(folder / rest))
    if kind == "opencv":
        openers = _one_line(rest, folder, clock)
        return CameraSet(openers, {})
    conversions = {name: conversion_of(table, calibration) for name, table in tables.tables.items()}
    return CameraSet({name: opener_of(name, table, folder, clock) for name, table in tables.tables.items()}, conversions)


def conversion_of(table: OneCamera, calibration: Calibration | None) -> Conversion:
    """What becomes of a camera's frames so that they are as the calibration has them; as delivered without one."""
    if not isinstance(table, ThermalTable):
        return table.conversion()
    if calibration is None:
        return table.calibrated(mirrored=bool(table.mirrored), hot_is_black=table.polarity == "hot_is_black")
    thermal = calibration.thermal
    return table.calibrated(mirrored=thermal.mirrored, hot_is_black=thermal.polarity == "hot_is_black")


def opener_of(name: str, table: OneCamera, folder: Path, clock: Clock) -> Callable[[], Camera]:
    """What opens one camera."""
    kind, _, rest = table.url.partition(":")
    if kind == "genicam":
        return lambda: GenicamCamera(name, rest, clock, table.settings)
    return lambda: OpenCvCamera(name, _source(rest, folder), clock, table.settings)


def _one_line(rest: str, folder: Path, clock: Clock) -> dict[str, Callable[[], Camera]]:
    sources = rest.split(",")
    if not 2 <= len(sources) <= len(KNOWN):
        hint = "Correct the cameras in the rig file."
        raise DeviceError("OpenCV cameras", f"needs two or three sources for left, right and thermal, got {rest!r}", hint=hint)

    def opener(name: str, source: str) -> Callable[[], Camera]:
        return lambda: OpenCvCamera(name, _source(source, folder), clock)

    return {name: opener(name, source) for name, source in zip(KNOWN, sources, strict=False)}


def _source(text: str, folder: Path) -> int | str:
    """A device's number, or a URL, or a path; a file that stands beside the rig file is taken from there."""
    if text.isdecimal():
        return int(text)
    beside = folder / text
    return str(beside) if "://" not in text and beside.is_file() else text
