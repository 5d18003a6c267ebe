"""A rig file's `[emulation]`: what the emulated world is like, and what goes wrong in it. A real rig has no use for it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from bench.addresses import beside_if_named
from bench.config import Section
from bench.emulated.faults import check_wish
from bench.emulated.optics import EmulatedOptical, EmulatedThermal
from bench.emulated.stage import EmulatedStage
from bench.quantities import Point, Positive, Radians
from instruments.operators.emulated import Mistake


class Placed(Section):
    """Where something stands: X_world = R(om) X + T, a rotation vector in rad and mm."""

    om: tuple[Radians, Radians, Radians] = (0.0, 0.0, 0.0)
    T: Point = (0.0, 0.0, 0.0)


class EmulatedFault(Section):
    """Something that goes wrong ``at_s`` after the emulators started, for ``for_s``, or for good where that is left out."""

    instrument: Literal["arm", "bath", "pump", "stage", "cameras"]
    name: str
    at_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    for_s: Positive | None = None
    times: Annotated[int, Field(ge=1)] | None = None
    camera: Literal["left", "right", "thermal"] | None = None
    amount: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _known(self) -> EmulatedFault:
        check_wish(self.instrument, self)
        return self


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
