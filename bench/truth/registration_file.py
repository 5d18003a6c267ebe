"""The dated file of a stage's registration: what was touched, and beside it what follows from it,
for people and other programs.

Reading works the figures out again from the touches, and refuses a file whose figures don't follow:
it was changed by hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AwareDatetime, Field

from bench.config import Section, located, read_config, read_text
from bench.rig.arm_files import FOLLOWS_MM, write_file
from bench.toml import toml_text
from bench.truth.registration import Registration, RegistrationError, StageAccuracy, Station
from detector.geometry import Motion

REGISTRATION_FACT, MADE_FACT = "stage registration", "wall_registered"
HEADING = """Where the stage's axes lie in the world, made by 'teatbench calibrate stage' or at the
start of a run. Lengths in mm. X_world = R(om) X_stage + T, om in rad, for the end of the
teat that was touched. Make it anew when stage, table frame or arm were moved. Scale and
squareness (0 is ideal) are diagnostics: the rigid motion carries."""

Number = Annotated[float, Field(allow_inf_nan=False)]
Above = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Three = tuple[Number, Number, Number]


class _Stated(Section):
    scale_u: NotNegative
    squareness_u_rad: NotNegative
    repeatability_mm: NotNegative


class _Station(Section):
    stage_mm: Three
    touched_mm: Three
    u_mm: Above
    residual_mm: NotNegative


class _Diagnostic(Section):
    name: str
    value: Number
    u: NotNegative
    significant: bool


class _Fit(Section):
    model: str
    fre_mm: NotNegative
    held_out_mm: NotNegative | None = None
    singular_values: Three


class _RegistrationFile(Section):
    made: AwareDatetime
    serial_number: str
    stage: str
    teat: Annotated[int, Field(ge=1)]
    om: Three
    T: Three
    u_mm: Above
    fre_mm: NotNegative
    expected_fre_mm: NotNegative
    p_value: Annotated[float, Field(ge=0, le=1)]
    stated: _Stated
    stations: Annotated[tuple[_Station, ...], Field(min_length=3)]
    diagnostics: tuple[_Diagnostic, ...]
    fits: tuple[_Fit, ...]


def as_dict(registration: Registration) -> dict[str, Any]:
    """Everything of it, as the file and the run's record keep it."""
    r, fits = registration, registration.comparison
    residuals = np.linalg.norm(fits.rigid.residuals_mm, axis=1).tolist()
    return {
        "made": r.made,
        "serial_number": r.serial_number,
        "stage": r.stage,
        "teat": r.teat,
        "om": r.world_from_stage.om.tolist(),
        "T": r.world_from_stage.T.tolist(),
        "u_mm": r.u_mm,
        "fre_mm": fits.rigid.fre_mm,
        "expected_fre_mm": r.expected_fre_mm,
        "p_value": r.p_value,
        "stated": asdict(r.stated),
        "stations": [
            {**asdict(s), "residual_mm": residual}
            for s, residual in zip(r.stations, residuals, strict=True)
        ],
        "diagnostics": [{**asdict(d), "significant": d.significant} for d in r.diagnostics],
        "fits": [
            {
                "model": f.model,
                "fre_mm": f.fre_mm,
                "held_out_mm": fits.held_out_mm[f.model],
                "singular_values": f.singular_values.tolist(),
            }
            for f in fits.fits
        ],
    }


def as_facts(registration: Registration) -> dict[str, Any]:
    """The same as facts of a run; when it was made stands apart, since one made at the run's start
    doesn't repeat with the seed.
    """
    whole = as_dict(registration)
    return {MADE_FACT: whole.pop("made").isoformat(), REGISTRATION_FACT: whole}


def registration_text(registration: Registration) -> str:
    """The text of its file."""
    return toml_text(as_dict(registration), HEADING)


def write_registration(path: Path, registration: Registration) -> None:
    """Write its file, whole or not at all. Raises ConfigError where the folder can't be written."""
    write_file(path, registration_text(registration))


def load_registration(path: Path) -> Registration:
    """The registration at ``path``. Raises ConfigError with all faults, each in its place."""
    file = read_config(path, _RegistrationFile)
    try:
        found = _registration(file)
    except RegistrationError as error:
        raise located(path, read_text(path), [(("stations",), str(error), False)]) from error
    written = Motion.from_vectors(file.om, file.T)
    reach = max(float(np.abs(found.stage_mm).max()), 1.0)
    right = {
        "om": bool(np.abs(written.R - found.world_from_stage.R).max() * reach <= FOLLOWS_MM),
        "T": bool(np.abs(written.T - found.world_from_stage.T).max() <= FOLLOWS_MM),
        "u_mm": abs(file.u_mm - found.u_mm) <= FOLLOWS_MM,
        "fre_mm": abs(file.fre_mm - found.comparison.rigid.fre_mm) <= FOLLOWS_MM,
    }
    message = "doesn't follow from what was touched: the file was changed by hand. Make it anew"
    wrong = [((key,), message, False) for key, held in right.items() if not held]
    if wrong:
        raise located(path, read_text(path), wrong)
    return found


def registration_from_facts(facts: Mapping[str, Any]) -> Registration | None:
    """The registration among a run's facts (`as_facts`); None where there is none."""
    if REGISTRATION_FACT not in facts:
        return None
    return _registration(
        _RegistrationFile.model_validate({"made": facts[MADE_FACT], **facts[REGISTRATION_FACT]})
    )


def _registration(file: _RegistrationFile) -> Registration:
    stations = tuple(Station(s.stage_mm, s.touched_mm, s.u_mm) for s in file.stations)
    stated = StageAccuracy(**file.stated.model_dump())
    return Registration(file.made, file.serial_number, file.stage, file.teat, stations, stated)
