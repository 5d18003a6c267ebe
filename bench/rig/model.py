"""The tables of a rig file, with their checks. Values only; reads no other file.

What `[emulation]` leaves out of a sensor is as in `OpticalSensor` and `ThermalSensor`; the thermal
camera's size and form are as in the calibration.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import date
from typing import Annotated, Any, Literal
from urllib.parse import urlencode, urlsplit

from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from bench.config import FileTable, Millimetres, Point, Positive, Radians, did_you_mean
from bench.rig.urls import (
    ELSEWHERE,
    EMULATED,
    PEOPLE,
    a_name,
    arm_url,
    bath_url,
    beside,
    beside_if_named,
    is_emulated,
    operator_url,
    plugged,
    relay_url,
    stage_url,
)
from instruments.bath.connection import is_loopback, parse_line
from instruments.bath.profile import profile_names, relay_names
from instruments.camera import emulator as camera_faults
from instruments.camera.frame import Channel, Conversion, Flip, Radiometry, Ranging, Turn
from instruments.camera.radiometric import PROFILES, RadiometricProfile
from instruments.camera.settings import Settings, Trigger, Value
from instruments.drivers.entry_points import plugin_url
from instruments.faults import Amounts, check_fault
from instruments.microscribe import faults as arm_faults
from instruments.operators.emulated import Mistake
from instruments.points import points_url
from instruments.world.depth_camera import DepthSensor
from instruments.world.phantom import PlatePose
from instruments.world.scene import Renderer
from instruments.world.sensor import Focus, OpticalSensor
from instruments.world.thermal_camera import Drift, ThermalSensor

# 0.105 mm rms in space over random poses (the arm's fact sheet), along one axis
ROUNDING_MM = 0.105 / math.sqrt(3.0)
Baud = Literal[9600, 14400, 19200, 28800, 38400, 57600, 115200]


class ArmTable(FileTable):
    url: Annotated[str, AfterValidator(arm_url)]
    baud: Baud = 115200
    answer_s: Annotated[float, Field(ge=0.05, le=60)] = 0.12
    accuracy_mm: Positive = 0.23
    accuracy_source: Annotated[str, Field(max_length=200)] = ""
    accuracy_df: Annotated[float, Field(ge=3, le=1e6)] | None = None
    packets: Annotated[int, Field(ge=2, le=1000)] = 8
    max_spread_mm: Positive = 1.0
    resolution_mm: Positive = 0.01
    touches: Annotated[int, Field(ge=1, le=100)] = 3
    definition_mm: Positive = 0.1
    tip_radius_mm: Annotated[float, Field(ge=0, le=20)] = 0.0
    tip_radius_u_mm: Annotated[float, Field(ge=0, le=5)] = 0.01
    axis_u_rad: Annotated[float, Field(ge=0, le=0.5)] = 0.02
    frame: Annotated[str, AfterValidator(beside_if_named)] = ""
    verification: Annotated[str, AfterValidator(beside_if_named)] = ""
    check_point_mm: Point | None = None
    check_touches: Annotated[int, Field(ge=2, le=100)] = 5

    @model_validator(mode="after")
    def _stated(self) -> ArmTable:
        if points_url(self.url) and not {"accuracy_mm", "accuracy_source"} <= self.model_fields_set:
            raise ValueError(
                "accuracy_mm and accuracy_source are needed: the standard uncertainty of a point of"
                " this arm, and where that figure is from"
            )
        return self

    @property
    def rounding_mm(self) -> float:
        """Standard uncertainty along an axis of encoder counts, or of the last digit written."""
        return self.resolution_mm / math.sqrt(12.0) if points_url(self.url) else ROUNDING_MM

    @property
    def rounding_source(self) -> str:
        if points_url(self.url):
            return f"points are written to {self.resolution_mm:g} mm (rig file), over √12"
        return "rounding of the arm's encoder counts, rms over its reach"

    @property
    def u_mm(self) -> float:
        """Standard uncertainty of a position along an axis, widened by Student's t of its degrees
        of freedom (JCGM 101:2008, 6.4.9.4).
        """
        df = self.accuracy_df
        return self.accuracy_mm * (math.sqrt(df / (df - 2.0)) if df else 1.0)


def _profile(names: Callable[[], list[str]], *, needed: bool) -> AfterValidator:
    """A shipped profile's name, or a file beside the rig file; "" where none is ``needed``."""

    def check(name: str, info: ValidationInfo) -> str:
        known = names()
        if name.endswith(".toml"):
            return beside(name, info)
        if name not in known and (name or needed):
            raise ValueError(
                f"no such profile{did_you_mean(name, known)} (shipped: {', '.join(known)}; or a"
                " path that ends in .toml)"
            )
        return name

    return AfterValidator(check)


