"""What a controller says of itself: who it is, and its stored settings as the answers to ``$$`` give them.

Pure. It may not know a wire, or what the settings are used for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from instruments.errors import ProtocolError

Axes = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class StageIdentity:
    """Who answers: the firmware's dialect and version, its build and its build options as ``$I`` prints them."""

    dialect: str
    version: str
    build: str
    options: str

    def __str__(self) -> str:
        return f"{self.dialect} {self.version} (build {self.build or 'unknown'}, options {self.options or 'unknown'})"


@dataclass(frozen=True, slots=True)
class AxisLimits:
    """The ends of an axis in machine coordinates, mm."""

    low_mm: float
    high_mm: float

    def hold(self, value_mm: float) -> bool:
        """Whether a target lies within, the ends included."""
        return self.low_mm <= value_mm <= self.high_mm


@dataclass(frozen=True, slots=True)
class StageSettings:
    """Settings in the controller's units, X Y Z: mm, mm/min, mm/s²."""

    travel_mm: Axes
    rate_mm_min: Axes
    accel_mm_s2: Axes
    steps_per_mm: Axes
    soft_limits: bool
    hard_limits: bool
    homing: bool
    homing_seek_mm_min: float
    homing_feed_mm_min: float
    pull_off_mm: float
    reports_inches: bool

    @property
    def limits(self) -> dict[str, AxisLimits]:
        """The travel of each axis: machine space is negative, 0 at the switch."""
        return {axis: AxisLimits(-travel, 0.0) for axis, travel in zip("XYZ", self.travel_mm, strict=True)}

    @property
    def homing_bound_s(self) -> float:
        """No homing cycle takes longer: every axis searches 1.5 times its travel, one after the other, then creeps."""
        seek_s = 60 * 1.5 * sum(self.travel_mm) / self.homing_seek_mm_min
        creep_s = 60 * 3 * 5 * self.pull_off_mm / self.homing_feed_mm_min
        return seek_s + creep_s + 15.0


def read_settings(values: Mapping[int, str], *, who: str) -> StageSettings:
    """The settings from ``$n=value`` pairs. Raises ProtocolError when one is missing or not a number above its least value."""

    def number(key: int, least: float = 0.0) -> float:
        text = values.get(key)
        try:
            value = float(text) if text is not None else float("nan")
        except ValueError:
            value = float("nan")
        if not least <= value < 1e9:
            hint = f"Set ${key} on the controller."
            raise ProtocolError(who, f"setting ${key} is not usable", asked="$$", seen=text or "nothing", hint=hint)
        return value

    def axes(first: int) -> Axes:
        return number(first, 1e-6), number(first + 1, 1e-6), number(first + 2, 1e-6)

    return StageSettings(
        travel_mm=axes(130),
        rate_mm_min=axes(110),
        accel_mm_s2=axes(120),
        steps_per_mm=axes(100),
        soft_limits=bool(number(20)),
        hard_limits=bool(int(number(21)) & 1),
        homing=bool(int(number(22)) & 1),
        homing_seek_mm_min=number(25, 1e-6),
        homing_feed_mm_min=number(24, 1e-6),
        pull_off_mm=number(27),
        reports_inches=bool(number(13)),
    )
