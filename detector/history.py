"""Where a cow's teat ends are expected, from her own earlier visits.

An udder fills between milkings, and its teats move apart: rear ones by nearly half, the others by
a quarter (Miller 1995). So each end's place in the udder, each coordinate by itself, is a line over
how full the udder is; the line is fitted to her own visits, with Miller's slope as a prior. Visits
are laid over one another by a turn about the vertical and a shift, and the ends seen now do the
same: they place the udder, and say by how they fit whether it is hers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from detector.geometry import Array
from detector.protocol import Context, Teat

FILLING_H = 8.0  # after so long, an udder has 63 % of what it gets
# share of a distance from the middle that milking takes, and its standard deviation
SHRINKS, SHRINKS_SD = 0.35, 0.15
OWN_MM = 1.0  # a teat's own variation
OWN_VISITS = 6.0  # how many visits that is worth
DRIFT_MM2_PER_DAY = 0.15  # of variance, of a visit long ago
LEAST_VISITS = 2
ABSENT = 2  # last visits: a teat that was in none of them may be gone
LEAST_SEEN = 2  # ends that place the udder
ROUNDS = 4
MISFIT2 = 6.0  # a degree of freedom, beyond which the ends seen aren't hers
TURN_SD = 0.12  # of how a cow stands, rad
CLEAR = 6.0  # of chi-square, by which no other teats fit as well


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedUdder:
    """Ends (n, 3) mm of ``teats`` in the udder's own frame at one fill, and the variance (n, 3) of
    each coordinate's expectation; ``own_mm2``: of a teat's own variation.
    """

    teats: tuple[int, ...]
    ends_mm: Array
    variance_mm2: Array
    own_mm2: float


def fill(hours_since_milking: float) -> float:
    """How full an udder is, 0 to 1."""
    return float(1.0 - np.exp(-max(hours_since_milking, 0.0) / FILLING_H))


def laid_over(ends_mm: Array, onto_mm: Array) -> tuple[Array, Array]:
    """The turn about the vertical (3, 3) and the shift (3,) that lay ends (n, 3) onto others."""
    middle, there = ends_mm.mean(axis=0), onto_mm.mean(axis=0)
    (x, y), (u, v) = (ends_mm - middle).T[:2], (onto_mm - there).T[:2]
    angle = np.arctan2((x * v - y * u).sum(), (x * u + y * v).sum()) if len(ends_mm) > 1 else 0.0
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return turn, there - turn @ middle


def udder_of(context: Context) -> ExpectedUdder | None:
    """What her visits say of her udder as full as it is now; None for too few visits."""
    visits = [visit for visit in context.visits if len(visit.teats) >= LEAST_SEEN]
    if len(visits) < LEAST_VISITS or context.hours_since_milking is None:
        return None
    teats = tuple(sorted({teat for visit in visits for teat in visit.teats}))
    fills = np.array([fill(visit.hours_since_milking) for visit in visits])
    places = np.full((len(visits), len(teats), 3), np.nan)
    own = np.zeros(places.shape)
    for k, visit in enumerate(visits):
        at = [teats.index(teat) for teat in visit.teats]
        places[k, at] = visit.ends_mm
        own[k, at] = np.einsum("nii->ni", visit.covariances_mm2)
    drift = DRIFT_MM2_PER_DAY * np.array([visit.hours_ago for visit in visits]) / 24.0
    variance = OWN_MM**2 + own + drift[:, None, None]
    full = max(range(len(visits)), key=lambda k: (len(visits[k].teats), k))
    laid = places - np.nanmean(places[full], axis=0)
    model = laid[full]
    for _ in range(ROUNDS):
        for k in range(len(visits)):
            known = np.isfinite(laid[k, :, 0]) & np.isfinite(model[:, 0])
            if known.sum() >= LEAST_SEEN:
                turn, shift = laid_over(laid[k, known], model[known])
                laid[k] = laid[k] @ turn.T + shift
        lines, spread, own_mm2 = _lines(laid, fills, variance)
        model = lines[..., 0]  # at a fill that all are laid over
    now = np.array([1.0, fill(context.hours_since_milking) - fills.mean()])
    ends = lines @ now
    uncertain = np.einsum("i,ncij,j->nc", now, spread, now)
    return ExpectedUdder(teats, ends, uncertain, own_mm2)


def _lines(laid: Array, fills: Array, variance: Array) -> tuple[Array, Array, float]:
    """Of each end and coordinate: place and slope over the fill (n, 3, 2), their covariance
    (n, 3, 2, 2), and the teats' own variance that the residuals show.
    """
    off = fills - fills.mean()
    n = laid.shape[1]
    lines, spread = np.zeros((n, 3, 2)), np.zeros((n, 3, 2, 2))
    middle = np.nanmean(laid, axis=(0, 1))
    squares, count = OWN_VISITS * OWN_MM**2, OWN_VISITS
    for i in range(n):
        known = np.isfinite(laid[:, i, 0])
        rows = np.column_stack([np.ones(known.sum()), off[known]])
        for c in range(3):
            weight = 1.0 / variance[known, i, c]
            apart = float(np.mean(laid[known, i, c]) - middle[c])
            slope, sd = SHRINKS * apart, SHRINKS_SD * abs(apart) + 2.0
            slope, sd = (slope, sd) if c < 2 else (0.0, 5.0)
            precision = (rows * weight[:, None]).T @ rows + np.diag([1e-6, sd**-2])
            right = (rows * weight[:, None]).T @ laid[known, i, c] + [0.0, slope / sd**2]
            spread[i, c] = np.linalg.inv(precision)
            lines[i, c] = spread[i, c] @ right
            residual = laid[known, i, c] - rows @ lines[i, c]
            if (more := known.sum() - 2) > 0:
                squares += float((residual**2 * weight).sum()) * OWN_MM**2
                count += more
    # laying it over the others took four numbers of each visit
    own_mm2 = squares / max(count - 4.0 * len(laid), OWN_VISITS)
    return lines, spread * own_mm2 / OWN_MM**2, own_mm2


def predicted(context: Context, seen: Sequence[Teat]) -> Mapping[int, Teat]:
    """Ends by teat that are hers and not among the ones ``seen``, world; none where these are too
    few, or aren't those of her udder.
    """
    udder = udder_of(context)
    if udder is None or not LEAST_SEEN <= len(seen) <= len(udder.teats):
        return {}
    ends = np.array([teat.world_mm for teat in seen])
    stated = [teat.covariance_mm2 for teat in seen if teat.covariance_mm2 is not None]
    common = np.mean(stated, axis=0) if stated else np.eye(3)
    if not (which := _assigned(udder, ends, float(np.trace(common)) / 3.0)):
        return {}
    there = [teat for visit in context.visits[-ABSENT:] for teat in visit.teats]
    turn, shift = laid_over(udder.ends_mm[which], ends)
    found = {}
    for i in set(range(len(udder.teats))) - set(which):
        if udder.teats[i] in there:
            place = turn @ udder.ends_mm[i] + shift
            found[udder.teats[i]] = Teat(place, _covariance(udder, i, which, turn) + common)
    return found


def _assigned(udder: ExpectedUdder, ends_mm: Array, stated_mm2: float) -> list[int]:
    """Which of her teats the ends (k, 3) are; none if they aren't hers, or it might be others."""
    k = len(ends_mm)
    found = []
    for which in map(list, permutations(range(len(udder.teats)), k)):
        turn, shift = laid_over(udder.ends_mm[which], ends_mm)
        off = ends_mm - udder.ends_mm[which] @ turn.T - shift
        variance = udder.variance_mm2[which] + udder.own_mm2 + stated_mm2
        angle = float(np.arctan2(turn[1, 0], turn[0, 0]))
        found.append((float((off**2 / variance).sum()) + (angle / TURN_SD) ** 2, which))
    (best, which), *others = sorted(found)
    clear = not others or others[0][0] - best > CLEAR
    return which if clear and best < MISFIT2 * (3 * k - 3) else []


