"""The rig file: which instruments, at which addresses, with which calibration and limits.

An emulated rig and a real one have the same keys; what differs are the URLs. Reading it may not open anything.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from bench.answers import load_answers
from bench.arm.files import load_frame, load_verification
from bench.arm.frame import TableFrame
from bench.arm.verification import Verification
from bench.camera_tables import Cameras
from bench.config import ConfigError, Section, did_you_mean, located, read_config, read_text
from bench.emulated_optics import EmulatedOptical, EmulatedThermal
from bench.emulated_stage import EmulatedStage
from bench.faults import check_wish
from detector.calibration import Calibration, CalibrationError, load_calibration
from instruments.bath.line import ALLOWED, LineError, parse_line
from instruments.bath.profile import Profile, ProfileError, RelayProfile, load_profile, load_relay, profile_names, relay_names
from instruments.microscribe.unit import ArmIdentity, UnitError, load_unit
from instruments.operators.emulated import Mistake
from instruments.world.phantom import PlatePose

RIGS = Path(__file__).parent / "rigs"
CALIBRATIONS = ("calibration", "thesis-calibration")  # what lies there and is no rig
EMULATED, CONSOLE, SCRIPT = "emulator:", "console:", "script:"


def serial_url(url: str) -> str:
    """``url`` where it is a serial link's. Raises ValueError that says what is allowed."""
    if url == EMULATED or re.match(r"(socket|rfc2217)://[^/:]+:\d+$", url) or re.match(r"(/dev/\S+|COM\d+)$", url):
        return url
    raise ValueError('not a link; allowed: "emulator:", "/dev/ttyUSB0", "COM5", "socket://host:port", "rfc2217://host:port"')


def bath_url(url: str) -> str:
    """``url`` where it is a bath's. Raises ValueError that says what is allowed."""
    if url == EMULATED:
        return url
    try:
        parse_line(url)
    except LineError as error:
        raise ValueError(str(error).replace(ALLOWED, f'"{EMULATED}", {ALLOWED}')) from error
    return url


def _beside(name: str, info: ValidationInfo) -> str:
    folder: Any = (info.context or {}).get("folder")
    if folder is not None and not (Path(folder) / name).is_file():
        raise ValueError(f"no such file beside the rig file ({Path(folder) / name})")
    return name


def _beside_if_named(name: str, info: ValidationInfo) -> str:
    return _beside(name, info) if name else name


def _operator_url(url: str, info: ValidationInfo) -> str:
    if url.startswith(SCRIPT):
        _beside(url.removeprefix(SCRIPT), info)
    elif url not in (EMULATED, CONSOLE):
        near = did_you_mean(url, (EMULATED, CONSOLE, SCRIPT))
        raise ValueError(f'not an operator{near} (allowed: "{CONSOLE}", "{EMULATED}", "{SCRIPT}ANSWERS.toml", "{SCRIPT}ANSWERS.txt")')
    return url


Millimetres = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Point = tuple[Millimetres, Millimetres, Millimetres]
Radians = Annotated[float, Field(ge=-7, le=7, allow_inf_nan=False)]


class Arm(Section):
    url: Annotated[str, AfterValidator(serial_url)]
    baud: Literal[9600, 14400, 19200, 28800, 38400, 57600, 115200] = 115200
    accuracy_mm: Positive = 0.23
    packets: Annotated[int, Field(ge=2, le=1000)] = 8
    max_spread_mm: Positive = 1.0
    touches: Annotated[int, Field(ge=1, le=100)] = 3
    definition_mm: Positive = 0.1
    tip_radius_mm: Annotated[float, Field(ge=0, le=20)] = 0.0
    tip_radius_u_mm: Annotated[float, Field(ge=0, le=5)] = 0.01
    axis_u_rad: Annotated[float, Field(ge=0, le=0.5)] = 0.02
    frame: Annotated[str, AfterValidator(_beside_if_named)] = ""
    verification: Annotated[str, AfterValidator(_beside_if_named)] = ""
    check_point_mm: Point | None = None
    check_touches: Annotated[int, Field(ge=2, le=100)] = 5


def _relay_url(url: str) -> str:
    try:
        if url not in ("", EMULATED):
            parse_line(url)
    except LineError as error:
        raise ValueError(str(error).replace(ALLOWED, f'"{EMULATED}", {ALLOWED}')) from error
    return url


def _relay_profile(name: str, info: ValidationInfo) -> str:
    known = relay_names()
    if not name or name in known:
        return name
    if not name.endswith(".toml"):
        raise ValueError(f"no such profile{did_you_mean(name, known)} (shipped: {', '.join(known)}; or a path that ends in .toml)")
    return _beside(name, info)


