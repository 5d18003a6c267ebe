"""Any program as a detector: a child process for JSON lines (docs/first-detector.md).

`lines`: the codec; `process`: the child under limits, which `process_supervisor` ends with the
bench; `detector`: the detector made of it; `serve`: the other end in Python.
"""

from detector.external.detector import ExternalDetector, ProcessLimits

__all__ = ["ExternalDetector", "ProcessLimits"]
