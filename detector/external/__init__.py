"""Any program as a detector: a child process for JSON lines (docs/first-detector.md).

`lines`: codec; `process`: the child under limits, held by `process_supervisor`; `detector`: a
detector of it; `serve`: the other end in Python.
"""

from detector.external.detector import ExternalDetector, ProcessLimits

__all__ = ["ExternalDetector", "ProcessLimits"]
