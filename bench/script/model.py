"""The trial script: what is to be shown, how it is decided, how the truth of its trials is had, and
the trials that show it.

A script is fixed before the run and copied into it. Reading it opens no instrument. One in Python
has `SCRIPT`, what stands above the trials, and `trials()`, a generator of the tables of
`[[trials]]`: it is run once, and what it gives becomes the TOML that a run keeps beside it.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from bench.config import ConfigError, FileTable, Positive, located, parse_config, read_text
from bench.rig.loading import LoadedRig, find_shipped
from bench.rig.urls import is_there
from bench.scoring.looks import Looks
from bench.script.detectors import check_named
from bench.script.phantom import Layout, find_layout, load_layout
from bench.script.planned_trials import PlannedTrial, PublishedRate, Trial, plan
from bench.toml import toml_text
from bench.truth.registration import Registration, load_registration
from textfiles.text import named

FIRST = "first"
ENDING, MOST = ".py", 100_000
HEADING = "Made by {}, which lies beside this file."
Shift = Annotated[float, Field(ge=-2000, le=2000)]


class TruthTable(FileTable):
    """``touch``: every end in every trial. ``carry``: once, then by the stage, checked by touch
    after ``every`` trials (0: at the end and before a rearrangement) within ``check_limit_mm``.
    ``registration``: a file beside the script, or "first": made at the start by touches of teat
    ``registration_teat`` at ``registration_at_mm``.
    """

    mode: Literal["touch", "carry"] = "touch"
    readings: Annotated[int, Field(ge=1, le=20)] | None = None
    registration: str = ""
    registration_at_mm: Annotated[tuple[tuple[Shift, Shift], ...], Field(min_length=3)] | None = (
        None
    )
    registration_teat: Annotated[int, Field(ge=1, le=8)] = 1
    check_every: Annotated[int, Field(ge=0, le=100_000)] = 0
    check_limit_mm: Annotated[float, Field(gt=0, le=50)] = 1.5

    @field_validator("registration")
    @classmethod
    def _there(cls, name: str, info: ValidationInfo) -> str:
        folder: Any = (info.context or {}).get("folder")
        if name not in ("", FIRST) and folder is not None and not is_there(Path(folder) / name):
            raise ValueError(
                f'no such file beside the script ({Path(folder) / name}); "{FIRST}" makes one at'
                " the start of the run"
            )
        return name

    @model_validator(mode="after")
    def _whole(self) -> TruthTable:
        given = self.model_fields_set - {"mode", "readings"}
        if self.mode == "touch" and given:
            raise ValueError(
                f'{", ".join(sorted(given))}: only for mode = "carry"; here every end is touched in'
                " every trial"
            )
        if self.mode == "carry" and not self.registration:
            raise ValueError(
                f'carry needs a registration: a file of "teatbench calibrate stage", or "{FIRST}"'
            )
        if self.registration != FIRST and self.registration_at_mm:
            raise ValueError(
                f'registration_at_mm is for registration = "{FIRST}"; the file has its own'
                " positions"
            )
        return self

    @property
    def file(self) -> str:
        return "" if self.registration == FIRST else self.registration


TRIALS = Path(__file__).parents[1] / "trials"
RECORDING_RULES = Path(__file__).parents[1] / "rules" / "recording.toml"
CAMERAS_RULE = RECORDING_RULES.with_name("cameras.toml")  # of a recording that shows known ends
Rate = Annotated[float, Field(gt=0, lt=1)]


# K: beyond these a gate or a band says nothing of a bath any more. Teats at rest are 0.3 K below a
# bath of 33 degC, 0.6 K with a slow flow and 1.2 K with the room at 10 degC; cold ones 13 K.
WIDEST_K = {"leave_k": 1.0, "half_range_k": 1.0, "teat_level_k": 1.5}
WIDEST_BAND_K = 1.0


def no_wider(value: float, info: ValidationInfo) -> float:
    """Raises ValueError for a limit that lets any bath pass; not for a run that was done."""
    widest = WIDEST_K.get(info.field_name or "", WIDEST_BAND_K)
    if value > widest and not (info.context or {}).get("stored"):
        raise ValueError(f"{value:g} K; wider than {widest:g} K it would let any bath pass")
    return value


class BathGate(FileTable):
    """Set point and stability gate; defaults are the bath sheet's, section 4.2."""

    set_point_c: float
    # far less than 600 s shows nothing: for trying a rig out
    window_s: Annotated[float, Field(ge=2, le=7200)] = 600.0
    leave_k: Positive = 0.15
    mean_k: Annotated[Positive, Field(validate_default=True)] = 0.10
    half_range_k: Positive = 0.05
    slope_k_per_min: Positive = 0.01
    # of the sensor at the teats, where the bath has one
    teat_slope_k_per_min: Positive = 0.02
    teat_level_k: Positive = 1.0
    timeout_s: Positive = 7200.0

    _not_wider = field_validator(*WIDEST_K)(no_wider)

    @field_validator("mean_k")
    @classmethod
    def _at_most_leave_k(cls, mean_k: float, info: ValidationInfo) -> float:
        leave_k = info.data.get("leave_k", mean_k)
        if mean_k > leave_k:
            raise ValueError(
                f"{mean_k:g} K is above leave_k = {leave_k:g} K, so that a stable bath would count"
                " as one that has left its set point: lower mean_k or raise leave_k"
            )
        return mean_k


