"""The sensitivity of stereo to picking errors (the thesis's section 5.1.2): known points, projected
into both pictures, put off by some pixels, and triangulated again through the same calibration.

The thesis doesn't say in which direction its offsets lay, so all are tried: evenly spaced around
each picture's point, and each direction of one picture with each of the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from bench.config import ConfigError, Section, located, parse_config, read_text, toml_table
from bench.script.phantom import Layout, find_layout, load_layout
from bench.script.planned_trials import LayoutName
from detector.calibration import Calibration
from detector.geometry import triangulate

Floats = NDArray[np.float64]
Pixels = Annotated[float, Field(ge=0, le=100)]
Millimetres = Annotated[float, Field(ge=-5000, le=5000)]
Point = tuple[Millimetres, Millimetres, Millimetres]


class Offset(Section):
    """How far one teat's picked points are put off. ``published_mm``: the thesis's end with the
    offset, ``published_plain_mm``: without.
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
    layout: LayoutName
    limit_mm: Annotated[float, Field(gt=0, le=1000)]
    directions: Annotated[int, Field(ge=4, le=360)] = 72
    source: str = ""
    offsets: Annotated[tuple[Offset, ...], Field(min_length=1)]


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
    """What an offset does: errors (n, 3) mm, world frame, a row a pair of directions."""

    offset: Offset
    errors_mm: Floats

    @property
    def distances_mm(self) -> Floats:
        """(n,)"""
        return np.asarray(np.linalg.norm(self.errors_mm, axis=1))

    @property
    def worst_mm(self) -> float:
        return float(self.distances_mm.max())

    @property
    def median_mm(self) -> float:
        return float(np.median(self.distances_mm))

    @property
    def most_mm(self) -> Floats:
        """(3,) the most along x, y and z, each in its own worst direction."""
        return np.asarray(np.abs(self.errors_mm).max(axis=0))


def is_offset_script(path: Path) -> bool:
    """Whether the script says ``kind = "offsets"``. Raises ConfigError."""
    text = read_text(path)
    try:
        return toml_table(path, text).get("kind") == "offsets"
    except ConfigError:
        return False  # who reads it next says what is wrong, and where


def load_offsets(path: Path) -> LoadedOffsets:
    """The script at ``path`` with its points. Raises ConfigError with all faults."""
    text = read_text(path)
    script = parse_config(path, text, OffsetScript)
    layout = load_layout(find_layout(script.layout, path.parent))
    points = layout.phantom(0).ends_mm
    wrong = [
        (("offsets", i, "teat"), f"the layout has {len(points)} teats", False)
        for i, offset in enumerate(script.offsets)
        if offset.teat > len(points)
    ]
    if wrong:
        raise located(path, text, wrong)
    return LoadedOffsets(path, text, script, layout, points)


def outcomes(loaded: LoadedOffsets, calibration: Calibration) -> tuple[Outcome, ...]:
    """What each offset of the script does. Raises ConfigError for a point outside a picture."""
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
    """Errors (n, 3) mm of ``point_mm`` (3,) triangulated with these offsets in n pairs of
    directions. Raises ConfigError for a point outside a picture, or rays that don't meet.
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
    angle = 2.0 * np.pi * np.arange(directions) / directions
    ways = np.column_stack([np.cos(angle), np.sin(angle)])  # itself alone where there is no offset
    a, b = (
        pixel + px * (ways if px else np.zeros((1, 2)))
        for pixel, px in ((left, left_px), (right, right_px))
    )
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
