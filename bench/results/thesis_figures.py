"""The thesis's published figures, defects included, each with its section; and their statistics."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from bench.config import Section, read_config
from bench.scoring.errors import Floats, summarise

FIGURES = Path(__file__).parent / "thesis_figures.toml"
Kind = Literal["situations", "plane", "offsets"]
Point = tuple[float, float, float]
Matrix = tuple[Point, Point, Point]
Four = tuple[Point, Point, Point, Point]


class Printed(Section):
    """A figure's ``section``, and what is ``wrong`` in it."""

    section: str
    wrong: str


class Asked(Section):
    section: str
    error_mm: float
    time_s: tuple[float, float]
    reliability: float
    wrong_error: str
    wrong_reliability: str
    wrong_time: str


class EarlierSystem(Printed):
    plane_mm: tuple[float, float]
    average_mm: float
    largest_mm: float
    smallest_mm: float
    within_mm: float
    area_within_mm: tuple[float, float]


class FirstTest(Printed):
    measured_mm: Four
    triangulated_mm: Four
    average_mm: float
    largest_mm: float


class SecondTest(Printed):
    triangulated_mm: Four
    errors_mm: Four
    average_mm: float
    largest_mm: float


class OnePixel(Printed):
    error_mm: float


class Homography(Printed):
    left: Matrix
    right: Matrix
    largest_px: float
    largest_mm: float
    at_mm: float


class StandOff(Printed):
    stated_mm: float
    implied_mm: tuple[float, float]


class World(Printed):
    matrix: Matrix


class Arm(Printed):
    accuracy_mm: tuple[float, float]


class Bath(Printed):
    range_c: tuple[float, float]


class Situation(Section):
    name: str
    section: str
    found: int
    present: int
    seen: str


class Elsewhere(Section):
    section: str
    what: str
    printed: str
    shown: tuple[Kind, ...]
    where: str


class Thesis(Section):
    """All of it, as printed."""

    asked: Asked
    earlier_system: EarlierSystem
    test_1: FirstTest
    test_2: SecondTest
    one_pixel: OnePixel
    homography: Homography
    stand_off: StandOff
    world: World
    arm: Arm
    bath: Bath
    situations: tuple[Situation, ...]
    elsewhere: tuple[Elsewhere, ...]


@dataclass(frozen=True, slots=True)
class Statistics:
    """Over the same errors: component and distance figures, mm; None where nothing was measured."""

    n: int
    signed_mean: float | None
    mean_absolute: float | None
    largest_absolute: float | None
    mean_distance: float | None
    largest_distance: float | None


def thesis() -> Thesis:
    """The figures."""
    return read_config(FIGURES, Thesis)


def statistics(errors_mm: Floats) -> Statistics:
    """Of errors (n, 3): over the 3 n components as the thesis averages, and the n distances."""
    found = summarise(errors_mm)
    of, radial = found.components, found.radial
    distances = radial.mean_mm, radial.max_mm
    return Statistics(found.n, of.bias_mm, of.mean_abs_mm, of.max_abs_mm, *distances)


def errors_of_test_mm(figures: Thesis, number: Literal[1, 2]) -> Floats:
    """Errors (4, 3) of the first or the second test, from its tables: triangulated less touched."""
    found = (figures.test_1 if number == 1 else figures.test_2).triangulated_mm
    return np.asarray(np.subtract(found, figures.test_1.measured_mm), dtype=np.float64)
