"""The emulated controller's stored settings: defaults, how they print, what may be written, and what they mean in mm and s.

It may not know the state of the board; whether writing is allowed now is the board's business.
"""

from __future__ import annotations

from collections.abc import Mapping

from instruments.stage.emulator.homing import HomingRates
from instruments.stage.emulator.phases import Vector
from instruments.stage.emulator.planner import AxisRates

DEFAULTS: dict[int, float] = {
    0: 10, 1: 25, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0,
    10: 1, 11: 0.01, 12: 0.002, 13: 0,
    20: 1, 21: 1, 22: 1, 23: 0, 24: 100, 25: 1500, 26: 250, 27: 1,
    30: 1000, 31: 0, 32: 0,
    100: 250, 101: 250, 102: 250,
    110: 3000, 111: 3000, 112: 3000,
    120: 200, 121: 200, 122: 200,
    130: 300, 131: 275, 132: 50,
}  # fmt: skip
_WITH_DECIMALS = frozenset({11, 12, 24, 25, 27, *range(100, 140)})


class Store:
    """Settings by number. Raises ValueError for a number that the controller doesn't have."""

    def __init__(self, changes: Mapping[int, float] | None = None) -> None:
        unknown = set(changes or {}) - set(DEFAULTS)
        if unknown:
            raise ValueError(f"the stage has no settings ${', $'.join(str(n) for n in sorted(unknown))}")
        self._values = DEFAULTS | dict(changes or {})

    def __getitem__(self, number: int) -> float:
        return self._values[number]

    def lines(self) -> list[str]:
        """As ``$$`` prints them."""
        return [f"${n}={value:.3f}" if n in _WITH_DECIMALS else f"${n}={value:.0f}" for n, value in self._values.items()]

    def write(self, number: float, value: float) -> int:
        """Store a setting; 0, or the error code of a refusal."""
        if value < 0:
            return 4
        if number not in self._values:
            return 3
        if number == 0 and value < 3:
            return 6
        if number == 20 and value and not self._values[22]:
            return 10
        self._values[int(number)] = value
        if number == 22 and not value:
            self._values[20] = 0  # soft limits mean nothing without homing
        return 0

    @property
    def travel_mm(self) -> Vector:
        return self._axes(130)

    @property
    def rates(self) -> AxisRates:
        x, y, z = (rate / 60 for rate in self._axes(110))
        return AxisRates((x, y, z), self._axes(120), self._values[11])

    @property
    def homing(self) -> HomingRates:
        inverted = int(self._values[23])
        return HomingRates(
            travel_mm=self.travel_mm,
            seek_mm_s=self._values[25] / 60,
            feed_mm_s=self._values[24] / 60,
            accel_mm_s2=self._axes(120),
            pull_off_mm=self._values[27],
            debounce_s=self._values[26] / 1000,
            at_far_end=frozenset(axis for axis in range(3) if inverted >> axis & 1),
        )

    def whole_steps(self, at_mm: Vector) -> Vector:
        """The nearest place that a whole number of steps reaches."""
        x, y, z = (round(place * steps) / steps for place, steps in zip(at_mm, self._axes(100), strict=True))
        return x, y, z

    def beyond_travel(self, target_mm: Vector) -> bool:
        """Whether a target lies outside machine space, which is negative."""
        return any(place > 0 or place < -travel for place, travel in zip(target_mm, self.travel_mm, strict=True))

    def _axes(self, first: int) -> Vector:
        return self._values[first], self._values[first + 1], self._values[first + 2]
