"""The firmwares' differences, and the emulated controller's stored settings: defaults, text,
allowed values, and meaning in mm and s.

Classic GRBL's differences are recorded. Of grblHAL, welcome, buffer size, report fields and the
answer to ``?`` in alarm 2 are recorded; planner blocks, fourth axis ($103 to $133), homing passes
($44 to $46) and the out-of-square alarm are from its source. Numbers to $132 are the firmware's
documents'. FluidNC is from its source. Marlin and Zaber are set by Grbl's numbers here, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from instruments.stage.emulator.motion import AxisRates, Vector


@dataclass(frozen=True, slots=True)
class Firmware:
    """A firmware's welcome, buffers, report fields and options (as `$I` prints them), by default
    classic GRBL's. grblHAL's receive buffer holds a byte less than it states.
    """

    name: str = "Grbl"
    welcome: str = "Grbl 1.1h ['$' for help]"
    build: str = "1.1h.20190830"
    options: str = "V,15,128"
    planner_blocks: int = 15
    receive_bytes: int = 128
    more_fields: bool = False  # grblHAL's H: (homed) and TLR: (tool length reference)
    always_reports: bool = False  # also while homing and in a critical alarm
    most_axes: int = 3
    homing_passes: bool = False  # whether settings say which axes are homed in which pass
    crooked_alarm: int = 10  # two motors of one axis found their switches too far apart
    most_line_number: float = 10_000_000
    info: str = ""  # in front of what its messages say
    configured: bool = False  # settings are asked for as $/axes/x/…
    from_low_end: bool = False  # machine space is positive, 0 where it is homed
    resets_on_open: bool = True  # when a host opens the port

    def identity(self, info: str = "") -> list[str]:
        return [f"[VER:{self.build}:{info}]", f"[OPT:{self.options}]"]


CLASSIC = Firmware()
GRBL_HAL = Firmware(
    name="grblHAL",
    welcome="GrblHAL 1.1f ['$' or '$HELP' for help]",
    build="1.1f.20240101",
    options="V,35,1024",
    planner_blocks=35,
    receive_bytes=1023,
    more_fields=True,
    always_reports=True,
    most_axes=4,
    homing_passes=True,
    crooked_alarm=15,
    most_line_number=math.inf,
)
FLUIDNC = Firmware(
    name="FluidNC",
    welcome="Grbl 3.7 [FluidNC v3.7.12 (wifi) '$' for help]",
    build="3.7 FluidNC v3.7.12",
    options="PHS",
    receive_bytes=1023,
    always_reports=True,
    most_axes=4,
    homing_passes=True,
    crooked_alarm=9,
    most_line_number=math.inf,
    info="INFO: ",
    configured=True,
)
MARLIN = Firmware(name="Marlin", homing_passes=True, from_low_end=True)
ZABER = replace(MARLIN, name="Zaber", most_axes=4, resets_on_open=False)
EMULATED = {one.name: one for one in (CLASSIC, GRBL_HAL, FLUIDNC, MARLIN, ZABER)}


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
HAL_DEFAULTS: dict[int, float] = {40: 0, 43: 1, 44: 4, 45: 3, 46: 0}
# homed towards the low ends, an axis after the other
LOW_END_DEFAULTS: dict[int, float] = {23: 15, 44: 1, 45: 2, 46: 4, 47: 8}
# per degree; homed in a pass of its own
ROTARY_DEFAULTS: dict[int, float] = {46: 8, 103: 100, 113: 3600, 123: 360, 133: 360}
_WITH_DECIMALS = frozenset({11, 12, 24, 25, 27, *range(100, 140)})
_FLAGS = frozenset({4, 5, 6, 13, 20, 21, 22, 32})
_CLASSIC_PASSES = ((2,), (0, 1))


class Store:
    """Settings by number for 3 ``axes``, or 4 with A; ``high_mm``: high ends where machine
    coordinates begin at the low ones, or are configured. Raises ValueError for unknown numbers.
    """

    def __init__(
        self,
        changes: Mapping[int, float] | None = None,
        *,
        dialect: Firmware = CLASSIC,
        axes: int = 3,
        high_mm: Vector | None = None,
    ) -> None:
        if not 3 <= axes <= dialect.most_axes:
            raise ValueError(f"{dialect.name} has 3 to {dialect.most_axes} axes, not {axes}")
        self.axes, self.dialect, self._high_mm = axes, dialect, high_mm
        known = DEFAULTS | (HAL_DEFAULTS if dialect.homing_passes else {})
        known |= ROTARY_DEFAULTS if axes > 3 else {}
        known |= LOW_END_DEFAULTS if dialect.from_low_end else {}
        if unknown := sorted(set(changes or {}) - set(known)):
            raise ValueError(f"the stage has no settings ${', $'.join(map(str, unknown))}")
        known |= dict(changes or {})
        needed = [n + axis for n in (100, 110, 120, 130) for axis in range(axes)]
        if dialect.from_low_end and (zero := [n for n in needed if not known[n]]):
            raise ValueError(f"{dialect.name} needs ${', $'.join(map(str, zero))} above 0")
        self._usual = dict(sorted(known.items()))
        self.restore()

    def restore(self) -> None:
        """Set all back to what the board came with."""
        self._values = dict(self._usual)

    @property
    def limits_inverted(self) -> bool:
        """Whether $5 is not as the limit switches are wired: their pins then show the contrary."""
        return self._values[5] != self._usual[5]

    def __getitem__(self, number: int) -> float:
        return self._values[number]

    def lines(self) -> list[str]:
        return [
            f"${n}={value:.3f}" if n in _WITH_DECIMALS else f"${n}={value:.0f}"
            for n, value in self._values.items()
        ]

    def write(self, number: int, value: float) -> int:
        """Store a setting; 0, or the error code of a refusal."""
        if value < 0:
            return 4
        if number not in self._values:
            return 3
        if number not in _WITH_DECIMALS:
            value = int(value) & 0xFF if number not in (30, 31) else value
            value = bool(value) if number in _FLAGS else value
        if number == 0 and value < 3:
            return 6
        if number == 20 and value and not self._values[22]:
            return 10
        self._values[number] = value
        if number == 22 and not value:
            self._values[20] = 0  # soft limits mean nothing without homing
        return 0

    @property
    def origin_mm(self) -> Vector:
        """Machine coordinates less the carriage's, which are 0 at the high end of its rails."""
        if self.dialect.configured:
            return self._high_mm or (0.0,) * self.axes
        if not self.dialect.from_low_end:
            return (0.0,) * self.axes
        return self._high_mm or tuple([travel - self._values[27] for travel in self.travel_mm])

    @property
    def ends_mm(self) -> tuple[Vector, Vector]:
        """The low and high ends of the travel in machine coordinates that begin at the low ones."""
        high, pull_off = self.origin_mm, self._values[27]
        ends = zip(high, self.travel_mm, strict=True)
        return tuple([top - travel + pull_off for top, travel in ends]), high

    @property
    def travel_mm(self) -> Vector:
        return self._axes(130)

    @property
    def at_far_end(self) -> frozenset[int]:
        """Axes whose homing switch is at minus the travel."""
        return frozenset(axis for axis in range(self.axes) if int(self._values[23]) >> axis & 1)

    @property
    def rates(self) -> AxisRates:
        return AxisRates(tuple([rate / 60 for rate in self._axes(110)]), self._axes(120))

    @property
    def passes(self) -> tuple[tuple[int, ...], ...]:
        """Axes that are homed together, pass by pass."""
        if not self.dialect.homing_passes:
            return _CLASSIC_PASSES
        masks = [int(self._values.get(number, 0)) for number in (44, 45, 46, 47)]
        passes = (tuple(axis for axis in range(self.axes) if mask >> axis & 1) for mask in masks)
        return tuple(axes for axes in passes if axes)

    def switch_mm(self, axis: int) -> float:
        """Where the axis's homing switch is."""
        return -self.travel_mm[axis] if axis in self.at_far_end else 0.0

    def home_mm(self, axes: Sequence[int], before_mm: Vector) -> Vector:
        """The count after homing ``axes``; another keeps its own."""
        home = list(before_mm)
        for axis in axes:
            away = self._values[27] if axis in self.at_far_end else -self._values[27]
            home[axis] = self.switch_mm(axis) + away
        return self.whole_steps(home)

    def whole_steps(self, at_mm: Sequence[float], now_mm: Vector | None = None) -> Vector:
        """The nearest place that a whole number of steps reaches; without steps where it is now."""
        axes = zip(at_mm, self._axes(100), now_mm or at_mm, strict=True)
        return tuple([round(place * n) / n if n else now for place, n, now in axes])

    def beyond_travel(self, target_mm: Vector) -> bool:
        """Whether a target lies outside machine space, which ends at the high ends."""
        ends = zip(target_mm, self.travel_mm, self.origin_mm, strict=True)
        return any(not high - travel <= place <= high for place, travel, high in ends)

    def _axes(self, first: int) -> Vector:
        values = self._values
        return tuple([values[number] for number in range(first, first + self.axes)])

    def configuration(self, key: str) -> str | None:
        """FluidNC's entry ``/axes/x/homing/cycle`` as text; None where there is none."""
        if key == "/start/must_home":
            return "true"
        _, head, letter, *more = (*key.split("/"), "", "", "")
        axis = "xyza".find(letter)
        if head != "axes" or not letter or not 0 <= axis < self.axes:
            return None
        low = axis in self.at_far_end
        cycle = next((at for at, axes in enumerate(self.passes, 1) if axis in axes), 0)
        return {
            "steps_per_mm": f"{self._values[100 + axis]:.3f}",
            "max_rate_mm_per_min": f"{self._values[110 + axis]:.3f}",
            "acceleration_mm_per_sec2": f"{self._values[120 + axis]:.3f}",
            "max_travel_mm": f"{self._values[130 + axis]:.3f}",
            "soft_limits": "true" if self._values[20] else "false",
            "homing/cycle": str(cycle if self._values[22] else 0),
            "homing/mpos_mm": f"{self.origin_mm[axis] + self.switch_mm(axis):.3f}",
            "homing/positive_direction": "false" if low else "true",
            "homing/seek_mm_per_min": f"{self._values[25]:.3f}",
            "homing/feed_mm_per_min": f"{self._values[24]:.3f}",
            "motor0/hard_limits": "true" if self._values[21] else "false",
            "motor0/pulloff_mm": f"{self._values[27]:.3f}",
        }.get("/".join(filter(None, more)))