class _Named(FileTable):
    name: str
    source: str = ""


class _Stated(_Named):
    """One that is decided with a confidence."""

    confidence: Rate = 0.95


class ErrorRequirement(_Stated):
    kind: Literal["error"]
    limit_mm: Positive
    statistic: Literal["max"] = "max"
    rate: Rate = 0.95


class TimeRequirement(_Stated):
    """Decided on what was timed; with a rate, only where so many poses show it."""

    kind: Literal["time"]
    limit_s: Positive
    statistic: Literal["p95", "max"]
    rate: Rate | None = None

    @field_validator("rate")
    @classmethod
    def _of_the_statistic(cls, rate: float | None, info: ValidationInfo) -> float | None:
        if rate is not None and rate != 0.95 and info.data.get("statistic") == "p95":
            raise ValueError(
                'a p95 says it of 0.95 of the poses; for another rate the statistic is "max"'
            )
        return rate


class SuccessRequirement(_Stated):
    kind: Literal["success"]
    rate: Rate


class FalseRequirement(_Stated):
    kind: Literal["false_teats"]


class BathRequirement(_Named):
    kind: Literal["bath_in_band"]
    band_k: Positive

    _not_wider = field_validator("band_k")(no_wider)


class ArmRequirement(_Named):
    """The arm checked before and after the trials, and verified not long ago (docs/rig.md).
    ``dated_required``: a length check too, of real arms. Limits that are left out follow from the
    accuracy that the rig states.
    """

    kind: Literal["arm_verified"]
    location_limit_mm: Positive | None = None
    shift_limit_mm: Positive
    drift_limit_mm: Positive | None = None
    length_limit_mm: Positive | None = None
    max_age_days: Positive
    least_touches: Annotated[int, Field(ge=2, le=100)] = 5
    dated_required: bool = True


class CalibrationRequirement(_Named):
    """The calibration was made not long before the run (docs/calibration.md)."""

    kind: Literal["calibration_fresh"]
    max_age_days: Positive


class CamerasRequirement(_Named):
    """Every camera shows the touched ends where the calibration says: disparity and rows of the
    optical pictures within ``limit_px``, the thermal one within ``thermal_limit_px`` of its sensor.
    """

    kind: Literal["cameras_agree"]
    limit_px: Positive = 0.25
    thermal_limit_px: Positive = 1.0


class CalibrationTable(FileTable):
    """``[calibration]``: a run with an older one, or one of unknown age, is refused."""

    max_age_days: Positive | None = None


Requirement = Annotated[
    ErrorRequirement
    | TimeRequirement
    | SuccessRequirement
    | FalseRequirement
    | BathRequirement
    | ArmRequirement
    | CalibrationRequirement
    | CamerasRequirement,
    Field(discriminator="kind"),
]


