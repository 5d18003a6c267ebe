"""What a driver of another package promises: one Protocol for each kind of instrument.

An entry point gives a class, or a function, that is called with the bench's clock and the keys of
the rig file's ``plugin:NAME?key=value``, all text. docs/drivers.md says what holds for all kinds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from instruments.camera.cameras import Camera, CameraGroup, MakersCalibration, MakersLens

Floats = NDArray[np.float64]
__all__ = [
    "ArmDriver", "ArmPoint", "BathDriver", "BathState", "Camera", "CameraGroup",
    "MakersCalibration", "MakersLens", "StageDriver", "StageState",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class BathState:
    """What a bath shows now. ``running``: whether it may heat, by its own word, read from the
    device; ``alarm``: in words, empty for none.
    """

    temp_c: float
    running: bool
    set_point_c: float
    external_c: float | None = None
    power_percent: float | None = None
    alarm: str = ""


class BathDriver(Protocol):
    """A water bath. Known of the class, before it is opened: ``range_c``, the set points that it
    takes; ``step_k``, of its temperature; ``pump``: whether one turns with the heater;
    ``comms_loss``: what it does when no messages come.
    """

    range_c: tuple[float, float]
    step_k: float
    pump: Literal["none", "with run"]
    comms_loss: Literal["hold", "stop", "unknown"]

    @property
    def identity(self) -> Mapping[str, str]: ...
    def read(self) -> BathState: ...
    def start(self, set_point_c: float) -> None: ...
    def standby(self) -> None: ...
    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class StageState:
    """What a stage shows: ``place`` by axis letter, mm, degrees for A; ``fault``, or empty."""

    place: Mapping[str, float]
    moving: bool
    homed: bool
    fault: str = ""


class StageDriver(Protocol):
    """A motion stage with the axes "XY", "XYZ", "XYA" or "XYZA". `limits`: lowest and highest place
    by axis; ``feed_mm_min``: the fastest. `home` and `move` begin a motion, and may wait for its
    end.
    """

    axes: str
    feed_mm_min: float

    @property
    def identity(self) -> Mapping[str, str]: ...
    @property
    def limits(self) -> Mapping[str, tuple[float, float]]: ...
    def read(self) -> StageState: ...
    def home(self) -> None: ...
    def move(self, place: Mapping[str, float], feed_mm_min: float) -> None: ...
    def stop(self) -> None: ...
    def close(self) -> None: ...


@dataclass(frozen=True, slots=True, eq=False)
class ArmPoint:
    """Where the tip is now, (3,) mm in the arm's frame; ``axis`` (3,) up the stylus, if known."""

    tip_mm: Floats
    axis: Floats | None = None
    moving: bool = False


class ArmDriver(Protocol):
    """A measuring arm. ``homing``: what a person does before its points hold; ``touches``: it goes
    to a point by itself, by `touch`, which may wait for the end of its way. `identity` has a
    ``serial_number``.
    """

    homing: str
    touches: bool

    @property
    def identity(self) -> Mapping[str, str]: ...
    def read(self) -> ArmPoint: ...
    def touch(self, point_mm: Floats, axis: Floats) -> None: ...
    def stop(self) -> None: ...
    def close(self) -> None: ...