def _covariance(udder: ExpectedUdder, i: int, which: Sequence[int], turn: Array) -> Array:
    """(3, 3) mm^2 of an end placed by those of ``which``: its own, and the placing's."""
    variance, flat, seen = udder.variance_mm2 + udder.own_mm2, udder.ends_mm[:, :2], list(which)
    mine, by = np.diag(variance[i]), np.mean(variance[seen], axis=0)
    flat = flat - flat[seen].mean(axis=0)
    x, y = flat[i]
    lever = np.array([-y, x, 0.0])
    turned = np.outer(lever, lever) * by[:2].mean() / max(float((flat[seen] ** 2).sum()), 1.0)
    return np.asarray(turn @ (mine + np.diag(by) / len(which) + turned) @ turn.T)


def last_visit(context: Context, seen: Sequence[Teat]) -> Mapping[int, Array]:
    """To compare with: what the last visit that has more ends says, laid over those seen."""
    enough = (v for v in reversed(context.visits) if len(v.teats) > len(seen) >= LEAST_SEEN)
    if (visit := next(enough, None)) is None:
        return {}
    ends, there = np.array([teat.world_mm for teat in seen]), visit.ends_mm
    loose = ExpectedUdder(visit.teats, there, np.zeros(there.shape), 36.0)  # at another fill
    if not (which := _assigned(loose, ends, 1.0)):
        return {}
    turn, shift = laid_over(there[which], ends)
    others = [i for i in range(len(visit.teats)) if i not in which]
    return {visit.teats[i]: turn @ there[i] + shift for i in others}
