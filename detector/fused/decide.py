"""Which fitted teats are teats: the log odds of each, and the best set that doesn't overlap.

The log odds of a fit are linear in what the pictures show of it (`MEASURES`). Weights are learned
(`python -m tests.learn_fused`) and read from a file; none is set by hand. The reason of a rejected
fit is that of the measure which lowers its odds the most, next to those of right fits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detector.fused.evidence import WHOLE_END, Evidence
from detector.fused.learned import Learned, in_order
from detector.geometry import Array, or_zero
from detector.outline.model import END, HEIGHT, LEAN_X, LEAN_Z, RADIUS, SIDE_A, SIDE_B, apexes, axes
from detector.outline.prior import Prior

OUTLINE = "its outline isn't that of a teat"
ELSEWHERE = "the thermal picture shows its outline elsewhere"
UNSURE, WORSE = "its place is too unsure", "a better one is in the same place"
SIZE, LEANS = "it isn't of a teat's size", "it leans more than a teat does"
END_UNSEEN, SIDE_UNSEEN = "too little of its end is seen", "too little of its sides is seen"
COLD, GOES_ON = "it isn't as warm as a teat all over", "its sides are seen beyond its end"
UNLIKE = "one picture shows more of it than the other"
APART = "it is far from the other teats"
ONE_MORE = "it is one more than an udder has teats, and the worst"
_ONE_PLACE_MM = 15.0
_COOL_QUARTER_K = 5.0  # a teat is hardly cooler than the others by more


@dataclass(frozen=True, eq=False)
class Fits:
    """Fitted teats (m, 8), what the pictures show of them, and what is derived from that."""

    teats: Array
    of: Evidence
    prior: Prior

    @cached_property
    def lines(self) -> Array:
        """Warmth (m, 3) of three lines, from the coolest on."""
        return np.sort(self.of.warmth, axis=1)

    @cached_property
    def thermal(self) -> Array:
        """Offsets (m, 3) of the thermal outline, 0 where there is none."""
        return or_zero(self.of.thermal_px)

    @cached_property
    def away_mm(self) -> Array:
        """How far (m, m) ends are from each other."""
        ends = apexes(self.teats)
        return np.asarray(np.linalg.norm(ends[:, None] - ends, axis=2))

    @cached_property
    def usual(self) -> float:
        """How warm fits are that show a whole end in both optical pictures, one a place: the middle
        one, of two in the middle the warmer; or the warmest of all.
        """
        middle, places = self.lines[:, 1], list[int]()
        for i in np.flatnonzero(self.whole & np.isfinite(middle)).tolist():
            if (self.away_mm[i, places] > _ONE_PLACE_MM).all():
                places.append(i)
        known = np.sort(middle[places])
        if len(known):
            return float(known[len(known) // 2])
        return float(np.nanmax(middle, initial=-np.inf))

    @cached_property
    def whole(self) -> NDArray[np.bool_]:
        """Which show a whole end in both optical pictures."""
        return np.asarray(self.of.end[:, :2].min(axis=1) > WHOLE_END)

    @cached_property
    def apart_mm(self) -> Array:
        """How far (m,) the nearest whole end in another place is; 0 without one."""
        away = self.away_mm[:, self.whole]
        nearest = np.where(away > _ONE_PLACE_MM, away, np.inf).min(axis=1, initial=np.inf)
        return np.where(np.isfinite(nearest), nearest, 0.0)

    @cached_property
    def lean(self) -> Array:
        """Slope (m,)."""
        return np.asarray(np.hypot(self.teats[:, LEAN_X], self.teats[:, LEAN_Z]))

    @cached_property
    def off_size(self) -> Array:
        """How far the radius (m,) is outside of a teat's range, mm."""
        low, high = self.prior.radii_mm
        radius = self.teats[:, RADIUS]
        return np.asarray(np.maximum(np.maximum(low - radius, radius - high), 0.0))

    @cached_property
    def off_usual(self) -> Array:
        """How far the radius (m,) is from a teat's mean, mm."""
        return np.asarray(np.abs(self.teats[:, RADIUS] - self.prior.radius_mm))

    @cached_property
    def too_steep(self) -> Array:
        """How far the slope (m,) is beyond that of a teat."""
        return np.asarray(np.maximum(self.lean - np.tan(np.radians(self.prior.most_lean_deg)), 0.0))


class Measure(NamedTuple):
    """What is weighed of fits, from ``least`` to ``most``, and what a fit is rejected for that
    lacks it. ``witness``: by the thermal outline, of cameras that may disagree.
    """

    least: float
    most: float
    lacking: str
    of: Callable[[Fits], Array]
    witness: bool = False


def _aside(f: Fits) -> Array:
    """How far the thermal outline lies to one side, sensor px: of a wrong depth."""
    sides = f.of.thermal_px[:, [SIDE_A, SIDE_B]]
    return np.asarray(0.5 * np.abs(or_zero(sides[:, 0] - sides[:, 1])))


def one_sided(f: Fits) -> Array:
    """The share of its worse side that isn't seen, in the picture that shows less."""
    return np.asarray(1.0 - f.of.both[:, :2].min(axis=1))


