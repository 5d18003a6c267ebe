"""Pixels to millimetres: calibration, geometry, teat detectors. numpy, OpenCV, scipy and numba
only. For detectors of other packages: what they take and give.
"""

from textfiles.lazy import lazily

__getattr__, __dir__ = lazily(__name__)
