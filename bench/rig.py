"""The rig file: which instruments, at which addresses, with which calibration and limits.

An emulated rig and a real one have the same keys; what differs are the URLs. Reading it may not open anything.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from bench.config import ConfigError, Section, did_you_mean, located, read_config, read_text
from detector.calibration import Calibration, CalibrationError, load_calibration
from instruments.bath.profile import Profile, ProfileError, load_profile, profile_names

RIGS = Path(__file__).parent / "rigs"
EMULATED = "emulator:"


def _serial_url(url: str) -> str:
    if url == EMULATED or re.match(r"(socket|rfc2217)://[^/:]+:\d+$", url) or re.match(r"(/dev/\S+|COM\d+)$", url):
        return url
    raise ValueError('not a link; allowed: "emulator:", "/dev/ttyUSB0", "COM5", "socket://host:port", "rfc2217://host:port"')


def _bath_url(url: str) -> str:
    if url == EMULATED or re.match(r"tcp://[^/:]+:\d+$", url):
        return url
    raise ValueError('not a link; allowed: "emulator:", "tcp://host:port"')


def _camera_url(url: str) -> str:
    if url == EMULATED or re.match(r"(opencv|recording):\S+", url):
        return url
    raise ValueError(
        'not a camera; allowed: "emulator:", "opencv:LEFT,RIGHT,THERMAL" (device numbers, files or streams), "recording:FOLDER"'
    )


Millimetres = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Arm(Section):
    url: Annotated[str, AfterValidator(_serial_url)]
    baud: Literal[9600, 14400, 19200, 28800, 38400, 57600, 115200] = 115200
    accuracy_mm: Positive = 0.23
    packets: Annotated[int, Field(ge=2, le=1000)] = 8
    max_spread_mm: Positive = 1.0
    touches: Annotated[int, Field(ge=1, le=100)] = 3
    definition_mm: Positive = 0.1


class Bath(Section):
    url: Annotated[str, AfterValidator(_bath_url)]
    profile: str

    @field_validator("profile")
    @classmethod
    def _known(cls, name: str) -> str:
        known = profile_names()
        if name not in known and not name.endswith(".toml"):
            raise ValueError(f"no such profile{did_you_mean(name, known)} (shipped: {', '.join(known)}; or a path that ends in .toml)")
        return name


class Stage(Section):
    url: Annotated[str, AfterValidator(_serial_url)]
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


class Emulation(Section):
    """What the emulated world is like; a real rig has no use for it."""

    ambient_c: Annotated[float, Field(ge=-10, le=40)] = 20.0
    bath_start_c: Annotated[float, Field(ge=0, le=40)] = 20.0
    arm_accuracy_mm: Annotated[float, Field(ge=0, le=5)] = 0.23
    hand_tremor_mm: Annotated[float, Field(ge=0, le=5)] = 0.05
    hand_error_mm: Annotated[float, Field(ge=0, le=10)] = 0.1


class Rig(Section):
    name: str
    seed: Annotated[int, Field(ge=0)] = 1
    calibration: str
    operator: Operator
    arm: Arm
    bath: Bath
    stage: Stage | None = None
    cameras: Cameras
    limits: Limits = Limits()
    emulation: Emulation = Emulation()

    @field_validator("calibration")
    @classmethod
    def _there(cls, name: str, info: ValidationInfo) -> str:
        folder: Any = (info.context or {}).get("folder")
        if folder is not None and not (Path(folder) / name).is_file():
            raise ValueError(f"no such file beside the rig file ({Path(folder) / name})")
        return name

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
    return LoadedRig(path, text, rig, profile, calibration_path, read_calibration(calibration_path))


def read_calibration(path: Path) -> Calibration:
    """The calibration at ``path``. Raises ConfigError that shows each fault in its place."""
    try:
        return load_calibration(path)
    except CalibrationError as error:
        raise located(path, read_text(path), [(fault.key, fault.message, False) for fault in error.faults]) from error


def _profile(path: Path, text: str, rig: Rig) -> Profile:
    name = rig.bath.profile
    own = path.parent / name if name.endswith(".toml") else None
    if own is not None and not own.is_file():
        raise located(path, text, [(("bath", "profile"), f"no such file ({own})", False)])
    try:
        return load_profile(own or name)
    except ProfileError as error:
        faults = [(tuple(int(k) if k.isdigit() else k for k in key.split(".")), message, False) for key, message in error.faults]
        raise located(Path(error.path), read_text(Path(error.path)), faults) from error
