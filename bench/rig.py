"""The rig file: which instruments, at which addresses, with which calibration and limits.

An emulated rig and a real one have the same keys; what differs are the URLs. Reading it may not open anything.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from bench.arm.files import load_frame, load_verification
from bench.arm.frame import TableFrame
from bench.arm.verification import Verification
from bench.config import ConfigError, Section, did_you_mean, located, read_config, read_text
from bench.faults import check_wish
from detector.calibration import Calibration, CalibrationError, load_calibration
from instruments.bath.line import ALLOWED, LineError, parse_line
from instruments.bath.profile import Profile, ProfileError, RelayProfile, load_profile, load_relay, profile_names
from instruments.microscribe.unit import ArmIdentity, UnitError, load_unit

RIGS = Path(__file__).parent / "rigs"
EMULATED = "emulator:"


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


def _camera_url(url: str) -> str:
    if url == EMULATED or re.match(r"(opencv|recording):\S+", url):
        return url
    raise ValueError(
        'not a camera; allowed: "emulator:", "opencv:LEFT,RIGHT,THERMAL" (device numbers, files or streams), "recording:FOLDER"'
    )


def _beside(name: str, info: ValidationInfo) -> str:
    folder: Any = (info.context or {}).get("folder")
    if folder is not None and not (Path(folder) / name).is_file():
        raise ValueError(f"no such file beside the rig file ({Path(folder) / name})")
    return name


def _beside_if_named(name: str, info: ValidationInfo) -> str:
    return _beside(name, info) if name else name


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
    frame: Annotated[str, AfterValidator(_beside_if_named)] = ""
    verification: Annotated[str, AfterValidator(_beside_if_named)] = ""
    check_point_mm: Point | None = None
    check_touches: Annotated[int, Field(ge=2, le=100)] = 5


def _relay_url(url: str) -> str:
    try:
        if url:
            parse_line(url)
    except LineError as error:
        raise ValueError(str(error)) from error
    return url


class Bath(Section):
    url: Annotated[str, AfterValidator(bath_url)]
    profile: str
    allow_inferred: bool = False
    pump_url: Annotated[str, AfterValidator(_relay_url)] = ""
    pump_profile: Annotated[str, AfterValidator(_beside_if_named)] = ""
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
    reference_mm: tuple[Millimetres, Millimetres] = (-150.0, -137.5)
    feed_mm_per_min: Positive = 1500.0


class Cameras(Section):
    url: Annotated[str, AfterValidator(_camera_url)]
    settle_s: Annotated[float, Field(ge=0, le=600)] = 1.0
    max_skew_s: Positive = 0.05


class Operator(Section):
    url: Literal["emulator:", "console:"]


class Limits(Section):
    set_point_c: tuple[float, float] = (20.0, 36.0)
    bath_max_c: Annotated[float, Field(le=40.0)] = 37.0
    bath_plausible_c: tuple[float, float] = (-5.0, 60.0)
    bath_rate_k_per_min: Positive = 4.0
    bath_silence_s: Positive = 5.0
    sensors_differ_k: Positive = 2.0
    detection_timeout_s: Positive = 30.0

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

    instrument: Literal["arm", "bath", "stage"]
    name: str
    at_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    for_s: Positive | None = None
    times: Annotated[int, Field(ge=1)] | None = None
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
    arm_placed: Placed = Placed()
    arm_unit: Annotated[str, AfterValidator(_beside_if_named)] = ""
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
        return {"arm": self.arm.url, "bath": self.bath.url, **stage, "cameras": self.cameras.url, "operator": self.operator.url}

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
        name = self.rig.bath.profile
        return str((self.path.parent / name).resolve()) if name.endswith(".toml") else name

    @property
    def arm_files(self) -> dict[str, str]:
        """The text of each file about the arm that the rig names, by its name; for the run's folder."""
        names = [name for name in (self.rig.arm.frame, self.rig.arm.verification) if name]
        return {Path(name).name: read_text(self.path.parent / name) for name in names}


def find_rig(name: str | None) -> Path:
    """The file of a shipped rig by name, or of any rig by path; the emulated one for None. Raises ConfigError."""
    return find_shipped(name or "emulated", RIGS, "rig", exclude=("calibration",))


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
    real = set(rig.urls) - set(rig.emulated)
    if rig.emulated and real:
        message = f"emulated and real instruments don't mix: they would not share one world (real here: {', '.join(sorted(real))})"
        raise located(path, text, [((name, "url"), message, False) for name in rig.emulated])
    calibration_path = path.parent / rig.calibration
    homeless = [i for i, fault in enumerate(rig.emulation.faults) if fault.instrument not in rig.urls]
    if homeless:
        missing = "this rig has no such instrument"
        raise located(path, text, [(("emulation", "faults", i, "instrument"), missing, False) for i in homeless])
    frame = load_frame(path.parent / rig.arm.frame) if rig.arm.frame else None
    verification = load_verification(path.parent / rig.arm.verification) if rig.arm.verification else None
    unit = _arm_unit(path.parent / rig.emulation.arm_unit) if rig.emulation.arm_unit else None
    relay = _relay(path, text, rig, profile)
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
    elif bath.url == EMULATED:
        wrong = "an emulated bath has its pump already: leave pump_url and pump_profile out"
    elif profile.capabilities.pump != "none":
        wrong = f"{profile.family} has a pump of its own: leave pump_url and pump_profile out"
    if wrong:
        raise located(path, text, [(("bath", key), wrong, False)])
    try:
        return load_relay(path.parent / bath.pump_profile)
    except ProfileError as error:
        raise _profile_faults(error) from error


def _profile_faults(error: ProfileError) -> ConfigError:
    faults = [(tuple(int(k) if k.isdigit() else k for k in key.split(".")), message, False) for key, message in error.faults]
    return located(Path(error.path), read_text(Path(error.path)), faults)