def _day_or_none(text: str) -> str:
    try:
        return date.fromisoformat(text).isoformat() if text else ""
    except ValueError:
        raise ValueError('no such day; write it as "2026-11-20"') from None


class BathTable(FileTable):
    url: Annotated[str, AfterValidator(bath_url)]
    profile: Annotated[str, _profile(profile_names, needed=False)] = ""
    allow_inferred: bool = False
    pump_url: Annotated[str, AfterValidator(relay_url)] = ""
    pump_profile: Annotated[str, _profile(relay_names, needed=False)] = ""
    accuracy_k: Positive = 0.1
    external_accuracy_k: Positive = 0.1
    room_c: Annotated[float, Field(ge=-10, le=40)] = 20.0
    cut_out_tested: Annotated[str, AfterValidator(_day_or_none)] = ""
    unit_confirmed: Annotated[str, AfterValidator(_day_or_none)] = ""

    @model_validator(mode="after")
    def _known(self) -> BathTable:
        plugged = plugin_url(self.url) is not None
        if plugged == bool(self.profile):
            raise ValueError(
                "a plug-in says itself what its bath is: leave profile out"
                if plugged
                else f"profile is missing: which controller it is ({', '.join(profile_names())})"
            )
        return self


class StageTable(FileTable):
    url: Annotated[str, AfterValidator(stage_url)]
    baud: Literal[9600, 19200, 38400, 57600, 115200, 250000] = 115200
    dialect: Literal["grbl", "marlin"] = "grbl"
    axes: Literal["XY", "XYZ", "XYA", "XYZA"] = "XY"
    reference_mm: tuple[Millimetres, Millimetres] = (-150.0, -137.5)
    reference_z_mm: Millimetres = -50.0
    reference_a_deg: Millimetres = -180.0
    feed_mm_per_min: Positive = 1500.0
    scale_u: Annotated[float, Field(ge=0, le=0.1)] = 5e-4
    squareness_u_rad: Annotated[float, Field(ge=0, le=0.1)] = 5e-4
    repeatability_mm: Annotated[float, Field(ge=0, le=10)] = 0.02

    @model_validator(mode="before")
    @classmethod
    def _zaber_is_a_plugin(cls, table: Any) -> Any:
        """``dialect = "zaber"`` with its two keys, as rig files had it, is that plug-in's URL."""
        if not isinstance(table, dict):
            return table
        # what comes from here is no JSON any more, in which a list is a tuple
        kept = {key: tuple(one) if isinstance(one, list) else one for key, one in table.items()}
        if kept.get("dialect") != "zaber":
            return kept
        del kept["dialect"]
        axes, emulated = str(table.get("axes", "XY")), table.get("url") == EMULATED
        devices = kept.pop("zaber_axes", ()) or [1 + "XYZA".find(axis) for axis in axes]
        usual = [100 if axis == "A" else 250 for axis in axes] if emulated else []
        microsteps = kept.pop("microsteps", ()) or usual
        if not len(devices) == len(microsteps) == len(axes):
            raise ValueError(
                f"a Zaber stage {axes} needs {len(axes)} devices and {len(axes)} microsteps"
            )
        keys = {
            "devices": ",".join(str(one).replace(" ", ".") for one in devices),
            "microsteps": ",".join(map(str, microsteps)),
            "axes": axes,
        }
        if not emulated:
            keys |= {"url": str(table.get("url")), "baud": str(table.get("baud", 115200))}
        place = "emulator" if emulated else "plugin"
        return kept | {"url": f"{place}:zaber?{urlencode(keys, safe=',:/')}"}

    @model_validator(mode="after")
    def _can_turn(self) -> StageTable:
        if self.dialect == "marlin" and "A" in self.axes:
            raise ValueError(
                'a Marlin stage is driven in X, Y and Z only; declare axes without "A"'
            )
        return self

    def machine(self, pose: PlatePose) -> dict[str, float]:
        """The axes' places for the plate at ``pose``: arguments of `Stage.move_to`."""
        x, y = self.reference_mm
        there = {"x_mm": x + pose.x_mm, "y_mm": y + pose.y_mm}
        there |= {"z_mm": self.reference_z_mm + pose.z_mm} if "Z" in self.axes else {}
        a_deg = self.reference_a_deg + math.degrees(pose.yaw_rad)
        return there | ({"a_deg": a_deg} if "A" in self.axes else {})


