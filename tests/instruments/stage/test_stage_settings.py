"""Settings as each firmware words them, and those that a stage can't be driven with."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from instruments.errors import DeviceError, ProtocolError
from instruments.stage.marlin import read_marlin
from instruments.stage.settings import FLUIDNC_KEYS, AxisLimits, read_fluidnc, read_settings

GRBL = {13: "0", 20: "1", 21: "0", 22: "1", 24: "25.000", 25: "500.000", 27: "1.000"} | {
    first + axis: "100.000" for first in (100, 110, 120, 130) for axis in range(3)
}
WITH_A = GRBL | {103: "100.000", 113: "3600.000", 123: "360.000", 133: "360.000"}
WITH_A |= {44: "4", 45: "3", 46: "8"}
FLUID = {f"/axes/{axis}/{key}": "1.000" for axis in "xyz" for key in FLUIDNC_KEYS}
FLUID |= {f"/axes/{axis}/max_travel_mm": "300.000" for axis in "xyz"}
FLUID |= {"/start/must_home": "true"}
M92, M201 = "M92 X80.00 Y80.00 Z400.00 E93.00", "M201 X3000.00 Y3000.00 Z100.00 E10000.00"
M203 = "M203 X300.00 Y300.00 Z5.00 E25.00"
ENDS = "Soft endstops: ON  Min: X0.00 Y-2.00 Z0.00   Max: X220.00 Y220.00 Z250.00"


def test_grbls_settings_of_four_axes() -> None:
    settings = read_settings(WITH_A, who="stage", axes="XYA")
    assert settings.travel_mm == (100.0, 100.0, 100.0, 360.0)
    assert settings.rate_mm_min[3] == 3600.0
    assert read_settings(WITH_A, who="stage", axes="XY").travel_mm == (100.0, 100.0, 100.0)


def test_fluidncs_travel_goes_from_its_homing_place() -> None:
    places = {
        "/axes/x/homing/mpos_mm": "5.000",
        "/axes/x/homing/positive_direction": "false",
        "/axes/y/homing/mpos_mm": "0.000",
        "/axes/y/homing/positive_direction": "true",
    }
    limits = read_fluidnc(FLUID | places, who="stage", axes="XY").limits
    assert limits["X"] == AxisLimits(5.0, 305.0)
    assert limits["Y"] == AxisLimits(-300.0, 0.0)


@pytest.mark.parametrize("ends", [[ENDS], ["M211 S1 ; ON", ENDS.partition("  ")[2]]])
def test_marlins_settings_as_its_source_words_them(ends: list[str]) -> None:
    settings = read_marlin([M92, M203, M201, *ends], "XYZ", who="stage")
    assert settings.steps_per_mm == (80.0, 80.0, 400.0)
    assert settings.rate_mm_min == (18000.0, 18000.0, 300.0)
    assert settings.limits["Y"] == AxisLimits(-2.0, 220.0)
    assert settings.soft_limits


def grbl(changes: dict[int, str], axes: str = "XY") -> Callable[..., Any]:
    return partial(read_settings, WITH_A | changes, axes=axes)


def fluid(changes: dict[str, str]) -> Callable[..., Any]:
    return partial(read_fluidnc, FLUID | changes, axes="XY")


def told(*lines: str) -> Callable[..., Any]:
    return partial(read_marlin, list(lines), "XY")


@pytest.mark.parametrize(
    ("read", "error", "why"),
    [
        (grbl({133: "0.000"}, "XYA"), ProtocolError, r"setting \$133 is not usable"),
        (grbl({46: "0"}, "XYA"), DeviceError, "homing leaves out A"),
        (grbl({22: "9"}), DeviceError, r"\$22 has bit 8 set.*\$22=1"),
        (grbl({13: "1"}), DeviceError, r"in inches.*\$13=0"),
        (grbl({45: "1"}), DeviceError, "homing leaves out Y"),
        (grbl({22: "yes"}), ProtocolError, r"setting \$22 is not usable"),
        (fluid({"/start/must_home": "false"}), DeviceError, "a restart would go unnoticed"),
        (fluid({"/axes/y/homing/cycle": "0"}), DeviceError, "homing leaves out Y"),
        (fluid({"/axes/y/homing/cycle": "nonsense"}), ProtocolError, "cycle is not usable"),
        (fluid({"/axes/x/max_travel_mm": "-3"}), ProtocolError, "max_travel_mm is not usable"),
        (told(M92, M203, M201, ENDS, "G20 ; (in)"), DeviceError, "in inches"),
        (told(M92, M203, M201, ENDS, "M206 X0.00 Y-3.00 Z0.00"), DeviceError, "home offsets"),
        (told(M92, M203, M201, ENDS, "M420 S1 Z0.00"), DeviceError, "bed levelling"),
        (told("M92 X0.00 Y80.00 Z400.00", M203, M201, ENDS), ProtocolError, "M92 is not usable"),
        (told(M203, M201, ENDS), ProtocolError, "M92 is not usable"),
        (told(M92, M201, ENDS), ProtocolError, "M203 is not usable"),
        (told(M92, M203, ENDS), ProtocolError, "M201 is not usable"),
        (told(M92, M203, M201), ProtocolError, "the travel is not reported"),
    ],
)
def test_settings_that_a_stage_can_not_be_driven_with(
    read: Callable[..., Any], error: type[Exception], why: str
) -> None:
    with pytest.raises(error, match=why):
        read(who="stage")
