"""Which finding answers which teat: optimal assignment in 3-D under a gate, and the GOSPA distance.

One assignment minimises the GOSPA cost (Rahmathullah, Garcia-Fernandez, Svensson, "Generalized
optimal sub-pattern assignment metric", FUSION 2017; p = 2, alpha = 2, c = gate). A pair on a
visible teat saves c^2 (a miss and a false finding), one on a hidden teat c^2 / 2: a hidden teat may
be absent. So a finding on a hidden teat is not false, and takes a visible teat's finding only where
that is much nearer to it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, starmap
from math import dist, inf, sqrt
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bench.scoring.errors import as_points
from bench.scoring.rates import Rate

GATE_CEILING_MM = 25.0
# a teat is some 20 mm thick: two ends nearer than this are one end, touched or written down twice
LEAST_SPACING_MM = 5.0

Points = list[list[float]]
Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Counts:
    """What a match counted."""

    visible: int = 0
    hidden: int = 0
    matched: int = 0
    missed: int = 0
    false: int = 0
    on_hidden: int = 0

    @property
    def found(self) -> int:
        """All findings: matched, false and on hidden teats."""
        return self.matched + self.false + self.on_hidden

    @property
    def recall(self) -> Rate:
        """Visible teats found, of the visible."""
        return Rate(self.matched, self.visible)

    @property
    def precision(self) -> Rate:
        """Findings on a visible teat, of those not on a hidden one."""
        return Rate(self.matched, self.matched + self.false)


class Match(NamedTuple):
    """The assignment of one scene: (found, truth) indices in order of truth."""

    pairs: Pairs
    distances_mm: tuple[float, ...]
    hidden_pairs: Pairs
    missed: tuple[int, ...]
    false: tuple[int, ...]
    hidden: int
    gate_mm: float

    @property
    def counts(self) -> Counts:
        """The match as numbers that add."""
        return counted([self])

    @property
    def gospa_mm(self) -> float:
        """sqrt(sum d^2 + c^2/2 (missed + false)), c = gate; hidden teats cost nothing."""
        outliers = len(self.missed) + len(self.false)
        return sqrt(sum(d * d for d in self.distances_mm) + self.gate_mm**2 / 2 * outliers)


def counted(matches: Iterable[Match]) -> Counts:
    """Many matches as numbers that add; nothing of none."""
    matched = hidden = missed = false = on_hidden = 0
    for one in matches:
        matched += len(one.pairs)
        hidden += one.hidden
        missed += len(one.missed)
        false += len(one.false)
        on_hidden += len(one.hidden_pairs)
    return Counts(matched + missed, hidden, matched, missed, false, on_hidden)


def gate_mm(truth_mm: npt.ArrayLike) -> float:
    """The gate of a scene with teats (m, 3), hidden ones too: min(25 mm, half the least spacing),
    which holds no finding in two gates. Raises ValueError where two ends are at one place.
    """
    truth = truth_mm if isinstance(truth_mm, list) else as_points(truth_mm, "truth").tolist()
    least = min(starmap(dist, combinations(truth, 2)), default=inf)
    if least < LEAST_SPACING_MM:
        i, j = min(combinations(range(len(truth)), 2), key=lambda at: dist(*(truth[k] for k in at)))
        raise ValueError(
            f"truth: the ends of teats {i + 1} and {j + 1} are {least:.2f} mm apart, at {truth[i]}"
            " mm; one was touched twice"
        )
    return min(GATE_CEILING_MM, least / 2)


def match(
    found_mm: npt.ArrayLike, truth_mm: npt.ArrayLike, visible: npt.ArrayLike, gate_mm: float
) -> Match:
    """Assign findings (n, 3) to teats (m, 3) with flags (m,); a pair beyond the gate is a miss and
    a false finding. Raises ValueError on wrong shapes, values not finite, or a gate not above 0.
    """
    truth = as_points(truth_mm, "truth").tolist()
    found, seen = as_points(found_mm, "found").tolist(), as_flags(visible, len(truth))
    if not 0.0 < gate_mm < inf:
        raise ValueError(f"gate: {gate_mm} mm is not above 0 and finite; use gate_mm(truth)")
    return assign(found, truth, seen, float(gate_mm))


@lru_cache(maxsize=1024)
def _shared(pairs: Pairs) -> Pairs:
    """One object for equal ones: 100 000 scores hold a handful of them."""
    return pairs


def assign(found: Points, truth: Points, seen: tuple[bool, ...], gate_mm: float) -> Match:
    """`match` of what is checked already."""
    within: list[tuple[int, int]] = []  # in order of truth
    distances: list[float] = []
    near_mm = 1.001 * gate_mm  # most are farther along x; rounding leaves out none
    for j, b in enumerate(truth):
        low, high = b[0] - near_mm, b[0] + near_mm
        for i, a in enumerate(found):
            if low <= a[0] <= high and (d := dist(a, b)) <= gate_mm:
                within.append((i, j))
                distances.append(d)
    teat_of = dict(within)
    on = set(teat_of.values())
    if len(on) < len(within):  # they contend
        from scipy.optimize import linear_sum_assignment  # type: ignore[attr-defined, unused-ignore]  # re-exported by a star import

        squared = ((np.array(found)[:, None] - np.array(truth)) ** 2).sum(axis=2)
        gain = np.where(seen, 1.0, 0.5) * (np.minimum(squared, gate_mm**2) - gate_mm**2)
        rows, cols = linear_sum_assignment(gain)
        best = set(zip(rows.tolist(), cols.tolist(), strict=True))
        distances = [d for pair, d in zip(within, distances, strict=True) if pair in best]
        within = [pair for pair in within if pair in best]
        teat_of = dict(within)
        on = set(teat_of.values())
    missed, false, on_hidden = [], [], []
    if len(on) < len(seen):
        missed = [j for j, visible in enumerate(seen) if visible and j not in on]
    if len(teat_of) < len(found):
        false = [i for i in range(len(found)) if i not in teat_of]
    if hidden := seen.count(False):
        on_hidden = [pair for pair in within if not seen[pair[1]]]
        distances = [d for (_, j), d in zip(within, distances, strict=True) if seen[j]]
        within = [pair for pair in within if seen[pair[1]]]
    pairs, beside = _shared(tuple(within)), tuple(on_hidden)
    return Match(pairs, tuple(distances), beside, tuple(missed), tuple(false), hidden, gate_mm)


def as_flags(visible: npt.ArrayLike, teats: int) -> tuple[bool, ...]:
    """A flag for each teat. Raises ValueError for another number of them."""
    given = np.asarray(visible)
    if given.shape != (teats,):
        if given.size == 0 and teats == 0:
            return ()
        raise ValueError(
            f"visible: expected one flag for each of the {teats} teats, got shape {given.shape}"
        )
    return tuple(map(bool, given.tolist()))