Share = Annotated[float, Field(gt=0, le=1)]
Setting = Literal["resolution", "pixel_format", "exposure", "gain", "fps"]
GENICAM_ONLY = ("features", "trigger", "trigger_source", "ptp")


def _all_url(url: str) -> str:
    ours = url in ("", "emulator:") or re.match(r"(opencv|recording):\S+", url)
    if ours or plugged(url, "camera"):
        return url
    raise ValueError(
        'not a camera; allowed: "emulator:", "opencv:LEFT,RIGHT,THERMAL" (device numbers, files or'
        ' streams), "recording:FOLDER", or a table for each camera: [cameras.left],'
        " [cameras.right], [cameras.thermal]"
    )


def camera_url(url: str) -> str:
    """``url`` where it is one camera's. Raises ValueError that says what is allowed."""
    if re.match(r"(opencv|files):\S", url) or re.match(r"genicam:", url):
        return url
    if plugged(url, "camera"):
        return url
    raise ValueError(
        'not a camera; allowed: "opencv:0" (a device number, a file, "http://…" or "rtsp://…"'
        ' behind it), "files:PLACE" (a folder of PNG or TIFF, or frames/*.tiff), "genicam:NAME"'
        " (as `teatbench camera list` prints it, a serial number or an address)"
    )


