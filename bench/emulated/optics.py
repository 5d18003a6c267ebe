"""What a rig file says of the emulated cameras' sensors and lenses. Values only; a real rig has no use for them.

What is left out is as in `OpticalSensor` and `ThermalSensor`, and the thermal camera's size and form as in the calibration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

from pydantic import Field

from bench.config import Section
from instruments.world.blur import Focus
from instruments.world.microbolometer import Drift, ThermalSensor
from instruments.world.scene import Renderer
from instruments.world.sensor import OpticalSensor

_Kelvin = Annotated[float, Field(ge=0, le=20)]
_Pixels = Annotated[float, Field(ge=0, le=20)]
_Share = Annotated[float, Field(ge=0, le=1)]
_Count = Annotated[int, Field(ge=8, le=4096)]


class EmulatedOptical(Section):
    """``[emulation.optical]``: both optical cameras."""

    full_well_e: Annotated[float, Field(ge=100, le=1e6)] | None = None
    read_noise_e: Annotated[float, Field(ge=0, le=1e4)] | None = None
    dark_e_per_s: Annotated[float, Field(ge=0, le=1e6)] | None = None
    offset_dn: Annotated[float, Field(ge=0, le=255)] | None = None
    prnu: _Share | None = None
    dsnu_e: Annotated[float, Field(ge=0, le=1e4)] | None = None
    blur_px: _Pixels | None = None
    vignetting: _Share | None = None
    aperture_mm: Annotated[float, Field(ge=0, le=50)] | None = None
    focus_mm: Annotated[float, Field(ge=50, le=1e6)] | None = None

    def sensor(self) -> OpticalSensor:
        """The sensor with its lens."""
        said = self.model_dump(exclude_none=True)
        focus = Focus(said.pop("aperture_mm", Focus().aperture_mm), said.pop("focus_mm", Focus().distance_mm))
        return replace(OpticalSensor(), focus=focus, **said)


class EmulatedThermal(Section):
    """``[emulation.thermal]``: the thermal camera."""

    sensor_size: tuple[_Count, _Count] | None = None
    netd_k: _Kelvin | None = None
    row_flicker_k: _Kelvin | None = None
    column_flicker_k: _Kelvin | None = None
    level_flicker_k: _Kelvin | None = None
    fixed_k: _Kelvin | None = None
    row_k: _Kelvin | None = None
    column_k: _Kelvin | None = None
    time_constant_s: Annotated[float, Field(ge=0, le=1)] | None = None
    blur_px: _Pixels | None = None
    drift_level_k_per_min: _Kelvin | None = None
    drift_pattern_k_per_min: _Kelvin | None = None
    flat_field_every_s: Annotated[float, Field(gt=0)] | None = None
    flat_field_lasts_s: Annotated[float, Field(ge=0, le=10)] | None = None

    def sensor(self, table: Mapping[str, Any]) -> ThermalSensor:
        """The sensor, delivered as the calibration ``table`` says."""
        said = self.model_dump(exclude_none=True)
        usual = Drift()
        drift = Drift(
            said.pop("drift_level_k_per_min", usual.level_k_per_min),
            said.pop("drift_pattern_k_per_min", usual.pattern_k_per_min),
            said.pop("flat_field_every_s", usual.every_s),
            said.pop("flat_field_lasts_s", usual.lasts_s),
        )
        size = said.pop("sensor_size", None)
        sensor = replace(ThermalSensor.from_calibration(table), drift=drift, **said)
        return sensor if size is None else replace(sensor, width_px=size[0], height_px=size[1])


def make_renderer(table: Mapping[str, Any], seed: int, optical: EmulatedOptical, thermal: EmulatedThermal) -> Renderer:
    """The three cameras of a calibration ``table``. Raises ValueError for a table that is wrong."""
    return Renderer.from_calibration(table, seed, optical=optical.sensor(), thermal=thermal.sensor(table))
