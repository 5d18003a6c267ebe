"""What is varied, and what was measured at one of its values. Values only; may not know how scenes are made or detectors asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from detector.calibration import Calibration
from instruments.world.microbolometer import ThermalSensor
from instruments.world.scene import Renderer
from instruments.world.sensor import OpticalSensor
from instruments.world.situations import Situation

SetUp = Callable[[float, int, Renderer], Situation]


@dataclass(frozen=True, slots=True)
class Optics:
    """The sensors behind the emulated lenses."""

    optical: OpticalSensor
    thermal: ThermalSensor


def same_optics(_value: float, usual: Optics) -> Optics:
    """The rig's own."""
    return usual


def true_calibration(_value: float, _seed: int, calibration: Calibration) -> Calibration:
    """The calibration that the scene is drawn by."""
    return calibration


@dataclass(frozen=True, slots=True)
class Quantity:
    """One quantity: its ``name`` as a file's, ``label`` with its unit, the ``values`` it takes, ``about`` in one sentence.

    ``set_up`` gives the scene of a value and a member's seed, ``optics`` the sensors, ``told`` the calibration that detectors are handed.
    ``thermal``: whether the limit of nomination belongs beside it.
    """

    name: str
    label: str
    about: str
    values: tuple[float, ...]
    set_up: SetUp
    optics: Callable[[float, Optics], Optics] = same_optics
    told: Callable[[float, int, Calibration], Calibration] = true_calibration
    thermal: bool = False
    logarithmic: bool = False


@dataclass(frozen=True, slots=True)
class Tally:
    """What one detector did at one value: distances of the ends it found, and counts that add."""

    distances_mm: tuple[float, ...] = ()
    false: int = 0
    failures: int = 0

    def __add__(self, other: Tally) -> Tally:
        return Tally(self.distances_mm + other.distances_mm, self.false + other.false, self.failures + other.failures)


@dataclass(frozen=True, slots=True)
class Limit:
    """What physics allows at one value: 3-D error by the pictures' noise with the calibration that was told, the depth error of a disparity
    that is good to a fixed share of a pixel (median), and the share of ends that a thermal picture can show (None where that isn't asked).
    """

    median_mm: float
    p95_mm: float
    disparity_mm: float
    share: float | None


@dataclass(frozen=True, slots=True)
class Measured:
    """One value: how many ends every camera could see, what each detector found of them, and the limit (None where none was visible)."""

    value: float
    visible: int
    tallies: Mapping[str, Tally]
    limit: Limit | None
