"""Which finding answers which teat: optimal assignment in 3-D under a gate, and the GOSPA distance.

One assignment of all findings to all teats minimises the GOSPA cost (Rahmathullah, Garcia-Fernandez, Svensson, "Generalized optimal
sub-pattern assignment metric", FUSION 2017; p = 2, alpha = 2, c = gate). A pair on a visible teat saves c^2 (a miss and a false finding);
one on a hidden teat saves c^2 / 2, the false finding only, since a hidden teat may be absent for nothing. So a finding on a hidden teat
is not false, it takes no visible teat that another finding is nearer to, and a visible teat loses its finding to a hidden one only where
that is much nearer.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import sqrt

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment  # type: ignore[attr-defined, unused-ignore]  # re-exported by a star import

from bench.scoring.points import Bools, Floats, as_points
from bench.scoring.rates import Rate

GATE_CEILING_MM = 25.0


@dataclass(frozen=True, slots=True)
class Counts:
    """What a match counted; adds field by field, so that scenes and runs merge without averaging averages."""

    visible: int = 0
    hidden: int = 0
    matched: int = 0
    missed: int = 0
    false: int = 0
    on_hidden: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

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
        """Findings that were a visible teat, of those that had to be one (findings on hidden teats count neither way)."""
        return Rate(self.matched, self.matched + self.false)


@dataclass(frozen=True, slots=True)
class Match:
    """The assignment of one scene. `pairs` and `hidden_pairs` are (found, truth) indices in order of truth; distances belong to `pairs`."""

    pairs: tuple[tuple[int, int], ...]
    distances_mm: tuple[float, ...]
    hidden_pairs: tuple[tuple[int, int], ...]
    missed: tuple[int, ...]
    false: tuple[int, ...]
    hidden: int
    gate_mm: float

    @property
    def counts(self) -> Counts:
        """The match as numbers that add."""
        n = len(self.pairs)
        return Counts(n + len(self.missed), self.hidden, n, len(self.missed), len(self.false), len(self.hidden_pairs))

    @property
    def gospa_mm(self) -> float:
        """sqrt(sum d^2 + c^2/2 (missed + false)), c = gate; hidden teats and the findings on them cost nothing."""
        outliers = len(self.missed) + len(self.false)
        return sqrt(sum(d * d for d in self.distances_mm) + self.gate_mm**2 / 2 * outliers)


def gate_mm(truth_mm: npt.ArrayLike, ceiling_mm: float = GATE_CEILING_MM) -> float:
    """The gate of a scene: min(25 mm, half the least spacing of its teats, the hidden ones too); `truth_mm` is (m, 3).

    Half the spacing, because then no finding lies within the gate of two teats. Raises ValueError where two teats coincide.
    """
    truth = as_points(truth_mm, "truth")
    if len(truth) < 2:
        return ceiling_mm
    spacing = _distances(truth, truth)
    np.fill_diagonal(spacing, np.inf)
    least = float(spacing.min())
    if least == 0.0:
        i, j = np.argwhere(spacing == 0.0)[0]
        raise ValueError(f"truth: teats {i} and {j} are at the same place {truth[i].tolist()} mm; one of them was touched twice")
    return min(ceiling_mm, least / 2)


def match(found_mm: npt.ArrayLike, truth_mm: npt.ArrayLike, visible: npt.ArrayLike, gate_mm: float) -> Match:
    """Assign findings (n, 3) to teats (m, 3); `visible` is (m,) true or false. A pair beyond the gate is a miss and a false finding.

    Raises ValueError on wrong shapes, values that are not finite, or a gate that is not above 0.
    """
    found, truth = as_points(found_mm, "found"), as_points(truth_mm, "truth")
    seen = _as_visible(visible, len(truth))
    _check_gate(gate_mm)
    distance = _distances(found, truth)
    gain = np.where(seen, 1.0, 0.5) * (np.minimum(distance, gate_mm) ** 2 - gate_mm**2)
    rows, cols = linear_sum_assignment(gain)
    kept = sorted((int(j), int(i)) for i, j in zip(rows, cols, strict=True) if distance[i, j] <= gate_mm)
    pairs = tuple((i, j) for j, i in kept if seen[j])
    taken_truth, taken_found = {j for j, _ in kept}, {i for _, i in kept}
    return Match(
        pairs=pairs,
        distances_mm=tuple(float(distance[i, j]) for i, j in pairs),
        hidden_pairs=tuple((i, j) for j, i in kept if not seen[j]),
        missed=tuple(j for j in range(len(truth)) if seen[j] and j not in taken_truth),
        false=tuple(i for i in range(len(found)) if i not in taken_found),
        hidden=int((~seen).sum()),
        gate_mm=float(gate_mm),
    )


def gospa_mm(a_mm: npt.ArrayLike, b_mm: npt.ArrayLike, gate_mm: float) -> float:
    """GOSPA between two sets of points (n, 3) and (m, 3), p = 2, alpha = 2, c = gate: a metric for a fixed gate."""
    b = as_points(b_mm, "b")
    return match(a_mm, b, np.ones(len(b), dtype=bool), gate_mm).gospa_mm


def _distances(a: Floats, b: Floats) -> Floats:
    difference = a[:, None, :] - b[None, :, :]
    return np.asarray(np.sqrt(np.einsum("ijk,ijk->ij", difference, difference)), dtype=np.float64)


def _as_visible(visible: npt.ArrayLike, teats: int) -> Bools:
    given = np.asarray(visible)
    if given.size == 0 and teats == 0:
        return np.zeros(0, dtype=np.bool_)
    if given.shape != (teats,):
        raise ValueError(f"visible: expected one flag for each of the {teats} teats, got shape {given.shape}")
    if given.dtype != np.bool_ and not ((given == 0) | (given == 1)).all():
        raise ValueError(f"visible: expected true or false (1 or 0), got {given.tolist()}")
    return given.astype(np.bool_)


def _check_gate(gate: float) -> None:
    if not 0.0 < gate < float("inf"):
        raise ValueError(f"gate: {gate} mm is not above 0 and finite; use gate_mm(truth)")
