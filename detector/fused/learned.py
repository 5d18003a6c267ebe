"""What was learned from simulated scenes: the weights of a decision and of a variance, from the
file that `python -m tests.learn_fused` writes, with its seed, sizes and figures.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from detector.geometry import Array

FILE = Path(__file__).with_name("learned.json")


@dataclass(frozen=True, slots=True)
class Learned:
    """``weights`` and ``bias`` of log odds by measure, and what is ``usual`` of right fits; the
    ``least`` odds of what is given; ``factors`` of standard deviations by term; the ``limits`` of
    measures by which fits are tried again.
    """

    weights: Mapping[str, float]
    usual: Mapping[str, float]
    bias: float
    least: float
    factors: Mapping[str, float]
    limits: Mapping[str, float]


def in_order(by_name: Mapping[str, float], names: Iterable[str]) -> Array:
    """In the order of ``names``; 0 of what nothing was learned of."""
    return np.array([by_name.get(name, 0.0) for name in names])


@cache
def learned() -> Learned:
    """What the product ships with."""
    table = json.loads(FILE.read_text(encoding="utf-8"))
    return Learned(**table["odds"], factors=table["spread"], limits=table["limits"])
