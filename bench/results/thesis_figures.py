"""The thesis's published figures, defects included, each with its section."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np

from bench.scoring.errors import Floats

FIGURES = Path(__file__).parent / "thesis_figures.toml"
Kind = Literal["situations", "plane"]  # of a report, where a figure is shown
# tables of the file by name, their arrays as tuples
Thesis = SimpleNamespace
Situation = SimpleNamespace


@cache
def thesis() -> Thesis:
    """All of it, as printed."""
    found: Thesis = _named(tomllib.loads(FIGURES.read_text(encoding="utf-8")))
    return found


def _named(value: Any) -> Any:
    if isinstance(value, dict):
        return SimpleNamespace(**{key: _named(one) for key, one in value.items()})
    return tuple(map(_named, value)) if isinstance(value, list) else value


def errors_of_test_mm(figures: Thesis, number: Literal[1, 2]) -> Floats:
    """Errors (4, 3) of the first or the second test, from its tables: triangulated less touched."""
    found = (figures.test_1 if number == 1 else figures.test_2).triangulated_mm
    return np.asarray(np.subtract(found, figures.test_1.measured_mm), dtype=np.float64)