class Bath(Section):
    url: Annotated[str, AfterValidator(bath_url)]
    profile: str
    allow_inferred: bool = False
    pump_url: Annotated[str, AfterValidator(_relay_url)] = ""
    pump_profile: Annotated[str, AfterValidator(_relay_profile)] = ""
    accuracy_k: Positive = 0.1
    external_accuracy_k: Positive = 0.1
    room_c: Annotated[float, Field(ge=-10, le=40)] = 20.0

    @field_validator("profile")
    @classmethod
    def _known(cls, name: str) -> str:
        known = profile_names()
        if name not in known and not name.endswith(".toml"):
            raise ValueError(f"no such profile{did_you_mean(name, known)} (shipped: {', '.join(known)}; or a path that ends in .toml)")
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
        """Where the stage's axes are when the plate stands at ``pose``: arguments of `Stage.move_to`, of the axes that there are."""
        x, y = self.reference_mm
        there = {"x_mm": x + pose.x_mm, "y_mm": y + pose.y_mm}
        more = {"Z": ("z_mm", self.reference_z_mm + pose.z_mm), "A": ("a_deg", self.reference_a_deg + math.degrees(pose.yaw_rad))}
        return there | dict(more[axis] for axis in self.axes[2:])


class Operator(Section):
    url: Annotated[str, AfterValidator(_operator_url)]
    remind_s: Positive = 120.0


class Limits(Section):
    set_point_c: tuple[float, float] = (20.0, 36.0)
    bath_max_c: Annotated[float, Field(le=40.0)] = 37.0
    bath_plausible_c: tuple[float, float] = (-5.0, 60.0)
    bath_rate_k_per_min: Positive = 4.0
    bath_silence_s: Positive = 5.0
    sensors_differ_k: Positive = 2.0
    detection_timeout_s: Positive = 30.0
    away_s: Annotated[float, Field(ge=0, le=86400)] = 600.0  # how long an instrument that dropped out is waited for; 0: not at all

    @field_validator("set_point_c", "bath_plausible_c")
    @classmethod
    def _ordered(cls, span: tuple[float, float]) -> tuple[float, float]:
        if span[0] >= span[1]:
            raise ValueError("the first number must be the smaller one")
        return span

    @model_validator(mode="after")
    def _headroom(self) -> Limits:
        if self.set_point_c[1] >= self.bath_max_c:
            raise ValueError(f"set_point_c allows {self.set_point_c[1]:g} degC, which bath_max_c = {self.bath_max_c:g} would trip on")
        return self


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
    arm_unit: Annotated[str, AfterValidator(_beside_if_named)] = ""
    optical: EmulatedOptical = EmulatedOptical()
    thermal: EmulatedThermal = EmulatedThermal()
    stage: EmulatedStage = EmulatedStage()
    faults: tuple[EmulatedFault, ...] = ()


class Rig(Section):
    name: str
    seed: Annotated[int, Field(ge=0)] = 1
    calibration: Annotated[str, AfterValidator(_beside)]
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
        return {"arm": self.arm.url, "bath": self.bath.url, **stage, "cameras": self.cameras.told, "operator": self.operator.url}

    @property
    def emulated(self) -> tuple[str, ...]:
        """Names of the instruments that are emulated."""
        return tuple(name for name, url in self.urls.items() if url == EMULATED)


@dataclass(frozen=True, slots=True)
class LoadedRig:
    """A rig file as read: where it is, its text, what it says, and the calibration that it names."""

    path: Path
    text: str
    rig: Rig
    profile: Profile
    calibration_path: Path
    calibration: Calibration
    frame: TableFrame | None = None
    verification: Verification | None = None
    arm_unit: ArmIdentity | None = None
    relay: RelayProfile | None = None

    @property
    def profile_source(self) -> str:
        """What another process loads the bath's profile by: a shipped name, or a whole path."""
        return self._source(self.rig.bath.profile)

    @property
    def relay_source(self) -> str:
        """As ``profile_source``, of the pump's relay; empty where there is none."""
        return self._source(self.rig.bath.pump_profile)

    def _source(self, name: str) -> str:
        return str((self.path.parent / name).resolve()) if name.endswith(".toml") else name

    @property
    def answer_files(self) -> dict[str, str]:
        """The text of the script of answers, by its name; none where something else answers."""
        url = self.rig.operator.url
        name = url.removeprefix(SCRIPT)
        return {Path(name).name: read_text(self.path.parent / name)} if url.startswith(SCRIPT) else {}

    @property
    def arm_files(self) -> dict[str, str]:
        """The text of each file about the arm that the rig names, by its name; for the run's folder."""
        names = [name for name in (self.rig.arm.frame, self.rig.arm.verification) if name]
        return {Path(name).name: read_text(self.path.parent / name) for name in names}


def find_rig(name: str | None) -> Path:
    """The file of a shipped rig by name, or of any rig by path; the emulated one for None. Raises ConfigError."""
    return find_shipped(name or "emulated", RIGS, "rig", exclude=CALIBRATIONS)


