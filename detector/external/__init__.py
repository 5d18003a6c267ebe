"""Any program as a detector: a child process that gets and gives JSON lines (docs/detectors.md).

`lines` is the codec and does no I/O, `leash` holds a process and whatever it starts, `process`
talks to it under limits, `detector` makes a detector of it, and `serve` is the other end for
detectors in Python.
"""

from detector.external.detector import ExternalDetector, Limits

__all__ = ["ExternalDetector", "Limits"]