def _all_beyond(f: Fits) -> Array:
    """How far the thermal outline lies beyond the fit on all sides that it shows, sensor px."""
    known = np.isfinite(f.of.thermal_px)
    least = np.where(known, f.of.thermal_px, np.inf).min(axis=1)
    return np.where(known.sum(axis=1) > 1, least, 0.0)


def _cool_though_seen(f: Fits) -> Array:
    """By how much its middle line is cooler than a cool quarter's, K, times the share of it that
    both optical pictures show: what hides a teat may be as cold as it will.
    """
    cooler = np.nan_to_num(f.lines[:, 1] - f.usual, nan=0.0) + _COOL_QUARTER_K
    shown = np.minimum(f.of.end[:, :2].min(axis=1), f.of.both[:, :2].min(axis=1))
    return np.asarray(shown * np.clip(cooler, -_COOL_QUARTER_K, 0.0))


MEASURES: dict[str, Measure] = {
    "end, mean of both": Measure(0, 1, END_UNSEEN, lambda f: f.of.end[:, :2].mean(axis=1)),
    "end, thermal": Measure(0, 1, END_UNSEEN, lambda f: f.of.end[:, 2]),
    "better side, thermal": Measure(0, 1, SIDE_UNSEEN, lambda f: f.of.side[:, 2]),
    "other side, mean of both": Measure(0, 1, SIDE_UNSEEN, lambda f: f.of.both[:, :2].mean(axis=1)),
    "ends, one less the other": Measure(0, 1, UNLIKE, lambda f: np.ptp(f.of.end[:, :2], axis=1)),
    "width, one less the other, px": Measure(0, 1, UNLIKE, lambda f: f.of.width_px),
    "rows, right less left, px": Measure(0, 0.5, OUTLINE, lambda f: np.abs(f.of.rows_px)),
    "ln of the end's sd, mm": Measure(-2.5, 3, UNSURE, lambda f: np.log(f.of.sd_mm)),
    "unsure and one-sided": Measure(
        0, 3.5, UNSURE, lambda f: one_sided(f) * np.maximum(np.log(f.of.sd_mm) + 0.5, 0.0)
    ),
    "both sides stop and bend": Measure(0, 1, END_UNSEEN, lambda f: f.of.stops.astype(float)),
    "sides go on beyond, mm": Measure(0, 15, GOES_ON, lambda f: f.of.goes_on_mm),
    "sides go on, end in part, mm": Measure(
        0, 8, GOES_ON, lambda f: f.of.goes_on_mm * (1 - f.of.end[:, :2].mean(axis=1))
    ),
    "a side goes on, mm": Measure(0, 15, GOES_ON, lambda f: f.of.lines_mm.max(axis=(1, 2))),
    "thermal outline within, px": Measure(-2, 0, ELSEWHERE, lambda f: f.thermal.min(axis=1), True),
    "thermal end beyond, px": Measure(0, 1.5, ELSEWHERE, lambda f: f.thermal[:, END], True),
    "thermal outline beyond, px": Measure(0, 1, ELSEWHERE, _all_beyond, True),
    "thermal outline aside, px": Measure(0, 1, ELSEWHERE, _aside, True),
    "thermal parts without an outline": Measure(
        0, 3, COLD, lambda f: np.isnan(f.of.thermal_px).sum(axis=1)
    ),
    "coolest line, to its middle one, K": Measure(
        -6, 0, COLD, lambda f: f.lines[:, 0] - f.lines[:, 1]
    ),
    "cooler than the usual teat, though seen, K": Measure(
        -_COOL_QUARTER_K, 0, COLD, _cool_though_seen
    ),
    "as cold as the surroundings, of the range": Measure(-0.1, 0.35, COLD, lambda f: f.of.in_range),
    "as warm as the warmest, of the range": Measure(0.35, 0.9, COLD, lambda f: f.of.in_range),
    "radius outside of the range, mm": Measure(0, 5, SIZE, lambda f: f.off_size),
    "radius off the usual, mm": Measure(0, 5, SIZE, lambda f: f.off_usual),
    "from the nearest whole end, mm": Measure(150, 250, APART, lambda f: f.apart_mm),
    "lean beyond the range": Measure(0, 0.5, LEANS, lambda f: f.too_steep),
    "leaning and thinner than the usual, mm": Measure(
        0, 3, LEANS, lambda f: f.lean * np.maximum(f.prior.radius_mm - f.teats[:, RADIUS], 0.0)
    ),
    "ln of the end's height": Measure(
        0, 0.5, OUTLINE, lambda f: np.abs(np.log(f.teats[:, HEIGHT]))
    ),
}


_RANGES = np.array([(measure.least, measure.most) for measure in MEASURES.values()]).T


