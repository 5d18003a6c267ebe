"""The truth of a run as one object: what its errors have in common, and what each has afresh.

Sigma = F F' + diag(C). F (3 n, k) has a column for each independent source of unit variance that
several ends share, such as a coordinate of the registration's turn; C (3, 3) is each end's own. A
detector's error is seen as e + t with t of this covariance, so whatever of it is common no number
of poses averages out.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
import numpy.typing as npt
import scipy

from bench.scoring.errors import Floats


@dataclass(frozen=True, slots=True, eq=False)
class JointCovariance:
    """Of n ends: ``common`` (n, 3, k), a column a source, and ``fresh`` (n, 3, 3), mm and mm^2."""

    common: Floats
    fresh: Floats
    sources: tuple[str, ...]

    @classmethod
    def exact(cls, n: int) -> JointCovariance:
        """A truth without error."""
        return cls(np.zeros((n, 3, 0)), np.zeros((n, 3, 3)), ())

    def of(self, rows: npt.ArrayLike) -> JointCovariance:
        """Of some of the ends: numbers, or a mask (n,)."""
        some = np.asarray(rows)
        return JointCovariance(self.common[some], self.fresh[some], self.sources)

    @property
    def shares(self) -> bool:
        """Whether the ends have anything in common."""
        return bool(self.common.any())

    @property
    def covariances_mm2(self) -> Floats:
        """(n, 3, 3): each end's own part and what it shares."""
        return np.asarray(self.fresh + self.common @ self.common.transpose(0, 2, 1))

    def along(self, directions: npt.ArrayLike) -> Floats:
        """The common part (n, k) along unit vectors (n, 3), or along one (3,)."""
        ways = np.broadcast_to(np.asarray(directions, dtype=np.float64), (len(self.fresh), 3))
        return np.asarray(np.einsum("na,nak->nk", ways, self.common))

    def of_mean(self, weights: npt.ArrayLike, *, fresh: bool = False) -> Floats:
        """Covariance (3, 3) of the common part of a weighted sum; with ``fresh`` of the whole."""
        w = np.asarray(weights, dtype=np.float64)
        shared = np.einsum("n,nak->ak", w, self.common)
        own = np.einsum("n,nab->ab", w**2, self.fresh) if fresh else 0.0
        return np.asarray(shared @ shared.T + own)

    def by_source(self, weights: npt.ArrayLike) -> dict[str, float]:
        """What each source adds to a weighted sum: standard uncertainty along an axis, rms, mm."""
        shared = np.einsum("n,nak->ak", np.asarray(weights, dtype=np.float64), self.common)
        squares: dict[str, float] = {}
        for source, square in zip(self.sources, np.square(shared).sum(axis=0), strict=True):
            squares[source] = squares.get(source, 0.0) + float(square) / 3.0
        return {source: sqrt(square) for source, square in squares.items() if square > 0.0}

    def squares(self, forms: npt.ArrayLike) -> tuple[float, float]:
        """Mean and variance of sum t' A t over the ends, ``forms`` A (n, 3, 3) symmetric:
        tr(A Sigma) and 2 tr((A Sigma)^2).
        """
        a = np.asarray(forms, dtype=np.float64)
        mean = float(np.einsum("nab,nba->", a, self.covariances_mm2))
        own = a @ self.fresh
        shared = a @ self.common
        of_common = np.einsum("nak,naj->kj", self.common, shared)
        mixed = float(np.sum(shared * (self.fresh @ shared)))
        of_fresh = float(np.einsum("nab,nba->", own, own))
        return mean, 2.0 * (of_fresh + 2.0 * mixed + float(np.square(of_common).sum()))


def radial_95_mm(covariance_mm2: npt.ArrayLike) -> float:
    """The distance that a normal error of this covariance (3, 3) exceeds in 5 %: its square is
    taken as g chi-square of h degrees of freedom with the same mean and variance (Satterthwaite);
    2.795 u where u is the same along every axis, for which it is exact.
    """
    c = np.asarray(covariance_mm2, dtype=np.float64)
    mean, square = float(np.trace(c)), float(np.sum(c * c))
    if mean <= 0.0:
        return 0.0
    return sqrt(square / mean * float(scipy.special.chdtri(mean**2 / square, 0.05)))


@dataclass(frozen=True, slots=True)
class MeanSquare:
    """What of a mean squared error is the truth's: its rms, at most so much (95 %), and an interval
    of the rms without it (95 %; from 0 where it may be all).
    """

    truth_rms_mm: float
    truth_most_mm: float
    interval_mm: tuple[float, float]


def mean_square(errors_mm: Floats, truth: JointCovariance) -> MeanSquare:
    """Of errors (n, 3), n > 0. |e + t|^2 is |e|^2 + 2 e' t + |t|^2, whose last two have the mean
    tr(Sigma) and the variance 4 e' Sigma e + 2 tr(Sigma^2); e is taken as it is seen. |t|^2 itself
    is g chi-square of h degrees of freedom (Satterthwaite).
    """
    n = len(errors_mm)
    each = np.broadcast_to(np.eye(3), (n, 3, 3))
    mean, variance = (value / n**k for k, value in enumerate(truth.squares(each), 1))
    freedom = 2.0 * mean**2 / variance
    most = mean * float(scipy.special.chdtri(freedom, 0.05)) / freedom
    crossed = np.einsum("na,nak->k", errors_mm, truth.common)
    own = float(np.einsum("na,nab,nb->", errors_mm, truth.fresh, errors_mm))
    sd = sqrt(4.0 * (float(crossed @ crossed) + own) / n**2 + variance)
    seen = float(np.mean(np.sum(np.square(errors_mm), axis=1)))
    reach = float(scipy.special.ndtri(0.975)) * sd
    low, high = (sqrt(max(seen - mean + sign * reach, 0.0)) for sign in (-1.0, 1.0))
    return MeanSquare(sqrt(mean), sqrt(most), (low, high))
