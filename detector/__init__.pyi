# The names of this package, once: type checkers read them here, and so does textfiles/lazy.py.
from detector.calibration import Calibration as Calibration
from detector.calibration import Part as Part
from detector.calibration import Record as Record
from detector.protocol import Context as Context
from detector.protocol import Detection as Detection
from detector.protocol import Detector as Detector
from detector.protocol import Frames as Frames
from detector.protocol import Outcome as Outcome
from detector.protocol import Stage as Stage
from detector.protocol import Teat as Teat
