"""What every detector takes and gives: the seam between the bench and any detector, the thesis's
among them.

Strategy: structural protocols and plain values, so that a frame set of any origin fits without an
import from either side. The module may not know the bench, the instruments, nor any one detector; a
detector never sees the scene, the truth or the script.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol, runtime_checkable

from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.geometry import Array

Image = NDArray[Any]


class Frames(Protocol):
    """What a detector asks of a frame set.

    left, right: (rows, columns) grey, uint8 or uint16, of the sizes in the calibration. thermal:
    (rows, columns) as the camera delivers it (mirrored where the calibration says so), or None.
    thermal_k: (rows, columns) kelvin at sensor resolution, never mirrored, or None.
    """

    @property
    def left(self) -> Image: ...
    @property
    def right(self) -> Image: ...
    @property
    def thermal(self) -> Image | None: ...
    @property
    def thermal_k(self) -> Image | None: ...


@dataclass(frozen=True, slots=True, eq=False)
class Teat:
    """One teat end: where it is in the world (3,) mm, how sure (3, 3) mm^2 or None, and the pixels
    (2,) that it was seen at.
    """

    world_mm: Array
    covariance_mm2: Array | None = None
    left_px: Array | None = None
    right_px: Array | None = None
    thermal_px: Array | None = None  # in the un-mirrored picture


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """One step of a detector as the report may show it: a name and what the step gave, by name."""

    name: str
    data: Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A detector's answer on one frame set.

    hidden: how many teats it believes are there but not seen. reason: why nothing was found, or
    what was left out; None when all went well.
    """

    teats: tuple[Teat, ...] = ()
    hidden: int = 0
    reason: str | None = None
    trace: tuple[Stage, ...] = ()

    def stage(self, name: str) -> Stage | None:
        """The stage of that name, or None where the detector didn't get that far."""
        return next((stage for stage in self.trace if stage.name == name), None)


class Detector(Protocol):
    """Anything that finds teat ends. `parameters` holds every setting that changes an answer: it
    goes into the configuration hash.
    """

    @property
    def name(self) -> str: ...
    @property
    def version(self) -> str: ...
    @property
    def parameters(self) -> Mapping[str, Any]: ...

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        """Teat ends in the world frame. A frame set that can't be used gives no teats and a reason,
        never an exception.
        """
        ...


class Outcome(Enum):
    """What became of one call of a detector: each is scored as what it is."""

    ANSWERED = "answered"
    TIMEOUT = "timeout"
    FAILED = "failure"
    OFF = "switched off"


class DetectionFailure(Exception):  # noqa: N818 - a failure of the detector, not of the bench
    """A detector gave no answer that can be used; the message is one sentence. Raised where the
    outcome isn't a plain failure too.
    """

    def __init__(self, reason: str, outcome: Outcome = Outcome.FAILED) -> None:
        super().__init__(reason)
        self.outcome = outcome


@runtime_checkable
class Served(Protocol):
    """A detector that lives outside of the bench's process: beside `Detector`, what has to happen
    around a call.

    patience_s: how long `prepare` and `detect` may take together before they end by themselves.
    start_up_s: how long the process took that the last `prepare` started, None where it ran
    already.
    """

    @property
    def patience_s(self) -> float: ...
    @property
    def start_up_s(self) -> float | None: ...

    def prepare(self, frames: Frames, calibration: Calibration) -> None:
        """All that isn't detection: a process started, pictures written where it can read them.
        Raises DetectionFailure.
        """
        ...

    def check(self) -> None:
        """Whether it keeps its limits between calls, after an answer and outside of its time.
        Raises DetectionFailure.
        """
        ...

    def said(self) -> str:
        """What it wrote to its standard error since this was last asked, the end of it where that
        is long.
        """
        ...

    def close(self) -> None:
        """End its processes and remove its files. Once more is no error."""
        ...