class OneCamera(FileTable):
    """One camera: where it is, what it is set to, and how its frames stand."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    url: Annotated[str, AfterValidator(camera_url)]
    resolution: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]] | None = None
    pixel_format: str | None = None
    exposure: Positive | None = None
    gain: Annotated[float, Field(allow_inf_nan=False)] | None = None
    fps: Positive | None = None
    trigger: Trigger = "free"
    trigger_source: str = "Line0"
    features: dict[str, Value] = Field(default_factory=dict)
    tries: Annotated[bool | tuple[str, ...], Field(alias="try")] = False
    grey: Channel = "luma"
    mirrored: bool | None = None
    turn_deg: Turn = 0
    flip: Flip = "none"
    white: Annotated[int, Field(gt=0, le=65535)] | None = None
    auto: bool = False
    ptp: bool = False

    @field_validator("tries")
    @classmethod
    def _known(cls, tries: bool | tuple[str, ...], info: ValidationInfo) -> bool | tuple[str, ...]:
        known = {*Setting.__args__, *info.data.get("features", {})}  # type: ignore[attr-defined]
        wrong = [name for name in tries if name not in known] if isinstance(tries, tuple) else []
        if wrong:
            raise ValueError(
                f'"{wrong[0]}" is no setting; try = true tries all, or name some of'
                f" {', '.join(sorted(known))}"
            )
        return tries

    @model_validator(mode="after")
    def _fits(self) -> OneCamera:
        usual = OneCamera.model_construct(url="")
        given = [name for name in GENICAM_ONLY if getattr(self, name) != getattr(usual, name)]
        if given and not self.url.startswith("genicam:"):
            raise ValueError(
                f'{given[0]} is for cameras of the kind "genicam:", this one is {self.url}'
            )
        return self

    @property
    def settings(self) -> Settings:
        tries = frozenset({"all"} if self.tries is True else self.tries or ())
        asked = {name: getattr(self, name) for name in (*Setting.__args__, *GENICAM_ONLY)}  # type: ignore[attr-defined]
        return Settings(**asked, tries=tries, auto=self.auto)

    def conversion(self) -> Conversion:
        return Conversion(self.grey, bool(self.mirrored), self.turn_deg, self.flip, self.white)


def _profile_of(name: str) -> str:
    if name and name not in PROFILES:
        shipped = ", ".join(PROFILES)
        raise ValueError(f"no such profile{did_you_mean(name, [*PROFILES])} (shipped: {shipped})")
    return name


class RadiometricTable(FileTable):
    """What a count is: by a ``profile`` of a make, or by its own figures."""

    profile: Annotated[str, AfterValidator(_profile_of)] = ""
    kelvin_per_count: Positive | None = None
    kelvin_at_zero: Annotated[float, Field(ge=-300, le=1000)] = 0.0

    @model_validator(mode="after")
    def _one_way(self) -> RadiometricTable:
        if bool(self.profile) == (self.kelvin_per_count is not None):
            raise ValueError("either profile or kelvin_per_count says what a count is")
        return self

    @property
    def known(self) -> RadiometricProfile | None:
        return PROFILES.get(self.profile)

    @property
    def radiometry(self) -> Radiometry:
        if known := self.known:
            return Radiometry(known.kelvin_per_count)
        return Radiometry(self.kelvin_per_count or 0.0, self.kelvin_at_zero)


class ThermalTable(OneCamera):
    """The thermal camera: 8-bit as it delivers it, or with ``radiometric`` temperatures."""

    polarity: Literal["hot_is_black", "hot_is_white"] | None = None
    radiometric: RadiometricTable | None = None
    shutter: bool | str = False
    shutter_s: Annotated[float, Field(ge=0, le=60)] = 1.0

    @model_validator(mode="after")
    def _shutter_known(self) -> ThermalTable:
        if self.shutter and not self.url.startswith("genicam:"):
            raise ValueError(
                f'shutter is for cameras of the kind "genicam:", this one is {self.url}'
            )
        known = self.radiometric.known if self.radiometric else None
        if self.shutter is True and not (known and known.shutter):
            raise ValueError(
                "shutter = true needs a radiometric profile that knows the command; or shutter ="
                ' "NUCAction", its name'
            )
        return self

    @property
    def settings(self) -> Settings:
        asked, known = super().settings, self.radiometric.known if self.radiometric else None
        shutter = known.shutter if known and self.shutter is True else str(self.shutter or "")
        asked = replace(asked, shutter=shutter, shutter_s=self.shutter_s)
        if self.radiometric is None or self.url.startswith("files:"):
            return asked
        asked = replace(asked, counts=True)
        if known is None:
            return asked
        features = known.features if self.url.startswith("genicam:") else {}
        return replace(
            asked,
            pixel_format=asked.pixel_format or known.pixel_format,
            features={**features, **asked.features},
        )

    def calibrated(self, *, mirrored: bool, hot_is_black: bool) -> Conversion:
        """To the calibration's picture, or to temperatures, which are never mirrored."""
        comes_mirrored = mirrored if self.mirrored is None else self.mirrored
        comes_black = hot_is_black if self.polarity is None else self.polarity == "hot_is_black"
        r = self.radiometric
        return replace(
            self.conversion(),
            mirrored=comes_mirrored != (mirrored and r is None),
            inverted=comes_black != hot_is_black,
            radiometry=r.radiometry if r else None,
        )


class DepthTable(OneCamera):
    """The depth camera: its counts are distances along its axis, as it says or as declared here."""

    mm_per_count: Positive | None = None
    mm_at_zero: Annotated[float, Field(ge=-1e4, le=1e4)] = 0.0
    no_measurement: Annotated[int, Field(ge=0, le=65535)] = 0

    @model_validator(mode="after")
    def _deep(self) -> DepthTable:
        if self.url.startswith("opencv:"):
            raise ValueError(
                'a depth camera is of the kind "genicam:" or "files:"; OpenCV\'s devices deliver'
                f" pictures, this one is {self.url}"
            )
        return self

    @property
    def settings(self) -> Settings:
        return replace(super().settings, depth=True)

    def conversion(self) -> Conversion:
        """Files without a declared unit are in tenths of a millimetre, as in a recording."""
        mm = self.mm_per_count or (0.1 if self.url.startswith("files:") else None)
        ranging = Ranging(mm, self.mm_at_zero, self.no_measurement) if mm else None
        return replace(super().conversion(), ranging=ranging)


