"""The tables of a rig file: what may stand in them, and what is wrong where it can't be. Values
only; reads no other file.
"""

from __future__ import annotations

import math
from datetime import date
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from bench.config import Millimetres, Point, Positive, Section, did_you_mean
from bench.rig.camera_model import Cameras
from bench.rig.emulation_model import Emulation
from bench.rig.urls import (
    ELSEWHERE,
    EMULATED,
    bath_url,
    beside,
    beside_if_named,
    operator_url,
    relay_url,
    serial_url,
)
from instruments.bath.profile import profile_names, relay_names
from instruments.world.phantom import PlatePose


class Arm(Section):
    url: Annotated[str, AfterValidator(serial_url)]
    baud: Literal[9600, 14400, 19200, 28800, 38400, 57600, 115200] = 115200
    answer_s: Annotated[float, Field(ge=0.05, le=60)] = 0.12
    accuracy_mm: Positive = 0.23
    packets: Annotated[int, Field(ge=2, le=1000)] = 8
    max_spread_mm: Positive = 1.0
    touches: Annotated[int, Field(ge=1, le=100)] = 3
    definition_mm: Positive = 0.1
    tip_radius_mm: Annotated[float, Field(ge=0, le=20)] = 0.0
    tip_radius_u_mm: Annotated[float, Field(ge=0, le=5)] = 0.01
    axis_u_rad: Annotated[float, Field(ge=0, le=0.5)] = 0.02
    frame: Annotated[str, AfterValidator(beside_if_named)] = ""
    verification: Annotated[str, AfterValidator(beside_if_named)] = ""
    check_point_mm: Point | None = None
    check_touches: Annotated[int, Field(ge=2, le=100)] = 5


def _relay_profile(name: str, info: ValidationInfo) -> str:
    known = relay_names()
    if not name or name in known:
        return name
    if not name.endswith(".toml"):
        raise ValueError(
            f"no such profile{did_you_mean(name, known)} (shipped: {', '.join(known)}; or a path"
            " that ends in .toml)"
        )
    return beside(name, info)


def _day_or_none(text: str) -> str:
    try:
        return date.fromisoformat(text).isoformat() if text else ""
    except ValueError:
        raise ValueError('no such day; write it as "2026-11-20"') from None


class Bath(Section):
    url: Annotated[str, AfterValidator(bath_url)]
    profile: str
    allow_inferred: bool = False
    pump_url: Annotated[str, AfterValidator(relay_url)] = ""
    pump_profile: Annotated[str, AfterValidator(_relay_profile)] = ""
    accuracy_k: Positive = 0.1
    external_accuracy_k: Positive = 0.1
    room_c: Annotated[float, Field(ge=-10, le=40)] = 20.0
    cut_out_tested: Annotated[str, AfterValidator(_day_or_none)] = ""

    @field_validator("profile")
    @classmethod
    def _known(cls, name: str) -> str:
        known = profile_names()
        if name not in known and not name.endswith(".toml"):
            raise ValueError(
                f"no such profile{did_you_mean(name, known)} (shipped: {', '.join(known)}; or a"
                " path that ends in .toml)"
            )
        return name


class Stage(Section):
    url: Annotated[str, AfterValidator(serial_url)]
    baud: Literal[9600, 19200, 38400, 57600, 115200] = 115200
    axes: Literal["XY", "XYZ", "XYA", "XYZA"] = "XY"
    reference_mm: tuple[Millimetres, Millimetres] = (-150.0, -137.5)
    reference_z_mm: Millimetres = -50.0
    reference_a_deg: Millimetres = -180.0
    feed_mm_per_min: Positive = 1500.0
    scale_u: Annotated[float, Field(ge=0, le=0.1)] = 5e-4
    squareness_u_rad: Annotated[float, Field(ge=0, le=0.1)] = 5e-4
    repeatability_mm: Annotated[float, Field(ge=0, le=10)] = 0.02

    def machine(self, pose: PlatePose) -> dict[str, float]:
        """Where the stage's axes are when the plate stands at ``pose``: arguments of
        `Stage.move_to`, of the axes that there are.
        """
        x, y = self.reference_mm
        there = {"x_mm": x + pose.x_mm, "y_mm": y + pose.y_mm}
        more = {
            "Z": ("z_mm", self.reference_z_mm + pose.z_mm),
            "A": ("a_deg", self.reference_a_deg + math.degrees(pose.yaw_rad)),
        }
        return there | dict(more[axis] for axis in self.axes[2:])


class Operator(Section):
    url: Annotated[str, AfterValidator(operator_url)]
    remind_s: Positive = 120.0


class Limits(Section):
    set_point_c: tuple[float, float] = (20.0, 36.0)
    bath_max_c: Annotated[float, Field(le=40.0)] = 37.0
    bath_plausible_c: tuple[float, float] = (-5.0, 60.0)
    bath_rate_k_per_min: Positive = 4.0
    bath_silence_s: Positive = 5.0
    sensors_differ_k: Positive = 2.0
    detection_timeout_s: Positive = 30.0
    # how long an instrument that dropped out is waited for; 0: not at all
    away_s: Annotated[float, Field(ge=0, le=86400)] = 600.0

    @field_validator("set_point_c", "bath_plausible_c")
    @classmethod
    def _ordered(cls, span: tuple[float, float]) -> tuple[float, float]:
        if span[0] >= span[1]:
            raise ValueError("the first number must be the smaller one")
        return span

    @model_validator(mode="after")
    def _headroom(self) -> Limits:
        if self.set_point_c[1] >= self.bath_max_c:
            raise ValueError(
                f"set_point_c allows {self.set_point_c[1]:g} degC, which bath_max_c ="
                f" {self.bath_max_c:g} would trip on"
            )
        return self


class Rig(Section):
    name: str
    seed: Annotated[int, Field(ge=0)] = 1
    calibration: Annotated[str, Field(min_length=1)]  # the file may still have to be made
    operator: Operator
    arm: Arm
    bath: Bath
    stage: Stage | None = None
    cameras: Cameras
    limits: Limits = Limits()
    emulation: Emulation = Emulation()

    @property
    def urls(self) -> dict[str, str]:
        """Each instrument's URL by its name."""
        stage = {"stage": self.stage.url} if self.stage else {}
        return {
            "arm": self.arm.url,
            "bath": self.bath.url,
            **stage,
            "cameras": self.cameras.told,
            "operator": self.operator.url,
        }

    @property
    def emulated(self) -> tuple[str, ...]:
        """Names of the instruments that are emulated in this process."""
        return tuple(name for name, url in self.urls.items() if url == EMULATED)

    @property
    def all_emulated(self) -> bool:
        """Whether no instrument is real: their emulators are of this process, or of another."""
        return bool(self.emulated) or self.operator.url.startswith(ELSEWHERE)
