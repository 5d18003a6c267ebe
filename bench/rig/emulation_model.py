"""A rig file's `[emulation]`: the emulated world, its cameras' sensors and lenses, the stage's
firmware and errors, and faults. What is left out of a sensor is as in `OpticalSensor` and
`ThermalSensor`; the thermal camera's size and form are as in the calibration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from bench.config import Point, Positive, Radians, Section, did_you_mean
from bench.rig.urls import beside_if_named
from instruments.camera import emulator as camera_faults
from instruments.microscribe import faults as arm_faults
from instruments.operators.emulated import Mistake
from instruments.world.scene import Renderer
from instruments.world.sensor import Focus, OpticalSensor
from instruments.world.thermal_camera import Drift, ThermalSensor

_Kelvin = Annotated[float, Field(ge=0, le=20)]
_Pixels = Annotated[float, Field(ge=0, le=20)]
_Share = Annotated[float, Field(ge=0, le=1)]
_Count = Annotated[int, Field(ge=8, le=4096)]

LATE_ANSWER = "late answer"  # of a bath or a relay; its amount is in seconds


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
        focus = Focus(
            said.pop("aperture_mm", Focus().aperture_mm), said.pop("focus_mm", Focus().distance_mm)
        )
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


def make_renderer(
    table: Mapping[str, Any], seed: int, optical: EmulatedOptical, thermal: EmulatedThermal
) -> Renderer:
    """The three cameras of a calibration ``table``. Raises ValueError for a table that is wrong."""
    return Renderer.from_calibration(
        table, seed, optical=optical.sensor(), thermal=thermal.sensor(table)
    )


_Scale = Annotated[float, Field(ge=-0.1, le=0.1)]
_Angle = Annotated[float, Field(ge=-0.2, le=0.2)]
_Setting = Annotated[float, Field(ge=0, le=1e6)]
_Play = Annotated[float, Field(ge=0, le=5)]


class EmulatedStage(Section):
    """``[emulation.stage]``. Axes in the order X Y Z A; an axis that the stage doesn't have moves
    nothing.

    ``settings`` are the controller's, by number without the dollar sign; those that aren't named
    are as `store.DEFAULTS` has them.
    """

    dialect: Literal["grbl", "grblHAL"] = "grbl"
    settings: dict[int, _Setting] = Field(default_factory=dict)
    scale_errors: tuple[_Scale, _Scale, _Scale, _Scale] = (0.0, 0.0, 0.0, 0.0)
    squareness_rad: _Angle = 0.0
    yaw_rad: _Angle = 0.0
    backlash_mm: tuple[_Play, _Play, _Play] = (0.0, 0.0, 0.0)
    backlash_deg: _Play = 0.0

    def fault(self, axes: str) -> str | None:
        """What is wrong with it for a stage of ``axes``, as a sentence; None if nothing."""
        if "A" in axes and self.dialect == "grbl":
            return (
                'the firmware "grbl" has no axis A: set dialect = "grblHAL", or declare [stage]'
                " axes without A"
            )
        if not self.settings:  # a real rig needs no emulator
            return None
        from instruments.stage.emulator.store import CLASSIC, GRBL_HAL, Store

        dialect = GRBL_HAL if self.dialect == "grblHAL" else CLASSIC
        try:
            Store(self.settings, dialect=dialect, axes=4 if "A" in axes else 3)
        except ValueError as error:
            return f"[emulation.stage] settings: {error}"
        return None


class Placed(Section):
    """Where something stands: X_world = R(om) X + T, a rotation vector in rad and mm."""

    om: tuple[Radians, Radians, Radians] = (0.0, 0.0, 0.0)
    T: Point = (0.0, 0.0, 0.0)


class EmulatedFault(Section):
    """Something that goes wrong ``at_s`` after the emulators started, for ``for_s``, or for good
    where that is left out.
    """

    instrument: Literal["arm", "bath", "pump", "stage", "cameras"]
    name: str
    at_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    for_s: Positive | None = None
    times: Annotated[int, Field(ge=1)] | None = None
    camera: Literal["left", "right", "thermal"] | None = None
    amount: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _known(self) -> EmulatedFault:
        instrument, known = self.instrument, fault_names(self.instrument)
        if self.name not in known:
            has = "have" if instrument == "cameras" else "has"
            raise ValueError(
                f'the {instrument} {has} no fault "{self.name}"{did_you_mean(self.name, known)}'
                f" (there are: {', '.join(known)})"
            )
        if self.times is not None and instrument not in ("arm", "cameras"):
            raise ValueError(
                f'"times" is for faults of the arm and the cameras; one of the {instrument} lasts'
                " until for_s have passed"
            )
        if self.camera is not None and instrument != "cameras":
            raise ValueError(f'"camera" is for faults of the cameras, the {instrument} has none')
        if instrument == "arm":
            arm_faults.check_amount(arm_faults.named(self.name), self.amount)
        elif instrument == "cameras":
            camera_faults.check_amount(camera_faults.named(self.name), self.amount)
            camera_faults.check_camera(camera_faults.named(self.name), self.camera)
        elif instrument == "stage":
            from instruments.stage.emulator.board import AMOUNTS, Fault

            if self.amount is not None and Fault(self.name) not in AMOUNTS:
                having = ", ".join(f'"{fault.value}" ({unit})' for fault, unit in AMOUNTS.items())
                raise ValueError(
                    f'the stage\'s fault "{self.name}" has no amount; one have {having}'
                )
        elif self.amount is not None and self.name != LATE_ANSWER:
            raise ValueError(
                f'of the {instrument}\'s faults only "{LATE_ANSWER}" has an amount, in seconds'
            )
        return self


def fault_names(instrument: str) -> tuple[str, ...]:
    """What can go wrong with the emulated "arm", "bath", "pump" (its relay), "cameras" or "stage";
    a real rig needs no emulator.
    """
    if instrument == "arm":
        return tuple(arm_faults.Fault)
    if instrument == "cameras":
        return tuple(camera_faults.FAULTS)
    if instrument == "bath":
        from instruments.bath.emulator import FAULTS

        return tuple(FAULTS)
    if instrument == "pump":
        from instruments.bath.emulator import RELAY_FAULTS

        return RELAY_FAULTS
    from instruments.stage.emulator.board import Fault

    return tuple(fault.value for fault in Fault)


class Emulation(Section):
    """What the emulated world is like; a real rig has no use for it."""

    ambient_c: Annotated[float, Field(ge=-10, le=40)] = 20.0
    bath_start_c: Annotated[float, Field(ge=0, le=40)] = 20.0
    arm_accuracy_mm: Annotated[float, Field(ge=0, le=5)] = 0.23
    hand_tremor_mm: Annotated[float, Field(ge=0, le=5)] = 0.05
    hand_error_mm: Annotated[float, Field(ge=0, le=10)] = 0.1
    placement_error_mm: Annotated[float, Field(ge=0, le=20)] = 0.0
    placement_error_deg: Annotated[float, Field(ge=0, le=20)] = 0.0
    prompt_s: Annotated[float, Field(ge=0, le=3600)] = 0.0
    mistakes: tuple[Mistake, ...] = ()
    arm_placed: Placed = Placed()
    arm_unit: Annotated[str, AfterValidator(beside_if_named)] = ""
    optical: EmulatedOptical = EmulatedOptical()
    thermal: EmulatedThermal = EmulatedThermal()
    stage: EmulatedStage = EmulatedStage()
    faults: tuple[EmulatedFault, ...] = ()
