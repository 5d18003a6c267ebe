"""A controller's identity, its stored settings, and what follows from them: where a move may go,
how long it may take, and whether it got there.

Grbl and grblHAL report them in answers to ``$$``, FluidNC in answers to ``$/axes/…``. X, Y and Z
($100 to $132) are documented. A is from grblHAL's source: $103, $113, $123, $133 (steps per degree,
degrees/min, degrees/s², degrees), a fourth number in positions, bit 8 of $44 to $49 for its homing
pass, and bit 8 of $22 for an origin at the switch. A length with A is the root of the sum of all
squares, as in the firmware.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from instruments.errors import DeviceError, LimitError, ProtocolError
from instruments.stage.protocol import AXES

Axes = tuple[float, ...]
Target = dict[str, float]  # by axis letter in machine coordinates: mm, degrees for A
DECLARABLE = ("XY", "XYZ", "XYA", "XYZA")
_PASSES = range(44, 50)
_ORIGIN_AT_SWITCH = 8


@dataclass(frozen=True, slots=True)
class StageIdentity:
    """Dialect, version, build and build options as ``$I`` prints them."""

    dialect: str
    version: str
    build: str
    options: str

    def __str__(self) -> str:
        build, options = self.build or "unknown", self.options or "unknown"
        return f"{self.dialect} {self.version} (build {build}, options {options})"


@dataclass(frozen=True, slots=True)
class AxisLimits:
    """The ends of an axis in machine coordinates, mm (degrees for A)."""

    low_mm: float
    high_mm: float

    def hold(self, value_mm: float) -> bool:
        """Whether a target lies within, the ends included."""
        return self.low_mm <= value_mm <= self.high_mm


@dataclass(frozen=True, slots=True)
class StageSettings:
    """Settings of X Y Z, and A where used: mm, mm/min, mm/s²; degrees for A. ``low_mm``: lowest
    machine coordinates; None: machine space is negative.
    """

    travel_mm: Axes
    rate_mm_min: Axes
    accel_mm_s2: Axes
    steps_per_mm: Axes
    homing_seek_mm_min: float
    homing_feed_mm_min: float
    pull_off_mm: float = 0.0
    soft_limits: bool = True
    hard_limits: bool = True
    homing: bool = True
    low_mm: Axes | None = None

    @property
    def limits(self) -> dict[str, AxisLimits]:
        """The travel of each axis, machine coordinates."""
        lows = self.low_mm or tuple([-travel for travel in self.travel_mm])
        axes = zip(AXES, lows, self.travel_mm, strict=False)
        return {axis: AxisLimits(low, low + travel) for axis, low, travel in axes}

    @property
    def homing_bound_s(self) -> float:
        """The longest homing: each axis in turn searches 1.5 times its travel, then creeps."""
        seek_s = 60 * 1.5 * sum(self.travel_mm) / self.homing_seek_mm_min
        creep_s = 60 * len(self.travel_mm) * 5 * self.pull_off_mm / self.homing_feed_mm_min
        return seek_s + creep_s + 15.0


def read_settings(values: Mapping[int, str], *, who: str, axes: str = "XYZ") -> StageSettings:
    """The settings of a stage with ``axes`` from ``$n=value`` pairs. Raises ProtocolError for a
    missing number, DeviceError for an absent axis, one that isn't homed, or an origin at the
    switch.
    """

    def number(key: int, least: float = 0.0) -> float:
        return _number(values, key, least, who)

    def each(first: int) -> Axes:
        return tuple(number(first + i, 1e-6) for i in range(4 if "A" in axes else 3))

    # a controller that these axes can't be driven with is refused
    def refuse(what: str, hint: str) -> None:
        raise DeviceError(who, what, asked="$$", hint=hint)

    if _number(values, 13, 0.0, who):
        refuse("the controller reports in inches", "Set $13=0.")
    if "A" in axes and 103 not in values:
        hint = "A rotation needs a grblHAL build with four axes; without one, leave A out of axes."
        refuse("the controller has no axis A: setting $103 is missing", hint)
    if int(_number(values, 22, 0.0, who)) & _ORIGIN_AT_SWITCH:
        refuse(
            "homing puts the origin where the switch lets go ($22 has bit 8 set)",
            "Clear that bit ($22=1): targets are then negative, 0 at the switch.",
        )
    passes = [int(_number(values, key, 0.0, who)) for key in _PASSES if key in values]
    homed = [axis for at, axis in enumerate(AXES) if any(mask >> at & 1 for mask in passes)]
    if passes and (unhomed := [axis for axis in axes if axis not in homed]):
        hint = "Name it in a homing pass ($44 to $49: X is 1, Y 2, Z 4, A 8), and fit its switch."
        refuse(f"homing leaves out {', '.join(unhomed)}", hint)
    return StageSettings(
        travel_mm=each(130),
        rate_mm_min=each(110),
        accel_mm_s2=each(120),
        steps_per_mm=each(100),
        soft_limits=bool(number(20)),
        hard_limits=bool(int(number(21)) & 1),
        homing=bool(int(number(22)) & 1),
        homing_seek_mm_min=number(25, 1e-6),
        homing_feed_mm_min=number(24, 1e-6),
        pull_off_mm=number(27),
    )


MUST_HOME = "/start/must_home"
# what `read_fluidnc` reads of each axis
FLUIDNC_KEYS = (
    "steps_per_mm", "max_rate_mm_per_min", "acceleration_mm_per_sec2", "max_travel_mm",
    "soft_limits", "homing/cycle", "homing/mpos_mm", "homing/positive_direction",
    "homing/seek_mm_per_min", "homing/feed_mm_per_min", "motor0/hard_limits", "motor0/pulloff_mm",
)  # fmt: skip


def read_fluidnc(values: Mapping[str, str], *, who: str, axes: str = "XYZ") -> StageSettings:
    """The same from FluidNC's configuration: machine space is ``max_travel_mm`` long, from
    ``mpos_mm`` up, or down with ``positive_direction``. DeviceError too for a start that doesn't
    ask for homing.
    """
    if values.get(MUST_HOME) != "true":
        what, hint = "a restart would go unnoticed", "Set start/must_home to true."
        raise DeviceError(who, what, asked=f"${MUST_HOME}", seen=values.get(MUST_HOME), hint=hint)
    letters = (AXES if "A" in axes else AXES[:3]).lower()

    def each(key: str, least: float = 1e-6) -> Axes:
        return tuple([_number(values, f"/axes/{axis}/{key}", least, who) for axis in letters])

    def true(key: str) -> list[bool]:
        return [values.get(f"/axes/{axis}/{key}") == "true" for axis in letters]

    cycles = dict(zip(AXES, each("homing/cycle", -1.0), strict=False))
    if unhomed := [axis for axis in axes if cycles[axis] <= 0]:
        hint = "Give each axis a homing cycle of 1 or more in the configuration file."
        raise DeviceError(who, f"homing leaves out {', '.join(unhomed)}", asked="$/axes", hint=hint)
    travel, mpos = each("max_travel_mm"), each("homing/mpos_mm", -1e6)
    down = true("homing/positive_direction")
    return StageSettings(
        travel_mm=travel,
        rate_mm_min=each("max_rate_mm_per_min"),
        accel_mm_s2=each("acceleration_mm_per_sec2"),
        steps_per_mm=each("steps_per_mm"),
        soft_limits=all(true("soft_limits")),
        hard_limits=all(true("motor0/hard_limits")),
        homing_seek_mm_min=min(each("homing/seek_mm_per_min")),
        homing_feed_mm_min=min(each("homing/feed_mm_per_min")),
        pull_off_mm=max(each("motor0/pulloff_mm", 0.0)),
        low_mm=tuple([m - t * d for m, t, d in zip(mpos, travel, down, strict=True)]),
    )


K = TypeVar("K", int, str)


def _number(values: Mapping[K, str], key: K, least: float, who: str) -> float:
    text = values.get(key, "nothing")
    with contextlib.suppress(ValueError):
        if least <= (value := float(text)) < 1e9:
            return value
    what, hint = f"setting ${key} is not usable", f"Set ${key} on the controller."
    asked = "$$" if isinstance(key, int) else f"${key}"
    raise ProtocolError(who, what, asked=asked, seen=text or "nothing", hint=hint)


def declared(values: Mapping[str, float | None], axes: str, *, who: str) -> Target:
    """``values`` without None. Raises LimitError for an undeclared axis."""
    target = {axis: value for axis, value in values.items() if value is not None}
    if missing := [axis for axis in target if axis not in axes]:
        hint = f"It is declared with {axes}: if it has more, say so in the rig file's [stage] axes."
        raise LimitError(who, f"this stage has no axis {', '.join(missing)}", hint=hint)
    return target


def check_within(target: Target, settings: StageSettings, line: str, *, who: str) -> None:
    """Raise LimitError for a target outside the travel that the controller's settings give."""
    limits = settings.limits
    for axis, value in target.items():
        if not limits[axis].hold(round(value, 3)):  # as it is sent
            unit = "deg" if axis == "A" else "mm"
            travel = f"{limits[axis].low_mm:g} to {limits[axis].high_mm:g} {unit}"
            what = f"{axis} = {value:.3f} {unit} is outside the travel, {travel}"
            hint = "Machine coordinates are negative, 0 is at the switch."
            if settings.low_mm:
                hint = "These are machine coordinates, as the controller counts after homing."
            raise LimitError(who, what, asked=line, hint=hint)
