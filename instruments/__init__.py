"""What has a wire, and the simulated world behind the wires. For drivers of other packages
(docs/drivers.md): what they promise, what they give, and what they raise.
"""

from textfiles.lazy import lazily

# by the module that has them; type checkers read __init__.pyi
PLACES = {
    "instruments.bath.reading": ("BathReading",),
    "instruments.camera.frame": ("FrameError", "FrameFault", "Ranging", "RawFrame"),
    "instruments.captures.capture": ("CaptureError", "CaptureFile"),
    "instruments.clock": ("Clock", "RealClock", "VirtualClock"),
    "instruments.drivers.plugin": (
        "ArmDriver", "ArmPoint", "BathDriver", "BathState", "Camera", "CameraGroup",
        "MakersCalibration", "MakersLens", "StageDriver", "StageState",
    ),
    "instruments.drivers.protocols": ("Arm", "Bath", "Cameras", "Stage"),
    "instruments.errors": (
        "DeviceError", "InstrumentError", "LimitError", "LinkError", "ProtocolError",
    ),
    "instruments.link": ("Link",),
}  # fmt: skip
__all__ = [name for names in PLACES.values() for name in names]
__getattr__ = lazily(__name__, PLACES)
