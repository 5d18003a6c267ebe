"""The two dated files about an arm: where it stands (`arm-frame.toml`), and how good it is
(`arm-verification.toml`).

Both hold what was touched, and beside it what follows from it, for people and other programs.
Reading works the figures out again from the touches and refuses a file whose figures don't follow:
it was changed by hand. A file of another arm is refused too.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AwareDatetime, Field

from bench.config import ConfigError, KeyPath, Section, located, read_config, read_text
from bench.files import write_synced
from bench.rig.arm_frame import FrameError, TableFrame, TouchedPoint
from bench.rig.arm_verification import LengthTest, Limits, LocationTest, Verification
from bench.toml import toml_text
from detector.geometry import Motion

FOLLOWS_MM = 1e-3  # what is written follows from the touches to better than this
FRAME_HEADING = """Where the arm stands on the table, made by 'teatbench arm frame'. Lengths in mm.
X_world = R(om) X_arm + T, om in rad. Make it anew when the arm or the
table was moved, or another arm is used."""
VERIFICATION_HEADING = """How good the arm was on this day, made by 'teatbench arm verify'.
Lengths in mm. Figures after ASME B89.4.22 and ISO 10360-12. A run holds these figures
against the limits of its own script."""

Number = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Three = tuple[Number, Number, Number]


class _Point(Section):
    name: str
    arm_mm: Three
    spread_mm: NotNegative
    world_mm: Three | None = None
    residual_mm: NotNegative | None = None


class _FrameFile(Section):
    made: AwareDatetime
    serial_number: str
    om: Three
    T: Three
    residual_mm: NotNegative | None = None
    points: Annotated[tuple[_Point, ...], Field(min_length=3)]


class _Location(Section):
    where: str
    n: int
    largest_mm: NotNegative
    two_sd_mm: NotNegative
    sphere_mm: NotNegative
    swing_deg: NotNegative
    tips_mm: Annotated[tuple[Three, ...], Field(min_length=2)]
    axes: Annotated[tuple[Three, ...], Field(min_length=2)]


class _Length(Section):
    where: str
    calibrated_mm: Annotated[float, Field(gt=0)]
    error_mm: Number
    a_mm: Three
    b_mm: Three


class _Limits(Section):
    location_mm: Annotated[float, Field(gt=0)]
    length_mm: Annotated[float, Field(gt=0)] | None = None


class _VerificationFile(Section):
    made: AwareDatetime
    serial_number: str
    passed: bool
    location_mm: NotNegative
    length_mm: NotNegative | None = None
    length_two_rms_mm: NotNegative | None = None
    limits: _Limits
    location: Annotated[tuple[_Location, ...], Field(min_length=1)]
    length: tuple[_Length, ...] = ()


def frame_text(frame: TableFrame) -> str:
    """``frame`` as the text of its file."""
    residuals = frame.residuals_mm
    points = [
        {
            "name": point.name,
            "arm_mm": point.arm_mm,
            "spread_mm": point.spread_mm,
            "world_mm": point.world_mm,
            "residual_mm": residuals.get(point.name),
        }
        for point in frame.points
    ]
    motion = frame.world_from_arm
    head = {
        "made": frame.made,
        "serial_number": frame.serial_number,
        "om": motion.om.tolist(),
        "T": motion.T.tolist(),
    }
    return toml_text({**head, "residual_mm": frame.residual_mm, "points": points}, FRAME_HEADING)


def load_frame(path: Path, *, serial_number: str | None = None) -> TableFrame:
    """The frame at ``path``, of the arm ``serial_number`` where given. Raises ConfigError with all
    faults, each in its place.
    """
    file = read_config(path, _FrameFile)
    _refuse_other_arm(
        path,
        file.serial_number,
        serial_number,
        "Make the frame anew with this arm: 'teatbench arm frame'",
    )
    points = [
        TouchedPoint(point.name, point.arm_mm, point.spread_mm, point.world_mm)
        for point in file.points
    ]
    try:
        frame = TableFrame.from_touches(file.made, file.serial_number, points)
    except FrameError as error:
        raise located(path, read_text(path), [(("points",), str(error), False)]) from error
    written, follows = Motion.from_vectors(file.om, file.T), frame.world_from_arm
    faults: list[tuple[KeyPath, bool]] = [
        (("om",), _near(1000.0 * written.R, 1000.0 * follows.R)),
        (("T",), _near(written.T, follows.T)),
    ]
    faults.append((("residual_mm",), _same(file.residual_mm, frame.residual_mm)))
    faults += [
        (("points", i, "residual_mm"), _same(p.residual_mm, frame.residuals_mm.get(p.name)))
        for i, p in enumerate(file.points)
    ]
    _refuse_changed(path, faults)
    return frame


def verification_text(verification: Verification, limits: Limits) -> str:
    """``verification`` with what ``limits`` say of it, as the text of its file."""
    head = {
        "made": verification.made,
        "serial_number": verification.serial_number,
        "passed": not verification.faults(limits),
        "location_mm": verification.location_mm,
        "length_mm": verification.length_mm,
        "length_two_rms_mm": verification.length_two_rms_mm,
        "limits": {"location_mm": limits.location_mm, "length_mm": limits.length_mm},
    }
    locations = [_location_table(test) for test in verification.locations]
    lengths = [
        {
            "where": t.where,
            "calibrated_mm": t.calibrated_mm,
            "error_mm": t.error_mm,
            "a_mm": t.a_mm.tolist(),
            "b_mm": t.b_mm.tolist(),
        }
        for t in verification.lengths
    ]
    return toml_text(
        {**head, "location": locations, "length": lengths or None}, VERIFICATION_HEADING
    )


def load_verification(path: Path, *, serial_number: str | None = None) -> Verification:
    """The verification at ``path``, of the arm ``serial_number`` where given. Raises ConfigError
    with all faults, each in its place.
    """
    file = read_config(path, _VerificationFile)
    _refuse_other_arm(
        path, file.serial_number, serial_number, "Verify this arm: 'teatbench arm verify'"
    )
    text = read_text(path)
    uneven = [
        (("location", i, "axes"), "must have a row for each of tips_mm", False)
        for i, t in enumerate(file.location)
        if not _even(t)
    ]
    if uneven:
        raise located(path, text, uneven)
    locations = tuple(
        LocationTest(t.where, np.array(t.tips_mm), np.array(t.axes)) for t in file.location
    )
    lengths = tuple(
        LengthTest(t.where, np.array(t.a_mm), np.array(t.b_mm), t.calibrated_mm)
        for t in file.length
    )
    found = Verification(file.made, file.serial_number, locations, lengths)
    limits = Limits(file.limits.location_mm, file.limits.length_mm)
    faults: list[tuple[KeyPath, bool]] = [(("passed",), file.passed == (not found.faults(limits)))]
    faults += [
        ((key,), _same(getattr(file, key), getattr(found, key)))
        for key in ("location_mm", "length_mm", "length_two_rms_mm")
    ]
    for i, (written, test) in enumerate(zip(file.location, locations, strict=True)):
        keys = ("n", "largest_mm", "two_sd_mm", "sphere_mm", "swing_deg")
        faults += [
            (("location", i, key), _same(getattr(written, key), getattr(test, key))) for key in keys
        ]
    faults += [
        (("length", i, "error_mm"), _same(w.error_mm, t.error_mm))
        for i, (w, t) in enumerate(zip(file.length, lengths, strict=True))
    ]
    _refuse_changed(path, faults)
    return found


def write_file(path: Path, text: str) -> None:
    """Write ``text`` so that it is there whole or not at all. Raises ConfigError where the folder
    can't be written.
    """
    try:
        write_synced(path, text.encode("utf-8"))
    except OSError as error:
        raise ConfigError.plain(
            f"{path} can't be written: {error.strerror or error}. Name another place with --out."
        ) from error


def _location_table(test: LocationTest) -> dict[str, Any]:
    figures = {
        key: getattr(test, key)
        for key in ("n", "largest_mm", "two_sd_mm", "sphere_mm", "swing_deg")
    }
    return {
        "where": test.where,
        **figures,
        "tips_mm": test.tips_mm.tolist(),
        "axes": test.axes.tolist(),
    }


def _even(test: _Location) -> bool:
    return len(test.tips_mm) == len(test.axes)


def _refuse_other_arm(path: Path, of: str, wanted: str | None, then: str) -> None:
    if wanted is not None and of != wanted:
        message = f"this file is of the arm {of}, but the arm that answers is {wanted}. {then}"
        raise located(path, read_text(path), [(("serial_number",), message, False)])


def _refuse_changed(path: Path, checked: Sequence[tuple[KeyPath, bool]]) -> None:
    message = "doesn't follow from what was touched: the file was changed by hand. Make it anew"
    wrong = [(key, message, False) for key, right in checked if not right]
    if wrong:
        raise located(path, read_text(path), wrong)


def _same(written: float | None, follows: float | None) -> bool:
    if written is None or follows is None:
        return written is follows
    return abs(written - follows) <= FOLLOWS_MM


def _near(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    return bool(np.abs(one - other).max() <= FOLLOWS_MM)
