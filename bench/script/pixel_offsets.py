"""The sensitivity of stereo to picking errors: known points, known pixel offsets, every direction
(the thesis's section 5.1.2).

A known point is projected into both pictures, put off by so many pixels, and triangulated again
through the same calibration; what comes out differs by nothing but the offset. The thesis doesn't
say in which direction its offsets lay, so all are tried: evenly spaced around each picture's point,
and where both pictures are put off, each direction of one with each of the other. Pure but for
reading the script. May not know of instruments or frames.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_validator, model_validator

from bench.config import ConfigError, Section, located, parse_config, read_text
from bench.script.phantom import Layout, find_layout, load_layout
from bench.script.trial_table import layout_of
from detector.calibration import Calibration
from detector.geometry import triangulate

Floats = NDArray[np.float64]
Pixels = Annotated[float, Field(ge=0, le=100)]
Millimetres = Annotated[float, Field(ge=-5000, le=5000)]
Point = tuple[Millimetres, Millimetres, Millimetres]


class Offset(Section):
    """How far one teat's picked points are put off in either picture, and what the thesis printed
    for it, where it did.

    ``published_mm`` is the end triangulated with the offset, ``published_plain_mm`` the same
    without, world frame.
    """

    teat: Annotated[int, Field(ge=1)]
    left_px: Pixels = 0.0
    right_px: Pixels = 0.0
    published_mm: Point | None = None
    published_plain_mm: Point | None = None

    @model_validator(mode="after")
    def _some_offset(self) -> Offset:
        if self.left_px == self.right_px == 0.0:
            raise ValueError("has no offset: give left_px, right_px or both")
        return self


class OffsetScript(Section):
    """A script without trials: only a calibration and a phantom's known ends are needed."""

    kind: Literal["offsets"]
    title: str
    about: str = ""
    layout: str
    limit_mm: Annotated[float, Field(gt=0, le=1000)]
    directions: Annotated[int, Field(ge=4, le=360)] = 72
    source: str = ""
    offsets: Annotated[tuple[Offset, ...], Field(min_length=1)]

    @field_validator("layout")
    @classmethod
    def _layout(cls, name: str, info: ValidationInfo) -> str:
        return layout_of(name, info)


@dataclass(frozen=True, slots=True)
class LoadedOffsets:
    """The script as read, and the known points (n, 3), world frame, in mm."""

    path: Path
    text: str
    script: OffsetScript
    layout: Layout
    points_mm: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What one teat's offset does: errors (n, 3) mm in the world frame, a row for each direction or
    pair of directions.
    """

    offset: Offset
    errors_mm: Floats

    @property
    def distances_mm(self) -> Floats:
        """(n,) how far each error reaches."""
        return np.asarray(np.linalg.norm(self.errors_mm, axis=1))

    @property
    def worst_mm(self) -> float:
        """In the worst direction."""
        return float(self.distances_mm.max())

    @property
    def median_mm(self) -> float:
        """Over all directions."""
        return float(np.median(self.distances_mm))

    @property
    def most_mm(self) -> Floats:
        """(3,) the most along x, y and z, each in its own worst direction."""
        return np.asarray(np.abs(self.errors_mm).max(axis=0))


def is_offset_script(path: Path) -> bool:
    """Whether the script at ``path`` says ``kind = "offsets"``. Raises ConfigError where it can't
    be read.
    """
    try:
        return tomllib.loads(read_text(path)).get("kind") == "offsets"
    except tomllib.TOMLDecodeError:
        return False  # who reads it next says what is wrong, and where


def load_offsets(path: Path) -> LoadedOffsets:
    """The script at ``path`` with its points. Raises ConfigError with all faults."""
    text = read_text(path)
    script = parse_config(path, text, OffsetScript)
    layout = load_layout(find_layout(script.layout, path.parent))
    points = layout.phantom(0).ends_mm
    what = f"the layout has {len(points)} teats"
    many = [offset.teat > len(points) for offset in script.offsets]
    if any(many):
        wrong = [(("offsets", i, "teat"), what, False) for i, one in enumerate(many) if one]
        raise located(path, text, wrong)
    return LoadedOffsets(path, text, script, layout, points)


def outcomes(loaded: LoadedOffsets, calibration: Calibration) -> tuple[Outcome, ...]:
    """What each offset of the script does. Raises ConfigError for
    a point that a camera can't see.
    """
    many, points = loaded.script.directions, loaded.points_mm
    return tuple(
        Outcome(
            one, offset_errors(calibration, points[one.teat - 1], one.left_px, one.right_px, many)
        )
        for one in loaded.script.offsets
    )


def offset_errors(
    calibration: Calibration, point_mm: Floats, left_px: float, right_px: float, directions: int
) -> Floats:
    """Errors (n, 3) mm, world frame, of ``point_mm`` (3,) triangulated from points put off by so
    many pixels; n is every direction.

    Raises ConfigError for a point outside either picture, or an offset whose rays don't meet.
    """
    seen_right = calibration.world_from_right.inverse().apply(point_mm[None])
    seen_left = calibration.right_from_left.inverse().apply(seen_right)
    left, right = calibration.left.project(seen_left), calibration.right.project(seen_right)
    for name, pixel in (("left", left), ("right", right)):
        size = np.array(getattr(calibration, name).image_size)
        if not bool(np.all((pixel >= -0.5) & (pixel <= size - 0.5))):
            raise ConfigError.plain(
                f"the point at {np.round(point_mm, 1).tolist()} mm is outside the {name} picture"
                f" (pixel {pixel.round(1).tolist()[0]})"
            )
    a, b = _around(left, left_px, directions), _around(right, right_px, directions)
    pairs_left, pairs_right = np.repeat(a, len(b), axis=0), np.tile(b, (len(a), 1))
    found, _ = triangulate(
        pairs_left, pairs_right, calibration.left, calibration.right, calibration.right_from_left
    )
    errors = calibration.world_from_right.apply(found) - point_mm
    if not np.isfinite(errors).all():
        raise ConfigError.plain(
            f"offsets of {left_px:g} and {right_px:g} px leave rays that don't meet before the"
            " cameras"
        )
    return np.asarray(errors)


def _around(pixel: Floats, offset_px: float, directions: int) -> Floats:
    """``pixel`` (1, 2) put off by ``offset_px`` in each direction, (directions, 2); itself alone
    where there is no offset.
    """
    if offset_px == 0.0:
        return pixel
    angle = 2.0 * np.pi * np.arange(directions) / directions
    return np.asarray(pixel + offset_px * np.column_stack([np.cos(angle), np.sin(angle)]))