def measures(teats: Array, evidence: Evidence, prior: Prior) -> Array:
    """What `MEASURES` weighs of teats (m, 8), (m, k)."""
    fits = Fits(teats, evidence, prior)
    every = np.stack([measure.of(fits) for measure in MEASURES.values()], axis=1, dtype=np.float64)
    every[np.isnan(every)] = -9.0
    return np.clip(every, *_RANGES, out=every)


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """Log odds (m,), the reason against each or None, and which only a witness speaks against."""

    odds: Array
    reasons: list[str | None]
    by_witness: NDArray[np.bool_]
    by_place: NDArray[np.bool_]

    @property
    def accepted(self) -> list[int]:
        """Rows, the likeliest first."""
        rows = [i for i, reason in enumerate(self.reasons) if reason is None]
        return sorted(rows, key=lambda i: -self.odds[i])


def decide(
    teats: Array, evidence: Evidence, learned: Learned, prior: Prior, eyes: Array
) -> Decision:
    """The best of teats (m, 8) that don't overlap, nor hide each other's ends from both ``eyes``
    (2, 3), the optical cameras' centres.
    """
    seen, kinds = measures(teats, evidence, prior), list(MEASURES.values())
    weights = in_order(learned.weights, MEASURES)
    lack = (np.where(weights > 0, _RANGES[1], _RANGES[0]) - seen) * weights
    odds = seen @ weights + learned.bias
    short = (in_order(learned.usual, MEASURES) - seen) * weights
    reasons: list[str | None] = [kinds[k].lacking for k in short.argmax(axis=1)]
    witness = lack[:, [kind.witness for kind in kinds]].sum(axis=1)
    order = np.argsort(-odds, kind="stable")
    order = order[odds[order] > learned.least]
    through, kept = exclude(teats[order], eyes), list[int]()
    for place, i in enumerate(order.tolist()):
        if through[place, kept].any():
            reasons[i] = WORSE
        elif len(kept) == prior.udder:
            reasons[i] = ONE_MORE
        else:
            reasons[i] = None
            kept.append(place)
    unlikely = odds <= learned.least
    unsure = short[:, [kind.lacking == UNSURE for kind in kinds]].sum(axis=1)
    by_witness, by_place = (unlikely & (odds + less > learned.least) for less in (witness, unsure))
    return Decision(odds, reasons, by_witness, by_place)


def means(ends: Array, odds: Array, rows: list[int]) -> tuple[Array, Array]:
    """Means (n, 3) and covariances (n, 3, 3) of the ends (m, 3) of fits in the places of ``rows``,
    weighted by their odds, of log ``odds`` (m,).
    """
    apart = ends - ends[rows, None]
    here = np.linalg.norm(apart, axis=2) < _ONE_PLACE_MM
    # of a likelier one that gave way to another teat there may be no more than of the given
    share = np.where(here, np.exp(np.minimum(odds - odds[rows, None], 0.0)), 0.0)
    share /= share.sum(axis=1, keepdims=True)
    mean = np.einsum("nm,nmi->ni", share, apart)
    off = apart - mean[:, None]
    return ends[rows] + mean, np.einsum("nm,nmi,nmj->nij", share, off, off)


_OVERLAP = 0.85  # two teats' axes are never closer than this share of the sum of their radii
_AXIS_MM = np.linspace(0.0, 60.0, 7)


def _solid(teats: Array) -> Array:
    """Points (m, 7, 3) along the axes of teats (m, 8)."""
    return np.asarray(teats[:, None, :3] + _AXIS_MM[:, None] * axes(teats)[:, None])


def pass_through(first: Array, second: Array) -> NDArray[np.bool_]:
    """Whether solid teats (m, 8) would be in others (k, 8): (m, k)."""
    one, other = (_solid(teats).reshape(-1, 3) for teats in (first, second))
    apart = (one**2).sum(axis=1)[:, None] + (other**2).sum(axis=1) - 2.0 * one @ other.T
    apart = apart.reshape(len(first), len(_AXIS_MM), len(second), len(_AXIS_MM))
    least = _OVERLAP * (first[:, None, RADIUS] + second[:, RADIUS])
    return np.asarray(apart.min(axis=(1, 3), initial=np.inf) < least**2)


def exclude(teats: Array, eyes: Array) -> NDArray[np.bool_]:
    """Which of teats (m, 8) can't both be given, (m, m): they would pass through each other, or one
    hides the other's end from both ``eyes`` (2, 3), the optical cameras' centres.
    """
    hidden = hidden_by(teats, eyes)
    return pass_through(teats, teats) | hidden | hidden.T


def hidden_by(teats: Array, eyes: Array) -> NDArray[np.bool_]:
    """Whether the end of each of teats (m, 8) is behind each of them from all ``eyes`` (n, 3),
    (m, m): the middle half of its width, where it is widest.
    """
    half = np.array([[-0.5], [0.5]]) * teats[:, None, RADIUS, None]
    points = teats[:, None, :3] + half * np.array([1.0, 0.0, 0.0])
    sights = points - eyes[:, None, None]
    far = np.linalg.norm(sights, axis=3)[..., None, None]
    out = _solid(teats) - eyes[:, None, None]
    along = np.einsum("empi,ekqi->empkq", sights / far[..., 0], out)
    aside2 = (out**2).sum(axis=3)[:, None, None] - along**2
    radii = _OVERLAP * teats[:, RADIUS, None]
    before = (along < far - radii) & (aside2 < radii**2)
    return np.asarray(before.any(axis=4).all(axis=(0, 2)))
