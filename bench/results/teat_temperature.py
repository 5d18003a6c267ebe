"""The teats' surface temperature, from a sensor at the phantom or from the plant model at rest.

The model (water-bath fact sheet, 4.3 and 5): water cools a little in the hose; a teat lies between
water and room as its inner film and outer surface divide the difference. What is unknown of a real
phantom, the film first, is in the uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from instruments.world.plant import HEAT_CAPACITY_J_PER_L_K, PlantConstants

FILM_W_PER_M2K = 600.0  # what the plant's teat_in_w_per_k stands for
FILM_SPAN_W_PER_M2K = (300.0, 1500.0)  # slow and fast flow inside the teat (section 4.3)
ROOM_SPAN_K = 3.0  # how far the room may be from the rig file's figure
# how far a sensor at the phantom may be from the mean surface: root to tip, teat to teat
SENSOR_SPAN_K = 0.2


@dataclass(frozen=True, slots=True)
class Contribution:
    """One contribution: ``u_k`` is a standard uncertainty."""

    name: str
    u_k: float
    source: str


@dataclass(frozen=True, slots=True)
class Surface:
    """The teats' mean surface temperature, how it was found, and its uncertainty's components."""

    temp_c: float
    how: str
    components: tuple[Contribution, ...]

    @property
    def u_k(self) -> float:
        """Standard uncertainty; twice that is the report's +/-."""
        return math.sqrt(sum(c.u_k**2 for c in self.components))


@dataclass(frozen=True, slots=True)
class TemperatureInputs:
    """What the rig file says: the room, and the sensors' standard uncertainties."""

    room_c: float = 20.0
    accuracy_k: float = 0.1
    external_accuracy_k: float = 0.1


def surface(
    bath_c: Sequence[float], external_c: Sequence[float], figures: TemperatureInputs
) -> Surface | None:
    """From a sensor at the phantom if there is one, else from the bath's; None without either."""
    readings = external_c or bath_c
    if not readings:
        return None
    mean_c, change_k = fmean(readings), (max(readings) - min(readings)) / math.sqrt(12.0)
    steady = Contribution("change during the capture", change_k, f"{len(readings)} readings")
    if external_c:
        sensor_k, place_k = figures.external_accuracy_k, SENSOR_SPAN_K / math.sqrt(3.0)
        place = f"± {SENSOR_SPAN_K:g} K, root to tip and teat to teat"
        components: tuple[Contribution, ...] = (
            Contribution("sensor at the phantom", sensor_k, "rig file, external_accuracy_k"),
            Contribution("the sensor's place", place_k, place),
            steady,
        )
        return Surface(mean_c, "external sensor at the phantom", components)
    room_c = figures.room_c
    supply_c = mean_c - hose_drop_k(mean_c, room_c)
    slow, fast = (below_water_k(supply_c, room_c, film) for film in FILM_SPAN_W_PER_M2K)
    per_k = below_water_k(1.0, 0.0)  # it is linear
    film_k, room_k = abs(slow - fast) / math.sqrt(12.0), ROOM_SPAN_K * per_k / math.sqrt(3.0)
    components = (
        Contribution("bath's own sensor", figures.accuracy_k, "rig file, accuracy_k"),
        Contribution("film inside the teat", film_k, "300 to 1500 W/m²K"),
        Contribution("room", room_k, f"± {ROOM_SPAN_K:g} K"),
        steady,
    )
    return Surface(supply_c - below_water_k(supply_c, room_c), "plant model", components)


def below_water_k(water_c: float, room_c: float, film_w_per_m2k: float = FILM_W_PER_M2K) -> float:
    """How much colder a teat is than the water that flows into it, at rest."""
    k = PlantConstants()
    inside = k.teat_in_w_per_k * film_w_per_m2k / FILM_W_PER_M2K
    return (water_c - room_c) * k.teat_out_w_per_k / (inside + k.teat_out_w_per_k)


def hose_drop_k(water_c: float, room_c: float) -> float:
    """What the water loses on its way to the teats."""
    k = PlantConstants()
    flow_w_per_k = k.flow_l_per_min / 60.0 * HEAT_CAPACITY_J_PER_L_K
    return (water_c - room_c) * (1.0 - math.exp(-k.hose_loss_w_per_k / flow_w_per_k))
