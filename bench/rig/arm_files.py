"""The two dated files about an arm: where it stands (`arm-frame.toml`), and how good it is
(`arm-verification.toml`).

The table frame follows the 3-2-1 rule: the first touch is the origin, the second lies on the x
axis, the third in the plane z = 0 on the side of positive y. Nothing is averaged, so every further
touch is an independent check and gives a residual.

A verification has the two tests that standards give for arms. Articulated location: the tip sits in
one conical divot while wrist and elbow swing. Every reading is of one point, so what they differ by
is the arm's error. Length: a calibrated distance, both ends touched, in several directions. After
ASME B89.4.22 (single point articulation; volumetric performance) and ISO 10360-12 (articulated
location; length), but for two things: a tip in a divot stands for their sphere, and the tester
chooses how many.

Both files hold what was touched, and beside it what follows from it, for people and other programs.
Reading works the figures out again from the touches and refuses a file whose figures don't follow:
it was changed by hand. A frame of another arm is refused too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from itertools import combinations
from math import sqrt
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AwareDatetime, ConfigDict, Field, PlainSerializer, PlainValidator, TypeAdapter

from bench.config import FileTable, KeyPath, located, read_config, read_text
from bench.toml import toml_text
from detector.geometry import Motion
from textfiles.text import plural

Floats = Annotated[
    NDArray[np.float64],
    PlainValidator(lambda rows: np.array(rows, dtype=np.float64)),
    PlainSerializer(np.ndarray.tolist),
]
Triple = tuple[float, float, float]

DEFINING = ("origin", "x axis", "plane")
# nearer together, an arm of 0.23 mm turns the frame by more than 3 mrad: 1.5 mm at half a metre
APART_MM = 100.0
_STEP_MM = 1e-3


class TableFrameError(ValueError):
    """The touches give no frame."""


@dataclass(frozen=True, slots=True)
class TouchedPoint:
    """One touch and its reading's spread. Without ``world_mm``, a check point lies in z = 0."""

    name: str
    arm_mm: Triple
    spread_mm: float = 0.0
    world_mm: Triple | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TableFrame:
    """``world_from_arm`` of one arm; the first three ``points`` define it, the others check it."""

    made: datetime
    serial_number: str
    points: tuple[TouchedPoint, ...]
    world_from_arm: Motion

    @classmethod
    def from_touches(
        cls, made: datetime, serial_number: str, points: Sequence[TouchedPoint]
    ) -> TableFrame:
        """From at least three touches, as `DEFINING`, then check points. Raises FrameError."""
        if len(points) < len(DEFINING):
            raise TableFrameError(
                f"a table frame needs three touches (origin, on x, in the plane), not {len(points)}"
            )
        names = [point.name for point in points]
        if len(set(names)) < len(names):
            raise TableFrameError(f"two touches have the same name: {', '.join(names)}")
        motion = world_from_arm([point.arm_mm for point in points[:3]])
        return cls(made, serial_number, tuple(points), motion)

    @property
    def residuals_mm(self) -> dict[str, float]:
        """Distance of each check point from its known place, or from the plane z = 0."""
        off = {}
        for point in self.points[3:]:
            found = self.world_from_arm.apply(point.arm_mm)
            known = (*found[:2], 0.0) if point.world_mm is None else point.world_mm
            off[point.name] = float(np.linalg.norm(found - np.array(known)))
        return off

    @property
    def residual_mm(self) -> float | None:
        return max(self.residuals_mm.values(), default=None)

    @property
    def hangs(self) -> bool:
        """Whether the arm's z axis points down: it hangs, or the third touch was wrong."""
        return bool(self.world_from_arm.R[2, 2] < 0.0)

    def parts(self, world_mm: ArrayLike) -> Floats:
        """What points ``world_mm`` (n, 3) share through the frame, (n, 3, 9): their derivatives by
        each coordinate of the three touches, taken numerically.
        """
        touched = np.array([point.arm_mm for point in self.points[:3]])
        seen = self.world_from_arm.inverse().apply(world_mm)
        columns = []
        for step in np.eye(9).reshape(9, 3, 3) * _STEP_MM:
            ends = [world_from_arm(touched + sign * step).apply(seen) for sign in (1.0, -1.0)]
            columns.append((ends[0] - ends[1]) / (2.0 * _STEP_MM))
        return np.stack(columns, axis=-1)

    def u_registration_mm(self, world_mm: ArrayLike, u_mm: float) -> float:
        """Standard uncertainty along an axis that the frame adds at ``world_mm`` (3,): each
        coordinate of the three touches has ``u_mm``, uncorrelated (JCGM 100:2008, 5.1.2).
        """
        parts = self.parts(np.reshape(world_mm, (1, 3)))[0]
        squares = sum(float(np.sum(np.square(column))) for column in parts.T)
        return u_mm * sqrt(squares / 3.0)


