"""What an emulated controller is at one moment, beside the plant that it controls: its memory and the settings of its panel.

It knows the profile's names and codes, and may not know addresses, frames or clocks. What each name means: `meanings`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from instruments.bath.families import Manners
from instruments.bath.profile import Profile
from instruments.bath.registers import Order
from instruments.bath.rows import Row
from instruments.world.plant import Plant

TURNED: Mapping[Order, Order] = {"ABCD": "CDAB", "CDAB": "ABCD", "BADC": "DCBA", "DCBA": "BADC"}


class Controller:
    """A controller of ``profile``'s family over ``plant``.

    ``fahrenheit`` and ``turned`` (the words of a number the other way round) are settings that somebody else may change, as is
    ``manual_mode``: in it a circulator confirms writes and ignores them (``ignores``); a controller holds its output where it was.
    """

    def __init__(self, plant: Plant, profile: Profile, manners: Manners, unit_id: int) -> None:
        self.plant = plant
        self.profile = profile
        self.manners = manners
        self.unit_id = unit_id
        self.fahrenheit = self.turned = self.ignores = False
        self.memory: dict[str, float] = {}
        self._order = profile.order_for(0) or profile.order
        self._shipped_c = plant.set_point_c
        self._last_c = plant.pv_c

    @property
    def manual_mode(self) -> bool:
        """Whether somebody has switched it to manual."""
        return self.ignores or self.plant.manual_output is not None

    @manual_mode.setter
    def manual_mode(self, on: bool) -> None:
        if self.profile.find("remote"):
            self.ignores = on
        else:
            self.plant.manual_output = self.plant.output if on else None

    @property
    def decimals(self) -> int:
        """Digits behind the decimal point that a 16-bit number leaves out (Eurotherm 525; none where 12550 says integers)."""
        return 0 if self.remembered("resolution") == 1 else int(self.remembered("decimals"))

    @property
    def order(self) -> Order:
        """In which order the bytes of two registers go just now."""
        return TURNED[self._order] if self.turned else self._order

    def set_order(self, code: int) -> None:
        """Another order of bytes by its code; nothing for a code that means none."""
        self._order = self.profile.order_for(code) or self._order

    def shown(self, row: Row, value: float) -> float:
        """A value of ``row`` in the unit that it speaks just now."""
        if not self.fahrenheit:
            return value
        return value * 1.8 + 32.0 if row.unit == "degC" else value * 1.8 if row.unit.startswith("K") else value

    def metric(self, row: Row, shown: float) -> float:
        """The other way round."""
        if not self.fahrenheit:
            return shown
        return (shown - 32.0) / 1.8 if row.unit == "degC" else shown / 1.8 if row.unit.startswith("K") else shown

    def remembered(self, name: str) -> float:
        """What a row holds that nothing in the plant answers for."""
        start = self.manners.starts.get(name)
        if start is None:
            row = self.profile.find(name)
            codes = row.values.values() if row else ()
            low, high = row.range if row and row.range else (0.0, 0.0)
            start = float(min(codes, key=abs)) if codes else min(max(0.0, low), high)
        return self.memory.get(name, start)

    def code(self, name: str, label: str) -> float:
        """The code that a row of the profile has for a label; 0 where it has none."""
        row = self.profile.row(name)
        return float(row.values.get(label, row.seen.get(label, 0)))

    def temperature_c(self) -> float:
        """What it takes for the temperature."""
        if not self.plant.broken_sensor:
            self._last_c = self.plant.pv_c
        return math.nan if self.plant.broken_sensor and self.manners.sensor_break == "nan" else self._last_c

    def alarm1(self) -> str:
        """Which of alarm 1's two thresholds is passed."""
        temp_c = self.temperature_c()
        return "high" if temp_c >= self.remembered("alarm1_high") else "low" if temp_c <= self.remembered("alarm1_low") else "none"

    def reset(self) -> None:
        """Power off and on. A family that keeps nothing is as shipped then, in standby."""
        if self.manners.after_reset == "standby":
            self.memory.clear()
            plant = self.plant
            plant.standby()
            plant.set_point_c, plant.manual_output, plant.output_max = self._shipped_c, None, plant.constants.output_max
            plant.set_flow(plant.constants.flow_l_per_min)
