"""Faults of a frame by name, as in rig files and reports, and the error that carries one."""

from __future__ import annotations

from enum import StrEnum

from instruments.errors import ProtocolError


class FrameFault(StrEnum):
    """A frame, or a set of them, that must not be measured with."""

    DROPPED = "dropped"  # no frame came
    LOST_PACKETS = "lost packets"  # a frame came with holes, and said so
    LATE = "late"  # exposed too long after the others of its set
    WRONG_SIZE = "wrong size"  # another picture size than the calibration's
    FROZEN = "frozen"  # the last frame once more, to the last bit
    BLACK = "black"
    SATURATED = "saturated"
    HALF = "half a frame"  # rows at an edge are missing, or still the last frame's
    FLAT_FIELD = "flat-field event"  # the thermal camera looks at its own shutter
    OUT_OF_FOCUS = "out of focus"
    SWAPPED = "swapped"  # left and right have changed places


class FrameError(ProtocolError):
    """A frame did not come whole. Worth another try, unlike a lost link (`LinkError`)."""

    def __init__(
        self,
        fault: FrameFault,
        camera: str,
        who: str,
        what: str,
        *,
        seconds: float | None = None,
        hint: str | None = None,
    ) -> None:
        self.fault = fault
        self.camera = camera
        super().__init__(who, what, asked="a frame", seconds=seconds, hint=hint)