def world_from_arm(touched_mm: ArrayLike) -> Motion:
    """From touches (3, 3) mm: origin, on x, in the plane. Raises FrameError if in a line."""
    touched = np.asarray(touched_mm, dtype=np.float64)
    if touched.shape != (3, 3) or not np.isfinite(touched).all():
        raise TableFrameError(
            f"a table frame is made of three points in space, not of {touched.tolist()}"
        )
    origin, on_x, in_plane = touched

    def direction(way: Floats, sentence: str) -> Floats:
        if (distance_mm := float(np.linalg.norm(way))) < APART_MM:
            raise TableFrameError(
                f"{sentence.format(f'{distance_mm:.1f} mm')}; {APART_MM:g} mm are needed. Touch a"
                " point further away"
            )
        return way / distance_mm

    x = direction(on_x - origin, "the touch on the x axis is {} from the origin")
    y = direction(
        (in_plane - origin) - ((in_plane - origin) @ x) * x,
        "the third touch is {} from the x axis, so the three are nearly in a line",
    )
    R = np.stack([x, y, np.cross(x, y)])
    return Motion(R, -R @ origin)


LEAST_TOUCHES = 5  # the orientations of ISO 10360-12
TOUCHES = 10  # of ASME B89.4.22, single point articulation
LEAST_SWING_DEG = 30.0  # with less, the joints hardly moved, and the test could not fail


@dataclass(frozen=True, slots=True, eq=False)
class LocationTest:
    """Readings of one divot: ``tips_mm``, unit ``axes`` of the stylus (n, 3), n >= 2."""

    where: str
    tips_mm: Floats
    axes: Floats | None

    def __post_init__(self) -> None:
        if (
            self.tips_mm.ndim != 2
            or self.tips_mm.shape[1:] != (3,)
            or (self.axes is not None and self.tips_mm.shape != self.axes.shape)
            or len(self.tips_mm) < 2
        ):
            axes = "no" if self.axes is None else self.axes.shape
            raise ValueError(
                "a location test needs (n, 3) tips and axes, n at least 2; got"
                f" {self.tips_mm.shape} and {axes}"
            )

    @property
    def n(self) -> int:
        return len(self.tips_mm)

    @property
    def centre_mm(self) -> Floats:
        return np.asarray(self.tips_mm.mean(axis=0))

    @property
    def deviations_mm(self) -> Floats:
        """Distance of each reading from the mean (n,): delta_i of ASME B89.4.22."""
        return np.asarray(np.linalg.norm(self.tips_mm - self.centre_mm, axis=1))

    @property
    def largest_mm(self) -> float:
        """The articulated location error: the largest deviation."""
        return float(self.deviations_mm.max())

    @property
    def two_sd_mm(self) -> float:
        """2 s with s^2 = sum(delta_i^2) / (n - 1), as ASME B89.4.22 states it."""
        return 2.0 * float(np.sqrt(np.sum(self.deviations_mm**2) / (self.n - 1)))

    @property
    def sphere_mm(self) -> float:
        """Diameter of the least sphere round all readings (ISO 10360-12)."""
        return least_sphere_mm(self.tips_mm)

    @property
    def swing_deg(self) -> float | None:
        """The largest angle between two stylus directions; None where they are not known."""
        if self.axes is None:
            return None
        return float(np.degrees(np.arccos(np.clip((self.axes @ self.axes.T).min(), -1.0, 1.0))))


