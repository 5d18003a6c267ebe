"""What every detector takes and gives: the seam between the bench and any detector, the thesis's among them.

Strategy: structural protocols and plain values, so that a frame set of any origin fits without an import from either side.
The module may not know the bench, the instruments, nor any one detector; a detector never sees the scene, the truth or the script.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.geometry import Array

Image = NDArray[Any]


class Frames(Protocol):
    """What a detector asks of a frame set.

    left, right: (rows, columns) grey, uint8 or uint16, of the sizes in the calibration. thermal: (rows, columns) as the camera delivers it
    (mirrored where the calibration says so), or None. thermal_k: (rows, columns) kelvin at sensor resolution, never mirrored, or None.
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
    """One teat end: where it is in the world (3,) mm, how sure (3, 3) mm^2 or None, and the pixels (2,) that it was seen at."""

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

    hidden: how many teats it believes are there but not seen. reason: why nothing was found, or what was left out; None when all went well.
    """

    teats: tuple[Teat, ...] = ()
    hidden: int = 0
    reason: str | None = None
    trace: tuple[Stage, ...] = ()

    def stage(self, name: str) -> Stage | None:
        """The stage of that name, or None where the detector didn't get that far."""
        return next((stage for stage in self.trace if stage.name == name), None)


class Detector(Protocol):
    """Anything that finds teat ends. `parameters` holds every setting that changes an answer: it goes into the configuration hash."""

    @property
    def name(self) -> str: ...
    @property
    def version(self) -> str: ...
    @property
    def parameters(self) -> Mapping[str, Any]: ...

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        """Teat ends in the world frame. A frame set that can't be used gives no teats and a reason, never an exception."""
        ...
