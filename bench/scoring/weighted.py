"""The failure rate of a family from scenes that are not drawn evenly: importance sampling.

Half of the scenes come from the family as it is, half from where failures were found. Each counts
with the weight p / q of its densities, so the estimate is of the family's own rate: the
self-normalised sum(w f) / sum(w) (Hesterberg, Technometrics 37, 1995). Scenes that can't be set up
are left out on both sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betaln, xlog1py, xlogy

from bench.scoring.errors import Floats
from bench.scoring.sequential import bounds

EVEN = 0.5  # share of scenes drawn evenly; no weight is above its inverse
FEW = 8.0  # so many failures double the variance of a proposal
NARROWEST = 0.05  # standard deviation of a proposal, as a share of a parameter's range


@dataclass(frozen=True, slots=True)
class WeightedRate:
    """A rate, and an interval, two-sided, that holds at all looks.
    ``effective``: as many scenes drawn evenly would have weights as uneven, (sum w)^2 / sum w^2.
    """

    scenes: int
    failures: int
    value: float
    low: float
    high: float
    effective: float


def weighted_rate(
    failed: Sequence[bool], weights: ArrayLike, largest: float, level: float = 0.95
) -> WeightedRate:
    """The family's failure rate; ``weights`` (n,) are above 0 and at most ``largest``, which is
    known beforehand.

    The interval is that of `bench.scoring.sequential`: it holds for any n, and however the weights
    were chosen from earlier scenes. No weight makes its upper end lower than evenly drawn scenes
    do: failures where nothing was drawn can't be ruled out.
    """
    w, f = np.asarray(weights, dtype=np.float64), np.asarray(failed, dtype=np.bool_)
    if w.shape != f.shape or w.ndim != 1 or not w.size:
        raise ValueError(f"weighted rate: {f.shape} scenes and {w.shape} weights; give one each")
    if not (np.all(w > 0.0) and w.max() <= largest * (1.0 + 1e-9)):
        raise ValueError(f"weighted rate: every weight must be above 0 and at most {largest:g}")
    total, parts = float(w.sum()), w / largest
    value = float(w[f].sum()) / total
    once = np.ones(w.size)
    low, high = bounds(parts[f], parts[~f], (once[f], once[~f]), level)
    effective = total**2 / float(np.sum(w**2))
    return WeightedRate(w.size, int(f.sum()), value, low, high, effective)


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """Where to draw scenes in a unit cube: evenly in a share, else by beta densities fitted to
    failures (cross-entropy method, Rubinstein and Kroese, 2004).
    """

    a: Floats
    b: Floats
    even: float = EVEN

    @classmethod
    def around(cls, failures: Floats, even: float = EVEN) -> Proposal:
        """By mean and variance of failures (n, d), NaN where one has no such parameter."""
        count = np.isfinite(failures).sum(axis=0)
        mean = np.clip(np.nanmean(failures, axis=0), NARROWEST, 1.0 - NARROWEST)
        variance = np.nanvar(failures, axis=0) * (1.0 + FEW / count) + NARROWEST**2
        # one failure alone says nothing of a width
        both = np.where(count > 1, mean * (1.0 - mean) / variance - 1.0, 0.0)
        # no density is infinite at an end
        return cls(np.maximum(1.0, mean * both), np.maximum(1.0, (1.0 - mean) * both), even)

    @property
    def largest(self) -> float:
        """The bound of the weights."""
        return 1.0 / self.even

    def draw(self, chance: np.random.Generator) -> Floats:
        """A point (d,)."""
        if chance.random() < self.even:
            return chance.random(len(self.a))
        return np.asarray(chance.beta(self.a, self.b))

    def weight(self, point: Floats) -> float:
        """Density of even draws over that of these; NaN where a scene has no such parameter."""
        x = np.clip(np.nan_to_num(point, nan=0.5), 1e-12, 1.0 - 1e-12)
        logs = xlogy(self.a - 1.0, x) + xlog1py(self.b - 1.0, -x) - betaln(self.a, self.b)
        density = float(np.exp(logs[np.isfinite(point)].sum()))
        return 1.0 / (self.even + (1.0 - self.even) * density)
