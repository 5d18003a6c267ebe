"""The thesis's published figures, defects included, each with its section; and their statistics."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np

from bench.scoring.errors import Floats, summarise

FIGURES = Path(__file__).parent / "thesis_figures.toml"
Kind = Literal["situations", "plane", "offsets"]  # of a report, where a figure is shown
# tables of the file by name, their arrays as tuples
Thesis = SimpleNamespace
Situation = SimpleNamespace


@dataclass(frozen=True, slots=True)
class Statistics:
    """Over the same errors: component and distance figures, mm; None where nothing was measured."""

    n: int
    signed_mean: float | None
    mean_absolute: float | None
    largest_absolute: float | None
    mean_distance: float | None
    largest_distance: float | None


@cache
def thesis() -> Thesis:
    """All of it, as printed."""
    found: Thesis = _named(tomllib.loads(FIGURES.read_text(encoding="utf-8")))
    return found


def _named(value: Any) -> Any:
    if isinstance(value, dict):
        return SimpleNamespace(**{key: _named(one) for key, one in value.items()})
    return tuple(map(_named, value)) if isinstance(value, list) else value


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
