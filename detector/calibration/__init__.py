"""Cameras, stereo, thermal and world: what they are, where they lie, and the file that says so."""

from detector.calibration.file import (
    CalibrationError,
    KeyFault,
    check_text,
    dump_calibration,
    file_hash,
    load_calibration,
    load_part,
)
from detector.calibration.homographies import (
    DEFAULT_PLANE_DEPTH_MM,
    derive_homographies,
    plane_homography,
)
from detector.calibration.values import (
    Calibration,
    Homographies,
    ParameterCovariance,
    Part,
    Polarity,
    Record,
    ThermalCamera,
)

__all__ = [
    "DEFAULT_PLANE_DEPTH_MM",
    "Calibration",
    "CalibrationError",
    "Homographies",
    "KeyFault",
    "ParameterCovariance",
    "Part",
    "Polarity",
    "Record",
    "ThermalCamera",
    "check_text",
    "derive_homographies",
    "dump_calibration",
    "file_hash",
    "load_calibration",
    "load_part",
    "plane_homography",
]
