"""Pixels to millimetres: calibration, geometry, teat detectors. numpy, OpenCV, scipy and numba
only. For detectors of other packages: what they take and give.
"""

from textfiles.lazy import lazily

TYPE_CHECKING = False
if TYPE_CHECKING:
    from detector.calibration import Calibration, Part, Record
    from detector.protocol import Context, Detection, Detector, Frames, Outcome, Stage, Teat

__all__ = [
    "Calibration", "Context", "Detection", "Detector", "Frames", "Outcome", "Part", "Record",
    "Stage", "Teat",
]  # fmt: skip
__getattr__ = lazily(__name__, __file__)