class FocusTable(FileTable):
    """Edge blur in px of each camera when it was in focus; `teatbench camera focus` measures it."""

    left: Positive | None = None
    right: Positive | None = None
    thermal: Positive | None = None


class Checks(FileTable):
    """What a frame set must pass before it is measured with. Levels are 0 to 255."""

    frozen: bool = True
    swapped: bool = True
    black_dn: Annotated[int, Field(ge=0, le=255)] = 12
    saturated_share: Share = 0.25
    missing_rows_share: Share = 0.02
    flat_k: Annotated[float, Field(ge=0, le=50)] = 1.5
    flat_dn: Annotated[int, Field(ge=0, le=255)] = 24
    focus_px: FocusTable = FocusTable()
    focus_times: Annotated[float, Field(gt=1, le=20)] = 2.5


class CamerasTable(FileTable):
    url: Annotated[str, AfterValidator(_all_url)] = ""
    left: OneCamera | None = None
    right: OneCamera | None = None
    thermal: ThermalTable | None = None
    depth: DepthTable | None = None
    settle_s: Annotated[float, Field(ge=0, le=600)] = 1.0
    max_skew_s: Positive = 0.05
    retries: Annotated[int, Field(ge=0, le=100)] = 3
    retry_s: Annotated[float, Field(ge=0, le=60)] = 0.5
    checks: Checks = Checks()

    @model_validator(mode="after")
    def _one_way(self) -> CamerasTable:
        tables = [*self.tables]
        if plugin_url(self.url):  # one device may give some of them
            return self
        if self.url and tables:
            raise ValueError(
                "either url for all cameras or a table for each, not both (here: url and"
                f" [cameras.{tables[0]}])"
            )
        missing = [name for name in ("left", "right") if name not in tables]
        if not self.url and missing:
            raise ValueError(f"no url for all cameras, and no [cameras.{missing[0]}]")
        return self

    @property
    def tables(self) -> dict[str, OneCamera]:
        names = ("left", "right", "thermal", "depth")
        return {name: table for name in names if (table := getattr(self, name))}

    @property
    def recorded(self) -> bool:
        """Whether frames are played, each once: they can't be taken again."""
        return any(
            url.startswith(("recording:", "files:"))
            for url in (self.url, *(table.url for table in self.tables.values()))
        )

    @property
    def note(self) -> str:
        return self.url or ", ".join(f"{name} {table.url}" for name, table in self.tables.items())


class OperatorTable(FileTable):
    url: Annotated[str, AfterValidator(operator_url)]
    remind_s: Positive = 120.0


class SafetyLimits(FileTable):
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
    def _headroom(self) -> SafetyLimits:
        if self.set_point_c[1] >= self.bath_max_c:
            raise ValueError(
                f"set_point_c allows {self.set_point_c[1]:g} degC, which bath_max_c ="
                f" {self.bath_max_c:g} would trip on"
            )
        return self


_Kelvin = Annotated[float, Field(ge=0, le=20)]
_Pixels = Annotated[float, Field(ge=0, le=20)]
_Share = Annotated[float, Field(ge=0, le=1)]
_Count = Annotated[int, Field(ge=8, le=4096)]


class EmulatedOptical(FileTable):
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
        said, usual = self.model_dump(exclude_none=True), Focus()
        aperture_mm = said.pop("aperture_mm", usual.aperture_mm)
        focus = Focus(aperture_mm, said.pop("focus_mm", usual.distance_mm))
        return replace(OpticalSensor(), focus=focus, **said)


class EmulatedThermal(FileTable):
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


class EmulatedDepth(FileTable):
    """``[emulation.depth]``: a depth camera; it is there where the calibration has its lens."""

    modulation_mhz: Annotated[float, Field(gt=0, le=1000)] | None = None
    noise_mm: Annotated[float, Field(ge=0, le=100)] | None = None
    offset_mm: Annotated[float, Field(ge=-1000, le=1000)] | None = None
    cyclic_mm: Annotated[float, Field(ge=0, le=100)] | None = None
    second_path: Annotated[float, Field(ge=0, le=10)] | None = None
    blur_px: _Pixels | None = None
    least_amplitude: _Share | None = None

    def sensor(self) -> DepthSensor:
        return DepthSensor(**self.model_dump(exclude_none=True))


