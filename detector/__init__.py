"""Pixels to millimetres: calibration, geometry, teat detectors. numpy, OpenCV, scipy and numba
only. For detectors of other packages: what they take and give.
"""

from textfiles.lazy import lazily

# by the module that has them; type checkers read __init__.pyi
PLACES = {
    "detector.calibration": ("Calibration", "Part", "Record"),
    "detector.protocol": ("Context", "Detection", "Detector", "Frames", "Outcome", "Stage", "Teat"),
}  # fmt: skip
__all__ = [name for names in PLACES.values() for name in names]
__getattr__ = lazily(__name__, PLACES)