@dataclass(frozen=True, slots=True, eq=False)
class LengthTest:
    """One calibrated length, with its standard uncertainty: its ends as touched (3,), mm.
    ``ends_mm2``: covariance (3, 3) of b - a for touches of 1 mm along each axis, where an end was
    worked out of several (None: one touch each).
    """

    where: str
    a_mm: Floats
    b_mm: Floats
    calibrated_mm: float
    calibrated_u_mm: float = 0.0
    ends_mm2: Floats | None = None

    @property
    def measured_mm(self) -> float:
        return float(np.linalg.norm(self.b_mm - self.a_mm))

    @property
    def error_mm(self) -> float:
        return self.measured_mm - self.calibrated_mm

    @property
    def touches(self) -> float:
        """Of how many touches' variance its error is: 2 for one at each end."""
        if self.ends_mm2 is None:
            return 2.0
        way = (self.b_mm - self.a_mm) / self.measured_mm
        return float(way @ self.ends_mm2 @ way)


@dataclass(frozen=True, slots=True)
class VerificationLimits:
    """What an arm has to keep, mm. ``length_mm`` is None where lengths are not asked for."""

    location_mm: float
    length_mm: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Verification:
    __pydantic_config__ = ConfigDict(defer_build=True)  # few commands read one

    made: datetime
    serial_number: str
    locations: tuple[LocationTest, ...]
    lengths: tuple[LengthTest, ...] = ()
    gauge: str = ""  # which calibrated length, and its certificate

    @property
    def location_mm(self) -> float:
        """The largest articulated location error over the distances."""
        return max(test.largest_mm for test in self.locations)

    @property
    def length_mm(self) -> float | None:
        """The largest error of a length, without its sign; None where none was measured."""
        return max((abs(test.error_mm) for test in self.lengths), default=None)

    @property
    def length_two_rms_mm(self) -> float | None:
        """2 sqrt(sum(e^2) / n), volumetric performance of ASME B89.4.22; None without lengths."""
        errors = [test.error_mm for test in self.lengths]
        return 2.0 * float(np.sqrt(np.mean(np.square(errors)))) if errors else None

    def faults(self, limits: VerificationLimits) -> tuple[str, ...]:
        """A sentence for each broken limit and each gap. Empty: verified."""
        return (*self.broken(limits), *self.gaps(limits))

    def broken(self, limits: VerificationLimits) -> tuple[str, ...]:
        found = [fault for test in self.locations for fault in broken_by(test, limits.location_mm)]
        worst = max(self.lengths, key=lambda test: abs(test.error_mm), default=None)
        if worst and limits.length_mm is not None and abs(worst.error_mm) > limits.length_mm:
            found.append(
                f"{worst.where}: {worst.calibrated_mm:g} mm were measured {worst.error_mm:+.2f} mm"
                f" wrong, limit {limits.length_mm:.3g} mm"
            )
        return tuple(found)

    def gaps(self, limits: VerificationLimits) -> tuple[str, ...]:
        """A sentence for each thing not shown: too few touches, too little swing, no length."""
        found = [gap for test in self.locations for gap in gaps_of(test, LEAST_TOUCHES)]
        if limits.length_mm is not None and not self.lengths:
            found.append("no calibrated length was measured")
        return tuple(found)


_VERIFICATION = TypeAdapter(Verification)


def as_dict(verification: Verification) -> dict[str, Any]:
    """Plain numbers and text: what was touched, from which all figures follow."""
    touched: dict[str, Any] = _VERIFICATION.dump_python(verification)
    return {**touched, "made": verification.made.isoformat()}


def from_dict(table: Mapping[str, Any]) -> Verification:
    return _VERIFICATION.validate_python(table)


def broken_by(test: LocationTest, limit_mm: float) -> list[str]:
    said = f"{test.where}: readings of one point lie up to {test.largest_mm:.2f} mm from their mean"
    return [f"{said}, limit {limit_mm:.3g} mm"] if test.largest_mm > limit_mm else []


def gaps_of(test: LocationTest, least: int) -> list[str]:
    """Why a test at one divot shows too little, whatever its figures."""
    gaps = []
    if test.swing_deg is None:
        gaps.append(
            f"{test.where}: how far the stylus swung is not known; give i, j and k with the points"
        )
    elif test.swing_deg < LEAST_SWING_DEG:
        gaps.append(
            f"{test.where}: the stylus was swung by {test.swing_deg:.0f} degrees only;"
            f" {LEAST_SWING_DEG:g} are needed"
        )
    if test.n < least:
        gaps.append(f"{test.where}: {plural(test.n, 'touch')} only; {least} are needed")
    return gaps


