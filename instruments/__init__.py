"""What has a wire, and the simulated world behind the wires. For drivers of other packages
(docs/drivers.md): what they promise, what they give, and what they raise.
"""

from textfiles.lazy import lazily

TYPE_CHECKING = False
if TYPE_CHECKING:
    from instruments.camera.frame import FrameError, FrameFault, Ranging, RawFrame
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
    from instruments.errors import (
        DeviceError,
        InstrumentError,
        LimitError,
        LinkError,
        ProtocolError,
    )
    from instruments.link import Link

_PROMISED = {
    "instruments.camera.frame": ("FrameError", "FrameFault", "Ranging", "RawFrame"),
    "instruments.clock": ("Clock", "RealClock", "VirtualClock"),
    "instruments.drivers.plugin": (
        *("ArmDriver", "ArmPoint", "BathDriver", "BathState", "Camera", "CameraGroup"),
        *("MakersCalibration", "MakersLens", "StageDriver", "StageState"),
    ),
    "instruments.errors": (
        *("DeviceError", "InstrumentError", "LimitError", "LinkError", "ProtocolError"),
    ),
    "instruments.link": ("Link",),
}
__all__ = [
    "ArmDriver", "ArmPoint", "BathDriver", "BathState", "Camera", "CameraGroup", "Clock",
    "DeviceError", "FrameError", "FrameFault", "InstrumentError", "LimitError", "Link", "LinkError",
    "MakersCalibration", "MakersLens", "ProtocolError", "Ranging", "RawFrame", "RealClock",
    "StageDriver", "StageState", "VirtualClock",
]  # fmt: skip
__getattr__ = lazily(__name__, _PROMISED)