def _names_differ(rows: tuple[Any, ...]) -> tuple[Any, ...]:
    names = sorted(row.name for row in rows)
    twice = next((one for one, other in pairwise(names) if one == other), None)
    if twice is not None:
        raise ValueError(f"two have the name {twice!r}; names must differ")
    return rows


class Rules(FileTable):
    """What detections are held against, fixed before anything is run. ``looks``: how many verdicts
    on growing numbers of poses are planned; the first takes its share of the chance of a false one.
    """

    title: str
    about: str = ""
    detectors: Annotated[tuple[str, ...], Field(min_length=1)]
    visible_within_mm: Positive = 5.0
    time_limit_s: Positive = 2.0
    looks: Annotated[int, Field(ge=1, le=100)] = 1
    requirements: Annotated[tuple[Requirement, ...], Field(min_length=1)]

    @field_validator("detectors")
    @classmethod
    def _detectors(cls, names: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        # of a run that was done, also where its detectors aren't at hand any more
        if not (info.context or {}).get("stored"):
            check_named(names)
            if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
                raise ValueError(f"{twice[0]!r} is there twice; name each detector once")
        return names

    _requirements_differ = field_validator("requirements")(_names_differ)

    @property
    def published(self) -> dict[str, PublishedRate]:
        return {}


class Script(Rules):
    """Rules, the bath, and the trials. ``seed`` draws poses, layouts and order, never the run's."""

    seed: Annotated[int, Field(ge=0)] = 1
    order: Literal["as written", "shuffled"] = "as written"
    repeats: Annotated[int, Field(ge=1, le=1000)] = 1
    bath: BathGate
    truth: TruthTable = TruthTable()
    calibration: CalibrationTable = CalibrationTable()
    trials: Annotated[tuple[Trial, ...], Field(min_length=1)]

    _trials_differ = field_validator("trials")(_names_differ)

    @property
    def published(self) -> dict[str, PublishedRate]:
        return {trial.situation: trial.published for trial in self.trials if trial.published}


@dataclass(frozen=True, slots=True)
class LoadedScript:
    """A script as read, its trials in the order of the run, and its layouts. ``*_files``: texts
    that belong into the run's folder, by name.
    """

    path: Path
    text: str
    script: Script
    planned: tuple[PlannedTrial, ...]
    layouts: Mapping[str, Layout]
    registration: Registration | None = None

    @property
    def name(self) -> str:
        return self.path.name.removesuffix(".toml").removesuffix(".py")

    @property
    def poses(self) -> int:
        """How many there are: repeats of one pose count once."""
        return len({trial.name for trial in self.planned})

    def first_confidence(self, confidence: float) -> float:
        """That of the first of its looks, where the last has ``confidence``."""
        return Looks(self.script.looks).first_confidence(confidence)

    @property
    def scenes(self) -> dict[str, set[int]]:
        """Family -> members that it shows; its own name -> its seed."""
        shown: dict[str, set[int]] = {self.name: {self.script.seed}}
        for trial in self.planned:
            if trial.scene:
                shown.setdefault(trial.scene.name, set()).add(trial.scene.seed)
        return shown

    @property
    def source_files(self) -> dict[str, str]:
        return {self.path.name: read_text(self.path)} if self.path.suffix == ENDING else {}

    @property
    def layout_files(self) -> dict[str, str]:
        return {
            name: read_text(self.path.parent / name)
            for name in self.layouts
            if name.endswith(".toml")
        }

    @property
    def truth_files(self) -> dict[str, str]:
        name = self.script.truth.file
        return {Path(name).name: read_text(self.path.parent / name)} if name else {}


def find_script(name: str | None) -> Path:
    """A script by name or path; the six situations for None. Raises ConfigError."""
    return find_shipped("six-situations" if name is None else name, TRIALS, "trial script")


def load_script(path: Path, rig_limits_c: tuple[float, float] | None = None) -> LoadedScript:
    """The script, held against the rig's set points, where given. Raises ConfigError."""
    text = script_text(path)
    script = parse_config(path, text, Script)
    wanted = script.bath.set_point_c
    if rig_limits_c and not rig_limits_c[0] <= wanted <= rig_limits_c[1]:
        low, high = rig_limits_c
        message = f"{wanted:g} degC is outside what the rig allows ({low:g} to {high:g} degC)"
        raise located(path, text, [(("bath", "set_point_c"), message, False)])
    layouts = layouts_of(script, path.parent)
    registration = load_registration(path.parent / script.truth.file) if script.truth.file else None
    return LoadedScript(path, text, script, planned_of(script, layouts), layouts, registration)


def script_text(path: Path) -> str:
    """A script's TOML, or what its Python gives. Raises ConfigError with file and line."""
    text = read_text(path)
    if path.suffix != ENDING:
        return text
    names: dict[str, Any] = {"__name__": "trial_script", "__file__": str(path)}
    try:
        exec(compile(text, str(path), "exec"), names)  # noqa: S102 - the file that the user asked to be run
        head, made = names.get("SCRIPT"), names.get("trials")
        if not isinstance(head, Mapping) or not callable(made):
            raise ConfigError.plain(
                f"{path}: a script in Python has SCRIPT, a dictionary, and trials(), a generator of"
                " dictionaries"
            )
        return toml_text(
            _as_toml({**head, "trials": list(_tables(path, made()))}, path),
            HEADING.format(path.name),
        )
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:  # anyone's code: it may fail in any way
        raise ConfigError.plain(f"{path}{_line_of(path, error)}: {named(error)}") from error


def _tables(path: Path, made: Any) -> Iterator[Mapping[str, Any]]:
    """Its trials. Raises ConfigError for what is none, and where they don't end."""
    if not isinstance(made, Iterable):
        raise ConfigError.plain(
            f"{path}: trials() gives a {type(made).__name__}; it has to yield dictionaries"
        )
    number = 0
    for number, table in enumerate(islice(made, MOST + 1), 1):
        if not isinstance(table, Mapping):
            raise ConfigError.plain(
                f"{path}: trial {number} of trials() is a {type(table).__name__}; each is a"
                " dictionary"
            )
        yield table
    if number > MOST:
        raise ConfigError.plain(f"{path}: trials() gives more than {MOST} trials; does it end?")


def _as_toml(value: Any, path: Path, at: str = "") -> Any:
    """``value`` as TOML has it, without numpy. Raises ConfigError for what TOML lacks."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {
            str(name): _as_toml(one, path, f"{at}.{name}" if at else str(name))
            for name, one in value.items()
        }
    if isinstance(value, list | tuple):
        return [_as_toml(one, path, f"{at}[{number}]") for number, one in enumerate(value, 1)]
    if value is None or isinstance(value, str | int | float):
        return value
    raise ConfigError.plain(
        f"{path}: {at} is a {type(value).__name__}; it has to be text, a number, true or false, a"
        " list or a table"
    )


def _line_of(path: Path, error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == str(path)]
    if isinstance(error, SyntaxError) and error.filename == str(path):
        lines = [error.lineno]
    return f", line {lines[-1]}" if lines else ""


def layouts_of(script: Script, folder: Path) -> dict[str, Layout]:
    """The layouts that the trials name, own ones out of ``folder``. Raises ConfigError."""
    return {
        name: load_layout(find_layout(name, folder))
        for name in {trial.layout for trial in script.trials if trial.layout}
    }


def planned_of(script: Script, layouts: Mapping[str, Layout]) -> tuple[PlannedTrial, ...]:
    """The trials one by one, in the order of the run."""
    return plan(
        script.trials,
        layouts,
        repeats=script.repeats,
        seed=script.seed,
        shuffled=script.order == "shuffled",
    )


def refuse_carry(rig: LoadedRig, script: LoadedScript) -> None:
    """Raises ConfigError for a script that carries on a rig that has no stage to carry with."""
    if script.script.truth.mode == "carry" and rig.rig.stage is None:
        why = f'{script.path}: [truth] mode = "carry" needs a stage, and {rig.path} has none.'
        raise ConfigError.plain(f'{why} Use mode = "touch", or a rig with a [stage].')
