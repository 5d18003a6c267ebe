"""Phantom description files: which teats stand where on their plate, read into a `Phantom`, or
drawn within an envelope by a seed.

A file either lists its teats or declares an envelope. What is drawn is checked as what is written:
no two teats may share room. Spacings of an envelope are between the axes where they leave it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from bench.config import ConfigError, FileTable, did_you_mean, read_config
from bench.rig.urls import is_there
from instruments.world.phantom import Phantom, Teat, TeatShape
from instruments.world.solids import clearance_mm

PHANTOMS = Path(__file__).parents[1] / "phantoms"
TRIES = 500  # an envelope that needs more draws than this for one udder is too tight
TOUCH_MM = 1e-6  # two teats may touch, as in the thesis's section 5.2.2

Name = Literal["LF", "RF", "LR", "RR"]
Degrees = Annotated[float, Field(gt=-60, lt=60)]
Place = Annotated[float, Field(ge=-1000, le=1000)]
Length = Annotated[float, Field(gt=0, le=400)]
Span = tuple[Length, Length]


def ordered(span: Span) -> Span:
    """``span`` where its first number isn't the larger one. Raises ValueError."""
    if span[0] > span[1]:
        raise ValueError("the first number must be the smaller one")
    return span


class TeatTable(FileTable):
    """Where a teat's axis leaves the plate, its length, and its lean towards +x and +y."""

    name: Name
    base_mm: tuple[Place, Place]
    length_mm: Length = 135.0
    radius_mm: Length = 11.0
    end: Literal["hemisphere"] = "hemisphere"
    tilt_deg: tuple[Degrees, Degrees] = (0.0, 0.0)

    @model_validator(mode="after")
    def _makes_a_teat(self) -> TeatTable:
        self.teat()
        return self

    def teat(self) -> Teat:
        """Raises ValueError for a shape that can't be."""
        x, y = np.radians(self.tilt_deg)
        return Teat(
            self.base_mm, TeatShape(self.length_mm, self.radius_mm), (float(x), float(y)), self.name
        )


class Envelope(FileTable):
    """Within what an udder is drawn: figures evenly between two ends, each teat for itself."""

    middle_mm: tuple[Place, Place]
    front_spacing_mm: Span
    rear_spacing_mm: Span
    front_to_rear_mm: Span
    length_mm: Span = (135.0, 135.0)
    radius_mm: Span = (11.0, 11.0)
    shift_mm: Annotated[float, Field(ge=0, le=100)] = 0.0
    tilt_deg: Annotated[float, Field(ge=0, le=30)] = 0.0
    least_gap_mm: Annotated[float, Field(ge=0, le=100)] = 0.0

    _spans = field_validator(
        "front_spacing_mm", "rear_spacing_mm", "front_to_rear_mm", "length_mm", "radius_mm"
    )(ordered)

    def draw(self, rng: np.random.Generator) -> tuple[Teat, ...]:
        """LF, RF, LR, RR. Raises ValueError where `TRIES` draws come too near each other."""
        for _ in range(TRIES):
            teats = tuple(self._teats(rng))
            if _nearest(teats)[0] >= self.least_gap_mm:
                return teats
        raise ValueError(
            f"{TRIES} udders were drawn, and in each two teats were nearer than"
            f" {self.least_gap_mm:g} mm; widen the spacings"
        )

    def _teats(self, rng: np.random.Generator) -> Iterator[Teat]:
        x, y = self.middle_mm
        front, rear, deep = (
            rng.uniform(*span) / 2.0
            for span in (self.front_spacing_mm, self.rear_spacing_mm, self.front_to_rear_mm)
        )
        corners: dict[Name, tuple[float, float]] = {
            "LF": (-front, deep),
            "RF": (front, deep),
            "LR": (-rear, -deep),
            "RR": (rear, -deep),
        }
        for name, (dx, dy) in corners.items():
            sx, sy = rng.uniform(-self.shift_mm, self.shift_mm, 2)
            lean_x, lean_y = np.radians(rng.uniform(-self.tilt_deg, self.tilt_deg, 2))
            shape = TeatShape(rng.uniform(*self.length_mm), rng.uniform(*self.radius_mm))
            base = (float(x + dx + sx), float(y + dy + sy))
            yield Teat(base, shape, (float(lean_x), float(lean_y)), name)


class PhantomFile(FileTable):
    """``teats``, or an ``envelope`` that they are drawn from."""

    about: str
    emissivity: Annotated[float, Field(gt=0, le=1)] = 0.95
    teats: tuple[TeatTable, ...] = ()
    envelope: Envelope | None = None

    @field_validator("teats")
    @classmethod
    def _apart(cls, tables: tuple[TeatTable, ...]) -> tuple[TeatTable, ...]:
        names = [table.name for table in tables]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice:
            raise ValueError(f"two teats are {twice}; each may be there once")
        gap_mm, (one, other) = _nearest(tuple(table.teat() for table in tables))
        if gap_mm < -TOUCH_MM:
            raise ValueError(f"teats {one} and {other} stand {-gap_mm:.1f} mm inside each other")
        return tables

    @model_validator(mode="after")
    def _one_of_both(self) -> PhantomFile:
        if bool(self.teats) == (self.envelope is not None):
            raise ValueError("a phantom has either [[teats]] or an [envelope], and not both")
        return self


@dataclass(frozen=True, slots=True)
class Layout:
    """A phantom file as read."""

    name: str
    file: PhantomFile

    def phantom(self, *seed: int) -> Phantom:
        """The phantom, drawn by ``seed``. Raises ValueError for a too tight envelope."""
        envelope = self.file.envelope
        teats = (
            envelope.draw(np.random.default_rng(seed))
            if envelope
            else tuple(table.teat() for table in self.file.teats)
        )
        return Phantom(teats, name=self.name, emissivity=self.file.emissivity)


def layout_names() -> list[str]:
    """What ships."""
    return sorted(path.name.removesuffix(".toml") for path in PHANTOMS.glob("*.toml"))


def find_layout(name: str, folder: Path | None = None) -> Path:
    """A shipped layout by name, or ``folder``'s file that ends in ``.toml``. Raises ValueError."""
    if name.endswith(".toml"):
        path = (folder or Path()) / name
        if not is_there(path):
            raise ValueError(f"no such file ({path})")
        return path
    known = layout_names()
    if name not in known:
        raise ValueError(
            f"no such layout{did_you_mean(name, known)} (shipped: {', '.join(known)}; or a file"
            " beside, ending in .toml)"
        )
    return PHANTOMS / f"{name}.toml"


def load_layout(path: Path) -> Layout:
    """The phantom file at ``path``. Raises ConfigError with all its faults, each in its place."""
    layout = Layout(path.name.removesuffix(".toml"), read_config(path, PhantomFile))
    try:
        layout.phantom(0)
    except ValueError as error:
        raise ConfigError.plain(f"{path}: {error}") from error
    return layout


def shipped_phantom(name: str) -> Phantom:
    """A layout that ships and isn't drawn, at its reference place. Raises ValueError."""
    return load_layout(find_layout(name)).phantom()


def _nearest(teats: tuple[Teat, ...]) -> tuple[float, tuple[str, str]]:
    """The least clearance between two teats, and their names."""
    pairs = combinations(range(len(teats)), 2)
    hulls = [hull for (hull,) in Phantom(teats).teat_hulls()]
    gaps = [(clearance_mm(hulls[i], hulls[j]), (teats[i].name, teats[j].name)) for i, j in pairs]
    return min(gaps, default=(float("inf"), ("", "")))