def make_renderer(
    table: Mapping[str, Any],
    seed: int,
    optical: EmulatedOptical,
    thermal: EmulatedThermal,
    depth: EmulatedDepth,
) -> Renderer:
    """The cameras of a calibration ``table``. Raises ValueError for a table that is wrong."""
    return Renderer.from_calibration(
        table, seed, optical=optical.sensor(), thermal=thermal.sensor(table), depth=depth.sensor()
    )


_Scale = Annotated[float, Field(ge=-0.1, le=0.1)]
_Angle = Annotated[float, Field(ge=-0.2, le=0.2)]
_Setting = Annotated[float, Field(ge=0, le=1e6)]
_Play = Annotated[float, Field(ge=0, le=5)]


class EmulatedStage(FileTable):
    """``settings`` by Grbl's number; ``high_mm``: high ends of a Marlin's or FluidNC's axes."""

    dialect: Literal["grbl", "grblHAL", "FluidNC"] = "grbl"
    high_mm: tuple[Millimetres, Millimetres, Millimetres, Millimetres] | None = None
    settings: dict[int, _Setting] = Field(default_factory=dict)
    scale_errors: tuple[_Scale, _Scale, _Scale, _Scale] = (0.0, 0.0, 0.0, 0.0)
    squareness_rad: _Angle = 0.0
    yaw_rad: _Angle = 0.0
    backlash_mm: tuple[_Play, _Play, _Play] = (0.0, 0.0, 0.0)
    backlash_deg: _Play = 0.0

    def firmware(self, stage: StageTable) -> str:
        if stage.dialect != "grbl":
            return stage.dialect.capitalize()
        return "Grbl" if self.dialect == "grbl" else self.dialect

    def fault(self, stage: StageTable) -> str | None:
        """What is wrong with it for ``stage``, as a sentence; None if nothing."""
        firmware = self.firmware(stage)
        if "A" in stage.axes and firmware == "Grbl":
            return (
                'the firmware "grbl" has no axis A: set dialect = "grblHAL", or declare [stage]'
                " axes without A"
            )
        if not self.settings:  # a real rig needs no emulator
            return None
        from instruments.stage.emulator.store import EMULATED as DIALECTS
        from instruments.stage.emulator.store import Store

        axes = 4 if "A" in stage.axes else 3
        try:
            Store(self.settings, dialect=DIALECTS[firmware], axes=axes)
        except ValueError as error:
            return f"[emulation.stage] settings: {error}"
        return None


def usual_stage() -> dict[int, float]:
    """The emulated stage's settings where a rig file says nothing, by Grbl's number."""
    from instruments.stage.emulator.store import DEFAULTS, ROTARY_DEFAULTS

    return DEFAULTS | ROTARY_DEFAULTS


class Placement(FileTable):
    """Where something stands: X_world = R(om) X + T, a rotation vector in rad and mm."""

    om: tuple[Radians, Radians, Radians] = (0.0, 0.0, 0.0)
    T: Point = (0.0, 0.0, 0.0)


class EmulatedFault(FileTable):
    """A fault from ``at_s`` after the start, for ``for_s``; for good where that is left out."""

    instrument: Literal["arm", "bath", "pump", "stage", "cameras"]
    name: str
    at_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    for_s: Positive | None = None
    times: Annotated[int, Field(ge=1)] | None = None
    camera: Literal["left", "right", "thermal"] | None = None
    amount: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _known(self) -> EmulatedFault:
        instrument, (known, amounts) = self.instrument, emulated_faults(self.instrument)
        whose = f"the {instrument} {'have' if instrument == 'cameras' else 'has'}"
        near = did_you_mean(self.name, known)
        check_fault(whose, self.name, known, amounts, self.amount, near)
        if self.times is not None and instrument not in ("arm", "cameras"):
            raise ValueError(
                f'"times" is for faults of the arm and the cameras; one of the {instrument} lasts'
                " until for_s have passed"
            )
        if self.camera is not None and instrument != "cameras":
            raise ValueError(f'"camera" is for faults of the cameras, the {instrument} has none')
        if self.name == camera_faults.THERMAL_ALONE and self.camera not in (None, "thermal"):
            raise ValueError(f'only the thermal camera has a "{self.name}"')
        return self


