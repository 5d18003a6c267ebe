"""Where the stage's axes lie in the world, from touches of one teat end at three or more stage
positions; how far that holds; and the dated file of it.

A rigid motion carries (`world_from_stage`). Scale per axis and squareness are diagnostics only: a
misfit may as well be the arm's as the stage's. What the axes may be off by is stated in the rig
file and enters the uncertainty of everything carried. Where the touches cast doubt on that
statement (a chi-square test at `DOUBT`), what they show is put on top. They resolve little (some 2
mm/m): of a stage five to ten times worse, a 95 % region would hold 84 to 92 % of poses at 0.01 or
0.2, and holds 94 to 97 % at 0.4. Where they contradict it (at `ALPHA`), the report says what to
mend.

E = [[sx, -gxy, -gxz], [0, sy, -gyz], [0, 0, sz]]: a stage that is sent by D goes by (I + E)
D, in its own axes. The x axis is the reference, and g is by how much the angle between two axes
exceeds a right one. With q the touched positions less their mean, touch noise n turns a rigid fit
by w = H^-1 sum q x n, H = sum(|q|^2 I - q q^T), and axes that are off by E turn it by w = H^-1 sum
q x E q; a carry by D is then off by w x D - E D. All to first order, in the stage's own axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from functools import cached_property
from math import sqrt
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import AwareDatetime, Field

from bench.config import FileTable, Positive, located, read_config, read_text, write_file
from bench.rig.arm_files import NotNegative, Three, refuse_changed
from bench.scoring.errors import Floats
from bench.toml import toml_text
from bench.truth.uncertainty import Triple
from detector.calibration.rigid import (
    Comparison,
    compare,
    cross_matrix,
    rotation_covariance,
    target_error_mm,
)
from detector.geometry import Motion, rigid_fit

NAMES = ("scale x", "scale y", "squareness xy", "scale z", "squareness xz", "squareness yz")
_FLAT_MM = 1.0  # a height that varies by less has not been exercised


class StageAccuracy(FileTable):
    """The stage's stated standard uncertainties."""

    scale_u: NotNegative
    squareness_u_rad: NotNegative
    repeatability_mm: NotNegative

    @property
    def deformation(self) -> Floats:
        """Variances (6,) in the order of `NAMES`."""
        s, g = self.scale_u**2, self.squareness_u_rad**2
        return np.array([s, s, g, s, g, g])


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """How far one property of the axes is from ideal (0), with its standard uncertainty ``u``."""

    name: str
    value: float
    u: float

    @property
    def significant(self) -> bool:
        """Beyond what touch noise explains in 99 of 100 cases."""
        return abs(self.value) > 2.576 * self.u


@dataclass(frozen=True, slots=True, eq=False)
class FreeFit:
    """Small ``rotation`` (3,), ``theta`` (3 or 6,) and their ``covariance`` for u = 1 mm."""

    rotation: Floats
    theta: Floats
    covariance: Floats
    left_over: Floats
    freedom: int


# the matrices (6, 3, 3) of E's entries, in the order of `NAMES`
_ENTRIES = np.zeros((6, 3, 3))
for _i, (_row, _column) in enumerate(((0, 0), (1, 1), (0, 1), (2, 2), (0, 2), (1, 2))):
    _ENTRIES[_i, _row, _column] = 1.0 if _row == _column else -1.0


DOUBT, ALPHA = 0.4, 0.01
# rms extent across; nearer together, an arm of 0.23 mm turns the fit by more than 3 mrad
SPREAD_MM = 40.0
# farther off than both, it was another teat, or something slipped: no stage is so crooked
GROSS_MM = 5.0
GROSS_U = 15.0  # in stated uncertainties


class RegistrationError(ValueError):
    """The touches give no registration; the sentence says why, and what to do."""


@dataclass(frozen=True, slots=True)
class Station:
    """A stage position (machine mm, read back) and the end touched there (world mm)."""

    stage_mm: Triple
    touched_mm: Triple
    u_mm: float


