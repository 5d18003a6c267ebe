"""The trial script: what is to be shown, how it is decided, and the trials that show it.

A script is fixed before the run and copied into it. Reading it may not open an instrument.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from bench.config import ConfigError, Section, did_you_mean, read_config, read_text
from bench.rig import Millimetres, Positive, find_shipped
from detector import registry
from instruments.operators.operator import Arrangement
from instruments.world.objects import make_object
from instruments.world.phantom import LAYOUTS, make_phantom

TRIALS = Path(__file__).parent / "trials"
RECORDING_RULES = Path(__file__).parent / "rules" / "recording.toml"
Rate = Annotated[float, Field(gt=0, lt=1)]


class BathGate(Section):
    """Set point and stability gate; the defaults are those of the bench's bath sheet, section 4.2."""

    set_point_c: float
    window_s: Annotated[float, Field(ge=2, le=7200)] = 600.0  # far less than 600 s shows nothing: for trying a rig out
    mean_k: Positive = 0.10
    half_range_k: Positive = 0.05
    slope_k_per_min: Positive = 0.01
    leave_k: Positive = 0.15
    timeout_s: Positive = 7200.0


class ErrorRequirement(Section):
    kind: Literal["error"]
    name: str
    limit_mm: Positive
    statistic: Literal["max"] = "max"
    rate: Rate = 0.95
    confidence: Rate = 0.95
    source: str = ""


class TimeRequirement(Section):
    kind: Literal["time"]
    name: str
    limit_s: Positive
    statistic: Literal["p95", "max"]
    source: str = ""


class SuccessRequirement(Section):
    kind: Literal["success"]
    name: str
    rate: Rate
    confidence: Rate = 0.95
    source: str = ""


class FalseRequirement(Section):
    kind: Literal["false_teats"]
    name: str
    confidence: Rate = 0.95
    source: str = ""


class BathRequirement(Section):
    kind: Literal["bath_in_band"]
    name: str
    band_k: Positive
    source: str = ""


class ArmRequirement(Section):
    """The arm checked before and after the trials, and verified on a day not long ago (docs/arm.md). Limits in mm."""

    kind: Literal["arm_verified"]
    name: str
    location_limit_mm: Positive
    shift_limit_mm: Positive
    drift_limit_mm: Positive
    length_limit_mm: Positive | None = None
    max_age_days: Positive
    least_touches: Annotated[int, Field(ge=2, le=100)] = 5
    dated_required: bool = False
    source: str = ""


Requirement = Annotated[
    ErrorRequirement | TimeRequirement | SuccessRequirement | FalseRequirement | BathRequirement | ArmRequirement,
    Field(discriminator="kind"),
]


class Published(Section):
    """What the thesis's own detector found in this situation, to print beside ours."""

    found: Annotated[int, Field(ge=0)]
    present: Annotated[int, Field(ge=1)]
    source: str = ""


class Trial(Section):
    """One pose of the phantom and what else is in the scene. ``set_up`` tells a person what to do."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$")]
    situation: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_]*$")]
    layout: str
    set_up: str
    stage_mm: tuple[Millimetres, Millimetres] = (0.0, 0.0)
    objects: tuple[dict[str, Any], ...] = ()
    repeats: Annotated[int, Field(ge=1, le=1000)] | None = None
    published: Published | None = None

    @field_validator("layout")
    @classmethod
    def _layout(cls, name: str) -> str:
        if name not in LAYOUTS:
            raise ValueError(f"no such layout{did_you_mean(name, LAYOUTS)} (shipped: {', '.join(LAYOUTS)})")
        return name

    @field_validator("objects")
    @classmethod
    def _objects(cls, tables: tuple[dict[str, Any], ...]) -> tuple[dict[str, Any], ...]:
        for number, table in enumerate(tables, 1):
            try:
                make_object(**table)
            except (ValueError, TypeError) as error:
                raise ValueError(f"object {number}: {error}") from error
        return tables

    @property
    def arrangement(self) -> Arrangement:
        """What the operator is asked to set up."""
        return Arrangement(self.situation, self.layout, self.objects, self.set_up, len(make_phantom(self.layout).teats))


class Rules(Section):
    """What detections are held against, with or without instruments: fixed before anything is run."""

    title: str
    about: str = ""
    detectors: Annotated[tuple[str, ...], Field(min_length=1)]
    visible_within_mm: Positive = 5.0
    time_limit_s: Positive = 2.0
    requirements: Annotated[tuple[Requirement, ...], Field(min_length=1)]

    @field_validator("detectors")
    @classmethod
    def _detectors(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        check_detectors(names)
        return names

    @field_validator("requirements")
    @classmethod
    def _requirements_differ(cls, rules: tuple[Requirement, ...]) -> tuple[Requirement, ...]:
        _no_name_twice([rule.name for rule in rules])
        return rules

    @property
    def published(self) -> dict[str, Published]:
        """The thesis's own figures by situation."""
        return {}


class Script(Rules):
    """Rules, the bath, and the trials."""

    repeats: Annotated[int, Field(ge=1, le=1000)] = 1
    bath: BathGate
    trials: Annotated[tuple[Trial, ...], Field(min_length=1)]

    @field_validator("trials")
    @classmethod
    def _trials_differ(cls, trials: tuple[Trial, ...]) -> tuple[Trial, ...]:
        _no_name_twice([trial.name for trial in trials])
        return trials

    @property
    def published(self) -> dict[str, Published]:
        return {trial.situation: trial.published for trial in self.trials if trial.published}

    @property
    def planned(self) -> tuple[tuple[Trial, int], ...]:
        """Each trial with the number of its repeat, from 1, in the order of the run."""
        return tuple((trial, repeat) for trial in self.trials for repeat in range(1, (trial.repeats or self.repeats) + 1))


@dataclass(frozen=True, slots=True)
class LoadedScript:
    path: Path
    text: str
    script: Script

    @property
    def name(self) -> str:
        """The file's name without its ending."""
        return self.path.name.removesuffix(".toml")


def _no_name_twice(names: list[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"two have the name {twice[0]!r}; names must differ")


def check_detectors(names: tuple[str, ...]) -> None:
    """Raises ValueError for a detector that isn't there."""
    known = list(registry.available())
    for name in names:
        if name not in known:
            raise ValueError(f"no detector {name!r}{did_you_mean(name, known)} (there are: {', '.join(known)})")


def find_script(name: str | None) -> Path:
    """The file of a shipped script by name, or of any script by path; the six situations for None. Raises ConfigError."""
    return find_shipped(name or "six-situations", TRIALS, "trial script")


def load_script(path: Path, rig_limits_c: tuple[float, float] | None = None) -> LoadedScript:
    """The script at ``path``, held against the rig's allowed set points where given. Raises ConfigError with all faults."""
    script = read_config(path, Script)
    wanted = script.bath.set_point_c
    if rig_limits_c and not rig_limits_c[0] <= wanted <= rig_limits_c[1]:
        raise ConfigError.plain(
            f"{path}: bath.set_point_c = {wanted:g} degC is outside what the rig allows ({rig_limits_c[0]:g} to {rig_limits_c[1]:g} degC)"
        )
    return LoadedScript(path, read_text(path), script)