def axes_of(directions: Sequence[ArrayLike | None]) -> Floats | None:
    """Directions (n, 3); None where one of them is not known."""
    known = [one for one in directions if one is not None]
    return np.array(known, dtype=np.float64) if len(known) == len(directions) else None


def swing_text(test: LocationTest) -> str:
    if test.swing_deg is None:
        return "how far the stylus swung is not known"
    return f"the stylus swung by {test.swing_deg:.0f} degrees"


def least_sphere_mm(points_mm: Floats) -> float:
    """Diameter of the least sphere round points (n, 3), 0 for one: the largest of the least spheres
    of all sets of two, three and four of them. For a few dozen points.
    """
    return max(
        (
            _sphere_of(points_mm[list(few)])
            for k in (2, 3, 4)
            for few in combinations(range(len(points_mm)), k)
        ),
        default=0.0,
    )


def _sphere_of(few: Floats) -> float:
    """Diameter of the sphere through points (k, 3), centred in their plane; 0 if not the least."""
    sides = few[1:] - few[0]
    weights, *_ = np.linalg.lstsq(2.0 * sides @ sides.T, np.sum(sides**2, axis=1), rcond=None)
    if (weights < 0.0).any() or weights.sum() > 1.0:
        return 0.0  # the centre is outside their hull, so fewer of them have the same least sphere
    return 2.0 * float(np.linalg.norm(weights @ sides))


FOLLOWS_MM = 1e-3  # what is written follows from the touches to better than this
FRAME_HEADING = """Where the arm stands on the table, made by 'teatbench arm frame'. Lengths in mm.
X_world = R(om) X_arm + T, om in rad. Make it anew when the arm or the
table was moved, or another arm is used."""
VERIFICATION_HEADING = """How good the arm was on this day, made by 'teatbench arm verify'.
Lengths in mm. Figures after ASME B89.4.22 and ISO 10360-12. A run holds these figures
against the limits of its own script."""

UNFINISHED_HEADING = (
    """Touches of 'teatbench arm verify' that did not come to its end: no verification."""
)

Number = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Three = tuple[Number, Number, Number]


class _Point(FileTable):
    name: str
    arm_mm: Three
    spread_mm: NotNegative
    world_mm: Three | None = None
    residual_mm: NotNegative | None = None


class _ArmFile(FileTable):
    made: AwareDatetime
    serial_number: str


class _FrameFile(_ArmFile):
    om: Three
    T: Three
    residual_mm: NotNegative | None = None
    points: Annotated[tuple[_Point, ...], Field(min_length=3)]


class _Location(FileTable):
    where: str
    n: int
    largest_mm: NotNegative
    two_sd_mm: NotNegative
    sphere_mm: NotNegative
    swing_deg: NotNegative | None = None
    tips_mm: Annotated[tuple[Three, ...], Field(min_length=2)]
    axes: Annotated[tuple[Three, ...], Field(min_length=2)] | None = None


class _Length(FileTable):
    where: str
    calibrated_mm: Annotated[float, Field(gt=0)]
    calibrated_u_mm: NotNegative = 0.0
    error_mm: Number
    a_mm: Three
    b_mm: Three
    ends_mm2: tuple[Three, Three, Three] | None = None


class _LimitsTable(FileTable):
    location_mm: Annotated[float, Field(gt=0)]
    length_mm: Annotated[float, Field(gt=0)] | None = None


class _VerificationFile(_ArmFile):
    passed: bool
    gauge: str = ""
    location_mm: NotNegative
    length_mm: NotNegative | None = None
    length_two_rms_mm: NotNegative | None = None
    limits: _LimitsTable
    location: Annotated[tuple[_Location, ...], Field(min_length=1)]
    length: tuple[_Length, ...] = ()


def frame_text(frame: TableFrame) -> str:
    return toml_text(_frame_table(frame), FRAME_HEADING)


def _frame_table(frame: TableFrame) -> dict[str, Any]:
    motion, off = frame.world_from_arm, frame.residuals_mm
    return {
        "made": frame.made,
        "serial_number": frame.serial_number,
        "om": motion.om.tolist(),
        "T": motion.T.tolist(),
        "residual_mm": frame.residual_mm,
        "points": [{**asdict(p), "residual_mm": off.get(p.name)} for p in frame.points],
    }