# no slots: a cached_property keeps its value in the instance
@dataclass(frozen=True, eq=False)
class Registration:
    """``world_from_stage`` takes a stage position to where teat ``teat``'s end then is. At least
    three ``stations``, not on a line.
    """

    made: datetime
    serial_number: str
    stage: str
    teat: int
    stations: tuple[Station, ...]
    stated: StageAccuracy

    def __post_init__(self) -> None:
        if len(self.stations) < 3:
            raise RegistrationError(
                "a registration needs touches at three or more stage positions, has"
                f" {len(self.stations)}"
            )
        across = np.linalg.svd(self._q, compute_uv=False)[1] / sqrt(len(self.stations))
        if across < SPREAD_MM:
            raise RegistrationError(
                f"the stage positions lie nearly on a line or near together ({across:.0f} mm rms"
                f" across, {SPREAD_MM:g} mm are needed). Touch at positions further apart, as at"
                " the corners of the travel"
            )
        off = np.linalg.norm(self.touched_mm - self.world_from_stage.apply(self.stage_mm), axis=1)
        if off.max() > max(GROSS_MM, GROSS_U * self.stated_u_mm):
            raise RegistrationError(
                f"the touch at position {int(np.argmax(off)) + 1} of {len(off)} is {off.max():.1f}"
                " mm from where the others put it. Was another teat touched, or did stage or"
                " phantom slip? Touch all again"
            )

    @cached_property
    def world_from_stage(self) -> Motion:
        """The rigid fit; it carries."""
        return rigid_fit(self.touched_mm, self.stage_mm)

    @property
    def stage_mm(self) -> Floats:
        return np.array([s.stage_mm for s in self.stations])

    @property
    def touched_mm(self) -> Floats:
        """Touched ends (n, 3), world."""
        return np.array([s.touched_mm for s in self.stations])

    @cached_property
    def comparison(self) -> Comparison:
        return compare(self.touched_mm, self.stage_mm)

    @property
    def stated_u_mm(self) -> float:
        """Standard uncertainty of one touch along an axis, from the touches' own budgets."""
        return float(np.sqrt(np.mean([s.u_mm**2 for s in self.stations])))

    @property
    def expected_fre_mm(self) -> float:
        """<FRE> = sqrt(1 - 2/N) FLE for touches as good as stated."""
        return sqrt((1.0 - 2.0 / len(self.stations)) * 3.0) * self.stated_u_mm

    @cached_property
    def u_mm(self) -> float:
        """As stated, or as the touches scatter (Birge ratio; chi-square test at `ALPHA`)."""
        freedom = self._free.freedom
        chi2 = float(np.sum(self._free.left_over**2)) / self.stated_u_mm**2
        if freedom and scipy.special.chdtrc(freedom, chi2) < ALPHA:
            return self.stated_u_mm * sqrt(chi2 / freedom)
        return self.stated_u_mm

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """Of the axes that the positions exercise; of z where the height varied."""
        u = np.sqrt(np.diag(self._theta_covariance))
        rows = zip(NAMES, self._free.theta.tolist(), u.tolist(), strict=False)
        return tuple(Diagnostic(*row) for row in rows)

    @cached_property
    def p_value(self) -> float:
        """How likely the diagnostics are, if stage and touches are as good as stated."""
        theta = self._free.theta
        expected = self._theta_covariance + np.diag(self.stated.deformation[: len(theta)])
        return float(scipy.special.chdtrc(len(theta), theta @ np.linalg.solve(expected, theta)))

    @property
    def doubted(self) -> bool:
        """The axes may be worse than stated; the carry's uncertainty covers what is seen."""
        return self.p_value < DOUBT

    @property
    def contradicted(self) -> bool:
        return self.p_value < ALPHA

    def carry_covariance_mm2(self, stage_from_mm: ArrayLike, stage_to_mm: ArrayLike) -> Floats:
        """Covariance (3, 3), world axes, of a carry between stage positions (3,)."""
        way = np.subtract(stage_to_mm, stage_from_mm)
        turn = cross_matrix(way)
        noise = turn @ self._turn_covariance @ turn.T
        bent = self._bent_mm(way)
        deformed = bent @ self._deformation @ bent.T
        R = self.world_from_stage.R
        return np.asarray(
            R @ (noise + deformed) @ R.T + 2.0 * self.stated.repeatability_mm**2 * np.eye(3)
        )

    def carry_parts_mm(self, ways_mm: Floats) -> Floats:
        """What carries by ``ways_mm`` (n, 3), machine axes, share: columns (n, 3, 9) of unit
        variance for turn and axes; they make `carry_covariance_mm2` but for the repeatability.
        """
        turn = _root(self._turn_covariance)
        bend, R = _root(self._deformation), self.world_from_stage.R
        parts = [
            np.column_stack([cross_matrix(way) @ turn, self._bent_mm(way) @ bend])
            for way in ways_mm
        ]
        return np.asarray(R @ np.array(parts).reshape(-1, 3, 9))

    @cached_property
    def _turn_covariance(self) -> Floats:
        return rotation_covariance(self.stage_mm, self.u_mm)

    @cached_property
    def _turned(self) -> Floats:
        """(6, 3): how each entry of E turns the fit."""
        inverse = np.linalg.inv(np.sum(self._q**2) * np.eye(3) - self._q.T @ self._q)
        turns = [np.sum(np.cross(self._q, self._q @ entry.T), axis=0) for entry in _ENTRIES]
        return np.array([inverse @ turn for turn in turns])

    def _bent_mm(self, way_mm: Floats) -> Floats:
        """(3, 6): the error of a carry by ``way_mm`` (3,) for each entry of E."""
        return np.asarray(np.cross(self._turned, way_mm) - _ENTRIES @ way_mm).T

    def carry_mm(self, stage_from_mm: ArrayLike, stage_to_mm: ArrayLike) -> Floats:
        """By how much (3,) every teat end moves in the world."""
        return np.asarray(self.world_from_stage.R @ np.subtract(stage_to_mm, stage_from_mm))

    def target_error_mm(self, stage_mm: ArrayLike) -> float:
        """Expected error at a stage position, from the touches alone (Fitzpatrick's formula)."""
        return float(
            target_error_mm(sqrt(3.0) * self.u_mm, self.stage_mm, np.atleast_2d(stage_mm))[0]
        )

    def outdated(self, serial_number: str, frame_made: datetime | None) -> str:
        """Why it doesn't hold for this arm and its table frame (None without one); else empty."""
        if self.serial_number != serial_number:
            return (
                f"was made with the arm {self.serial_number}, but the arm that answers is"
                f" {serial_number}"
            )
        if frame_made is not None and frame_made > self.made:
            return (
                f"was made on {self.made:%Y-%m-%d %H:%M}, before the arm's table frame"
                f" ({frame_made:%Y-%m-%d %H:%M})"
            )
        return ""

    @property
    def faults(self) -> tuple[str, ...]:
        """Why this stage or these touches are in doubt, a sentence each."""
        text = []
        if self.contradicted:
            off = [
                f"{d.name} {d.value:+.2e} (u {d.u:.1e})" for d in self.diagnostics if d.significant
            ] or ["all of them together"]
            text.append(
                f"The stage's axes are worse than the rig file states (p = {self.p_value:.1e}):"
                f" {'; '.join(off)}. Set its steps per mm, square its axes, or state scale_u and"
                " squareness_u_rad as they are; until then every carried truth is less certain."
            )
        if self.u_mm > self.stated_u_mm:
            text.append(
                f"The touches scatter more than their budget says: u = {self.u_mm:.2f} mm along an"
                f" axis, not {self.stated_u_mm:.2f} mm."
            )
        return tuple(text)

    @cached_property
    def _q(self) -> Floats:
        at = np.array([s.stage_mm for s in self.stations])
        return np.asarray(at - at.mean(axis=0))

    @cached_property
    def _free(self) -> FreeFit:
        """Of the positions to the touches, both centred; heights only where they varied."""
        q, touched = self._q, self.touched_mm
        seen = (touched - touched.mean(axis=0)) @ self.world_from_stage.R
        high = np.std(q[:, 2]) > _FLAT_MM and np.linalg.svd(q, compute_uv=False)[2] > _FLAT_MM
        turns = [np.cross(axis, q).ravel() for axis in np.eye(3)]
        bends = [(q @ entry.T).ravel() for entry in _ENTRIES[: 6 if high else 3]]
        design, off = np.column_stack([*turns, *bends]), (seen - q).ravel()
        found = np.asarray(np.linalg.lstsq(design, off, rcond=None)[0], dtype=np.float64)
        covariance = np.asarray(np.linalg.inv(design.T @ design), dtype=np.float64)
        left_over, freedom = np.asarray(off - design @ found), 3 * len(q) - 3 - design.shape[1]
        return FreeFit(found[:3], found[3:], covariance, left_over, freedom)

    @property
    def _theta_covariance(self) -> Floats:
        return np.asarray(self.u_mm**2 * self._free.covariance[3:, 3:])

    @cached_property
    def _deformation(self) -> Floats:
        """Second moments (6, 6) of E: as stated, in doubt with what touches show."""
        moments = np.diag(self.stated.deformation)
        if self.doubted:
            theta = self._free.theta
            k = len(theta)
            moments[:k, :k] += np.outer(theta, theta) + self._theta_covariance
        return np.asarray(moments)