def emulated_faults(instrument: str) -> tuple[tuple[str, ...], Amounts]:
    """The faults of an emulated instrument or the pump's relay, and which have an amount."""
    if instrument == "arm":
        return tuple(arm_faults.ArmFault), arm_faults.AMOUNTS
    if instrument == "cameras":
        return tuple(camera_faults.FAULTS), camera_faults.AMOUNTS
    if instrument == "stage":
        from instruments.stage.emulator import board

        return tuple(board.StageFault), board.AMOUNTS
    from instruments.bath.emulator import AMOUNTS, FAULTS, RELAY_FAULTS
    from instruments.bath.line_emulator import LINE_FAULTS

    of_bath = tuple(dict.fromkeys((*FAULTS, *LINE_FAULTS)))
    return of_bath if instrument == "bath" else RELAY_FAULTS, AMOUNTS


class Emulation(FileTable):
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
    arm_placed: Placement = Placement()
    arm_unit: Annotated[str, AfterValidator(beside_if_named)] = ""
    optical: EmulatedOptical = EmulatedOptical()
    thermal: EmulatedThermal = EmulatedThermal()
    depth: EmulatedDepth = EmulatedDepth()
    stage: EmulatedStage = EmulatedStage()
    faults: tuple[EmulatedFault, ...] = ()


class Notify(FileTable):
    """Where word is sent to, by apprise; ``$NAME`` in an address is taken from the environment."""

    urls: tuple[Annotated[str, Field(min_length=1, max_length=500)], ...] = ()


class Rig(FileTable):
    name: str
    seed: Annotated[int, Field(ge=0)] = 1
    # the file may still have to be made
    calibration: Annotated[str, Field(min_length=1), AfterValidator(a_name)]
    operator: OperatorTable
    arm: ArmTable
    bath: BathTable
    stage: StageTable | None = None
    cameras: CamerasTable
    limits: SafetyLimits = SafetyLimits()
    notify: Notify = Notify()
    emulation: Emulation = Emulation()

    @property
    def urls(self) -> dict[str, str]:
        tables = {name: getattr(self, name, None) for name in ("arm", "bath", "stage", "operator")}
        urls = {name: table.url for name, table in tables.items() if table}
        cameras: CamerasTable | None = getattr(self, "cameras", None)
        return urls | ({"cameras": cameras.note} if cameras else {})

    @property
    def emulated(self) -> tuple[str, ...]:
        """Names of the instruments that are emulated in this process."""
        return tuple(name for name, url in self.urls.items() if is_emulated(url))

    @property
    def by_person(self) -> bool:
        """Whether a person is the operator, at a terminal or in the browser."""
        return self.operator.url in PEOPLE

    @property
    def simulated(self) -> bool:
        """Whether all instruments are emulated in this process; a person may rehearse on them."""
        real = set(self.urls) - set(self.emulated)
        return bool(self.emulated) and real <= {"operator"}

    @property
    def bath_emulated(self) -> bool:
        """Whether the bath is an emulator's, of this process or of a `teatbench emulate` on this
        machine: operator and bath are then at the loopback or a pty.
        """
        if is_emulated(self.bath.url) or plugin_url(self.bath.url):
            return is_emulated(self.bath.url)
        line, hands = parse_line(self.bath.url), urlsplit(self.operator.url)
        there = bool(re.match(r"/dev/(pts/|ttys)\d", line.device)) or is_loopback(line.host)
        return there and hands.scheme == "emulator" and is_loopback(hands.hostname or "")

    @property
    def all_emulated(self) -> bool:
        """Whether no instrument is real: their emulators are of this process, or of another."""
        return self.simulated or self.operator.url.startswith(ELSEWHERE)

    @property
    def partly_emulated(self) -> tuple[str, ...]:
        """Names of the emulated instruments, where others are real."""
        return () if self.all_emulated else self.emulated
