# What a name of this package is, for type checkers: `PLACES` in __init__.py says it to Python.
from instruments.bath.reading import BathReading
from instruments.camera.frame import FrameError, FrameFault, Ranging, RawFrame
from instruments.captures.capture import CaptureError, CaptureFile
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.drivers.plugin import (
    ArmDriver,
    ArmPoint,
    BathDriver,
    BathState,
    Camera,
    CameraGroup,
    MakersCalibration,
    MakersLens,
    StageDriver,
    StageState,
)
from instruments.drivers.protocols import Arm, Bath, Cameras, Stage
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.link import Link

__all__ = [
    "Arm",
    "ArmDriver",
    "ArmPoint",
    "Bath",
    "BathDriver",
    "BathReading",
    "BathState",
    "Camera",
    "CameraGroup",
    "Cameras",
    "CaptureError",
    "CaptureFile",
    "Clock",
    "DeviceError",
    "FrameError",
    "FrameFault",
    "InstrumentError",
    "LimitError",
    "Link",
    "LinkError",
    "MakersCalibration",
    "MakersLens",
    "ProtocolError",
    "Ranging",
    "RawFrame",
    "RealClock",
    "Stage",
    "StageDriver",
    "StageState",
    "VirtualClock",
]
