# What a name of this package is, for type checkers: `PLACES` in __init__.py says it to Python.
from detector.calibration import Calibration, Part, Record
from detector.protocol import Context, Detection, Detector, Frames, Outcome, Stage, Teat

__all__ = [
    "Calibration",
    "Context",
    "Detection",
    "Detector",
    "Frames",
    "Outcome",
    "Part",
    "Record",
    "Stage",
    "Teat",
]