def _root(covariance: Floats) -> Floats:
    """A matrix whose product with its transpose it is; it may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


REGISTRATION_FACT, MADE_FACT = "stage registration", "wall_registered"
HEADING = """Where the stage's axes lie in the world, made by 'teatbench calibrate stage' or at the
start of a run. Lengths in mm. X_world = R(om) X_stage + T, om in rad, for the end of the
teat that was touched. Make it anew when stage, table frame or arm were moved. Scale and
squareness (0 is ideal) are diagnostics: the rigid motion carries."""


class _Station(FileTable):
    stage_mm: Three
    touched_mm: Three
    u_mm: Positive
    residual_mm: NotNegative


class _RegistrationFile(FileTable):
    made: AwareDatetime
    serial_number: str
    stage: str
    teat: Annotated[int, Field(ge=1)]
    om: Three
    T: Three
    u_mm: Positive
    fre_mm: NotNegative
    expected_fre_mm: NotNegative
    p_value: Annotated[float, Field(ge=0, le=1)]
    stated: StageAccuracy
    stations: Annotated[tuple[_Station, ...], Field(min_length=3)]
    # for people: they follow from the touches
    diagnostics: tuple[dict[str, Any], ...]
    fits: tuple[dict[str, Any], ...]


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
        "stated": r.stated.model_dump(),
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
    """The same as facts of a run; its date, which doesn't repeat with the seed, stands apart."""
    whole = as_dict(registration)
    return {MADE_FACT: whole.pop("made").isoformat(), REGISTRATION_FACT: whole}


def registration_text(registration: Registration) -> str:
    return toml_text(as_dict(registration), HEADING)


def write_registration(path: Path | str, registration: Registration) -> None:
    """Write its file, whole or not at all. Raises ConfigError where the folder can't be written."""
    write_file(Path(path), registration_text(registration))


def load_registration(path: Path) -> Registration:
    """The registration at ``path``, worked out again from the touches. Raises ConfigError with all
    faults, each in its place; also where the file's figures don't follow from its touches.
    """
    file = read_config(path, _RegistrationFile)
    try:
        found = _registration(file)
    except RegistrationError as error:
        raise located(path, read_text(path), [(("stations",), str(error), False)]) from error
    follows = as_dict(found)
    refuse_changed(path, file, {key: follows[key] for key in ("om", "T", "u_mm", "fre_mm")})
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
    return Registration(file.made, file.serial_number, file.stage, file.teat, stations, file.stated)