def find_shipped(name: str, folder: Path, kind: str, exclude: tuple[str, ...] = ()) -> Path:
    """``name`` as a path, or as the name of a file in ``folder``. Raises ConfigError that lists what ships."""
    if name.endswith(".toml") or Path(name).is_file():
        return Path(name)
    known = [stem for stem in shipped(folder) if stem not in exclude]
    if name in known:
        return folder / f"{name}.toml"
    raise ConfigError.plain(f'no {kind} "{name}"{did_you_mean(name, known)} Shipped: {", ".join(known)}; or give the path of a .toml file.')


def shipped(folder: Path) -> list[str]:
    """Names of the TOML files in ``folder``, without their ending."""
    return sorted(path.name.removesuffix(".toml") for path in folder.glob("*.toml"))


def load_rig(path: Path) -> LoadedRig:
    """The rig file at ``path`` with its calibration. Raises ConfigError with all faults of the first wrong file."""
    rig = read_config(path, Rig)
    text = read_text(path)
    profile = _profile(path, text, rig)
    real = set(rig.urls) - set(rig.emulated) - (set() if rig.operator.url == EMULATED else {"operator"})  # a person may rehearse
    if rig.emulated and real:
        message = f"emulated and real instruments don't mix: they would not share one world (real here: {', '.join(sorted(real))})"
        raise located(path, text, [((name, "url"), message, False) for name in rig.emulated])
    calibration_path = path.parent / rig.calibration
    there = {*rig.urls, *(["pump"] if rig.bath.pump_url else [])}
    if rig.stage and rig.stage.url == EMULATED and (wrong := rig.emulation.stage.fault(rig.stage.axes)):
        raise located(path, text, [(("stage", "axes"), wrong, False)])
    homeless = [i for i, fault in enumerate(rig.emulation.faults) if fault.instrument not in there]
    if homeless:
        missing = "this rig has no such instrument"
        raise located(path, text, [(("emulation", "faults", i, "instrument"), missing, False) for i in homeless])
    frame = load_frame(path.parent / rig.arm.frame) if rig.arm.frame else None
    verification = load_verification(path.parent / rig.arm.verification) if rig.arm.verification else None
    unit = _arm_unit(path.parent / rig.emulation.arm_unit) if rig.emulation.arm_unit else None
    relay = _relay(path, text, rig, profile)
    if rig.operator.url.startswith(SCRIPT):
        load_answers(path.parent / rig.operator.url.removeprefix(SCRIPT))  # its faults are told before anything is opened
    calibration = read_calibration(calibration_path)
    return LoadedRig(path, text, rig, profile, calibration_path, calibration, frame, verification, unit, relay)


def read_calibration(path: Path) -> Calibration:
    """The calibration at ``path``. Raises ConfigError that shows each fault in its place."""
    try:
        return load_calibration(path)
    except CalibrationError as error:
        raise located(path, read_text(path), [(fault.key, fault.message, False) for fault in error.faults]) from error


def _arm_unit(path: Path) -> ArmIdentity:
    try:
        return load_unit(path)
    except UnitError as error:
        raise located(path, read_text(path), [(key, message, False) for key, message in error.located]) from error


def _profile(path: Path, text: str, rig: Rig) -> Profile:
    name = rig.bath.profile
    own = path.parent / name if name.endswith(".toml") else None
    if own is not None and not own.is_file():
        raise located(path, text, [(("bath", "profile"), f"no such file ({own})", False)])
    try:
        return load_profile(own or name)
    except ProfileError as error:
        raise _profile_faults(error) from error


def _relay(path: Path, text: str, rig: Rig, profile: Profile) -> RelayProfile | None:
    """The profile of the relay that switches the pump, where the rig has one."""
    bath = rig.bath
    if not (bath.pump_url or bath.pump_profile):
        return None
    key = "pump_url" if bath.pump_url else "pump_profile"
    wrong = ""
    if not (bath.pump_url and bath.pump_profile):
        wrong = f"{'pump_profile' if bath.pump_url else 'pump_url'} is missing: a pump's relay has both, or there is none"
    elif (bath.url == EMULATED) != (bath.pump_url == EMULATED):
        wrong = f'bath and pump are both emulated or both real: "{EMULATED}" stands in url and in pump_url, or in neither'
    elif profile.capabilities.pump != "none":
        wrong = f"{profile.family} has a pump of its own: leave pump_url and pump_profile out"
    if wrong:
        raise located(path, text, [(("bath", key), wrong, False)])
    try:
        return load_relay(path.parent / bath.pump_profile if bath.pump_profile.endswith(".toml") else bath.pump_profile)
    except ProfileError as error:
        raise _profile_faults(error) from error


def _profile_faults(error: ProfileError) -> ConfigError:
    faults = [(tuple(int(k) if k.isdigit() else k for k in key.split(".")), message, False) for key, message in error.faults]
    return located(Path(error.path), read_text(Path(error.path)), faults)