def load_frame(path: Path, *, serial_number: str | None = None) -> TableFrame:
    """The frame at ``path``, of the arm ``serial_number`` if given. ConfigError."""
    file = read_config(path, _FrameFile)
    if serial_number not in (None, file.serial_number):
        message = (
            f"this file is of the arm {file.serial_number}, but the arm that answers is"
            f" {serial_number}. Make the frame anew with this arm: 'teatbench arm frame'"
        )
        raise located(path, read_text(path), [(("serial_number",), message, False)])
    points = [TouchedPoint(p.name, p.arm_mm, p.spread_mm, p.world_mm) for p in file.points]
    try:
        frame = TableFrame.from_touches(file.made, file.serial_number, points)
    except TableFrameError as error:
        raise located(path, read_text(path), [(("points",), str(error), False)]) from error
    refuse_changed(path, file, _frame_table(frame))
    return frame


def verification_text(verification: Verification, limits: VerificationLimits) -> str:
    return toml_text(_verification_table(verification, limits), VERIFICATION_HEADING)


def _verification_table(found: Verification, limits: VerificationLimits) -> dict[str, Any]:
    touched = as_dict(found)

    def rows(name: str, *keys: str) -> list[dict[str, Any]]:
        tests = zip(getattr(found, name), touched[name], strict=True)
        return [{**{key: getattr(test, key) for key in keys}, **row} for test, row in tests]

    whole = ("made", "serial_number", "gauge", "location_mm", "length_mm", "length_two_rms_mm")
    return {
        **{key: getattr(found, key) for key in whole},
        "passed": not found.faults(limits),
        "limits": asdict(limits),
        "location": rows(
            "locations", "where", "n", "largest_mm", "two_sd_mm", "sphere_mm", "swing_deg"
        ),
        "length": rows("lengths", "where", "calibrated_mm", "error_mm") or None,
    }


def unfinished_text(found: Verification) -> str:
    """What was measured of a verification that has not ended. No file of a rig may name it."""
    touched = as_dict(found)
    head = {"unfinished": True, "made": found.made, "serial_number": found.serial_number}
    rows = {"location": touched["locations"], "length": touched["lengths"] or None}
    return toml_text({**head, "gauge": found.gauge, **rows}, UNFINISHED_HEADING)


def load_verification(path: Path) -> Verification:
    """The verification at ``path``. Raises ConfigError with all faults, each in its place."""
    file = read_config(path, _VerificationFile)
    uneven = [
        (("location", i, "axes"), "must have a row for each of tips_mm", False)
        for i, test in enumerate(file.location)
        if test.axes is not None and len(test.tips_mm) != len(test.axes)
    ]
    if uneven:
        raise located(path, read_text(path), uneven)
    said = file.model_dump()
    found = from_dict({**said, "locations": said["location"], "lengths": said["length"]})
    refuse_changed(path, file, _verification_table(found, VerificationLimits(**said["limits"])))
    return found


def refuse_changed(path: Path, file: FileTable, follows: Mapping[str, Any]) -> None:
    """Raises ConfigError where values of ``file`` aren't those that follow from its touches."""
    message = "doesn't follow from what was touched: the file was changed by hand. Make it anew"
    wrong = [(key, message, False) for key in _differ(file.model_dump(), follows, ())]
    if wrong:
        raise located(path, read_text(path), wrong)


def _differ(written: Any, follows: Any, at: KeyPath) -> Iterator[KeyPath]:
    """Where a file's values are not those that follow from its touches, to ``FOLLOWS_MM``."""
    if isinstance(follows, Mapping):
        for key, value in follows.items():
            yield from _differ(written[key], value, (*at, key))
    elif at == ("om",):
        one, other = (1000.0 * Motion.from_vectors(om, (0, 0, 0)).R for om in (written, follows))
        yield from [at] if np.abs(one - other).max() > FOLLOWS_MM else []
    elif isinstance(follows, list) and follows and isinstance(follows[0], Mapping):
        for i, (one, other) in enumerate(zip(written, follows, strict=True)):
            yield from _differ(one, other, (*at, i))
    elif isinstance(follows, list | float) and written is not None:
        yield from [at] if np.abs(np.subtract(written, follows)).max() > FOLLOWS_MM else []
    elif written != follows and not (written == () and follows is None):
        yield at
