"""``python -m tests.learn_fused --frames DIR``: learns what `fused` decides and states by, and
writes detector/fused/learned.json.

Scenes of all families are drawn on the shipped rig, some of each on rigs drawn at random, scenes of
the free range of `bench.testing` and of lines beside teats (two families more), and those that were
difficult; DIR keeps their frames. The detector runs on them and shows what it measures of every
fit. The log odds of a fit are linear in that: weights are the maximum a posteriori with a ridge, of
fits labelled by whether an end is near. The least odds of what is given are the least that do about
as well as the best. Variances are linear in their terms: factors, none negative, are those of the
greatest likelihood of the errors that were made, on perturbed pictures of some scenes too (an end
taken for another's counts for none of them). The likelihood is that of a power exponential
distribution (Gómez, Gómez-Villegas, Marín 1998), whose tails are lighter than a normal one's: a
normal one's leaves more ends beyond the 99 % region than that has by right. Both are done twice, as
the first answers change which fits are tried; ``--spread`` learns the variances alone, and the odds
stay. The limits by which fits are tried again stay, unless ``--limits`` tries two others of each,
by a run on all scenes for each.

The gate: each family is judged by weights that were learned without it. A change passes that has as
many ends found, less four for each false one, as the file says.
"""

from __future__ import annotations

import argparse
import json
import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import gamma

import detector.fused.detector as fused
from bench.campaign.perturbations import Applied
from bench.rig.loading import find_rig, load_rig
from bench.rig.moved import drawn
from bench.rig.scenes import draw, renderer_of, rig_renderer, warm
from bench.scoring.matching import gate_mm, match
from detector.calibration import Calibration, ParameterCovariance
from detector.external.serve import Pictures
from detector.fused.covariances import TERMS
from detector.fused.decide import MEASURES, exclude, means, measures
from detector.fused.evidence import Evidence
from detector.fused.learned import FILE, in_order
from detector.outline.model import apexes
from detector.outline.prior import Prior, eyes_mm, world_from_teats
from instruments.world.scene import Renderer
from instruments.world.situations import SITUATIONS, member
from tests.detector.fused.beside_scenes import NAME as BESIDE
from tests.detector.fused.beside_scenes import beside_scene
from tests.detector.fused.difficult import DIFFICULT, Rendered, rendered
from tests.detector.fused.free_scenes import free_scene

Array = NDArray[np.float64]
SEED, FIRST, MEMBERS, RIGS, ON_A_RIG = 1, 200, 120, 26, 6
FREE, FREE_SCENES = "free", 480
# a scene of each family, its pictures perturbed by an amount in a range: the variances learn of them
PERTURBED = "perturbed"
AMOUNTS = {
    "defocus": (0.5, 3.0),
    "exposure": (1.3, 2.5),
    "gamma": (0.45, 2.0),
    "jpeg": (30.0, 90.0),
}
POWER = 1.5  # of squared errors, in the likelihood of the variances; 1 is that of a normal one
EXACT = ParameterCovariance((), np.zeros((0, 0)))
NEAR_MM = 4.0  # a fit whose end is so near to a teat's is right
RIDGE, NOT_SURE_MM, LESS = 1.5e-3, (2.5, 6.0), 0.3
AGAIN, WITHIN = 2, 0.2
# a false end counts as so many that are missed
FALSE, LEASTS = 4, (-1.2, -0.9, -0.6, -0.3, 0.0, 0.3)
NEARLY = 0.999  # of the best gain: of least odds that do as well the least, which finds the most

# what is tried of the limits by which fits are tried again
LIMITS: dict[str, tuple[float, float]] = {
    "side": (0.4, 0.6),
    "end, one side": (0.6, 0.8),
    "end, both sides": (0.75, 0.95),
    "end, another shape": (0.3, 0.5),
    "longest side": (0.9, 1.01),
    "misfit, px": (0.03, 0.1),
    "sd, mm": (0.2, 0.5),
    "odds beyond doubt": (2.0, 4.0),
    "thermal end, clear": (0.75, 0.85),
    "thermal end, counted": (0.8, 0.9),
    "side goes on, mm": (5.0, 10.0),
}


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """Of one scene the fits' measures (m, k) and ends (m, 3), which pass through which (m, m), and
    of the answers their errors (a, 3), covariances (a, 3, 3) by what isn't learned, and variance
    terms (a, k, 3, 3), world.
    """

    family: str
    ends_mm: Array
    visible: NDArray[np.bool_]
    seen: Array
    places_mm: Array
    through: NDArray[np.bool_]
    errors_mm: Array
    rest: Array
    terms: Array


def scenes(frames: Path) -> Iterator[tuple[str, Calibration, Any]]:
    """Family, calibration, and pictures with truth, drawn where DIR doesn't have them."""
    rig = load_rig(find_rig(None))
    usual, names = rig_renderer(rig, SEED), list(SITUATIONS)
    for k in range(FIRST, FIRST + MEMBERS):
        for name in names:
            path = frames / f"{name}-{k}.npz"
            yield from _kept(path, name, rig.calibration, partial(_drawn, usual, name, k))
    for k in range(FIRST, FIRST + RIGS):
        calibration = drawn(rig.calibration, np.random.default_rng([7, k]))
        for n in range(ON_A_RIG):
            name = names[(5 * (k - FIRST) + 4 * n) % len(names)]
            path, renderer = frames / f"rig_{name}-{k}.npz", renderer_of(calibration, usual, SEED)
            yield from _kept(path, name, calibration, partial(_drawn, renderer, name, k))
    for k in range(FIRST, FIRST + FREE_SCENES):
        path, draws = frames / f"{FREE}-{k}.npz", partial(_drawn, usual, FREE, k)
        yield from _kept(path, FREE, rig.calibration, draws)
    for k in range(FIRST, FIRST + MEMBERS):
        path, draws = frames / f"{BESIDE}-{k}.npz", partial(_drawn, usual, BESIDE, k)
        yield from _kept(path, BESIDE, rig.calibration, draws)
    for name, noise, k in DIFFICULT:
        path, renderer = frames / f"{name}-{k}-{noise}.npz", rig_renderer(rig, noise)
        yield from _kept(path, name, rig.calibration, partial(rendered, renderer, name, noise, k))
    for name in names:
        for kind, (low, high) in AMOUNTS.items():
            chance = np.random.default_rng([13, FIRST, *name.encode(), *kind.encode()])
            done = Applied(kind, float(chance.uniform(low, high)))
            path, draws = (
                frames / f"{kind}_{name}-{FIRST}.npz",
                partial(_drawn, usual, name, FIRST, done),
            )
            yield from _kept(path, PERTURBED, rig.calibration, draws)


def _kept(
    path: Path, name: str, calibration: Calibration, draws: Callable[[], Rendered]
) -> Iterator[tuple[str, Calibration, Any]]:
    """One scene, or none where a thing is too near a camera."""
    if not path.exists():
        try:
            np.savez(path, **draws()._asdict())
        except ValueError:
            return
    yield name, replace(calibration, covariance=EXACT), np.load(path)


def _drawn(renderer: Renderer, name: str, k: int, *done: Applied) -> Rendered:
    if name == FREE:
        state = free_scene(k).state()
    else:
        state = warm(beside_scene(k) if name == BESIDE else member(name, k)[0])
    shot = draw(renderer, name, state, [SEED, k], done, [SEED, k])
    ends = np.array([row.xyz_mm for row in shot.truth])
    visible = np.array([row.visible for row in shot.truth])
    thermal_k = np.asarray(shot.frames.thermal_ck) / 100.0
    return Rendered(shot.frames.left, shot.frames.right, thermal_k, ends, visible)


def shown_of(family: str, calibration: Calibration, data: Any) -> Shown | None:
    """What the detector shows of a scene; None where it doesn't come to fits."""
    pictures = Pictures(data["left"], data["right"], None, data["thermal_k"])
    answer = fused.FusedDetector().detect(pictures, calibration)
    stage, given = answer.stage("decisions"), answer.stage("answers")
    if stage is None:
        return None
    ends, visible, prior = data["ends_mm"], data["visible"], Prior()
    teats, world = stage.data["teats"], world_from_teats(calibration)
    evidence = Evidence(*(stage.data[name] for name in Evidence.__slots__))
    places = world.apply(apexes(teats))
    errors, rest, terms = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, len(TERMS), 3, 3))
    if given is not None and len(given.data["rows"]):
        found = world.apply(given.data["ends"])
        pairs = match(found, ends, visible, gate_mm(ends)).pairs
        which = [i for i, _ in pairs]
        errors = np.array([found[i] - ends[j] for i, j in pairs]).reshape(-1, 3)
        rest, terms = (world.R @ given.data[of][which] @ world.R.T for of in ("rest", "terms"))
    return Shown(
        family, ends, visible, measures(teats, evidence, prior), places,
        exclude(teats, eyes_mm(calibration)), errors, rest, terms,
    )  # fmt: skip


def every_shown(frames: Path) -> list[Shown]:
    """Of all scenes."""
    return [shown for scene in scenes(frames) if (shown := shown_of(*scene))]


def plain(some: Sequence[Shown]) -> list[Shown]:
    """Those that aren't perturbed: what odds are learned of and judged by."""
    return [one for one in some if one.family != PERTURBED]


def _off(one: Shown) -> Array:
    """How far each fit's end is from the nearest (m,), mm."""
    away = np.linalg.norm(one.places_mm[:, None] - one.ends_mm, axis=2)
    return np.asarray(away.min(axis=1))


def learned_odds(some: Sequence[Shown], start: Array | None = None) -> tuple[Array, float]:
    """Weights (k,) and bias. Fits that lie within a likelier right one are neither given nor looked
    at, and count for less; which these are hangs on the weights, so this is done again.
    """
    seen = np.concatenate([one.seen for one in some])
    off = [_off(one) for one in some]
    far = np.concatenate(off)
    usual = np.where((far > NOT_SURE_MM[0]) & (far < NOT_SURE_MM[1]), LESS, 1.0)
    weights, bias = _odds(seen, far < NEAR_MM, usual, start)
    for _ in range(AGAIN):
        within = []
        for one, mm in zip(some, off, strict=True):
            odds = one.seen @ weights + bias
            likelier = one.through & (odds[None] > odds[:, None]) & (mm < NEAR_MM)[None]
            within.append(likelier.any(axis=1))
        trust = np.where(np.concatenate(within), WITHIN * usual, usual)
        weights, bias = _odds(seen, far < NEAR_MM, trust, np.r_[weights, bias])
    return weights, bias


def _odds(
    seen: Array, label: NDArray[np.bool_], trust: Array, start: Array | None
) -> tuple[Array, float]:
    """By Newton's method on the ridge-penalised log likelihood, from ``start`` (k + 1,) on."""
    middle, spread = seen.mean(axis=0), seen.std(axis=0) + 1e-9
    z = np.column_stack([(seen - middle) / spread, np.ones(len(seen))])
    ridge = RIDGE * trust.sum() * np.r_[np.ones(seen.shape[1]), 0.0]
    weights = np.zeros(z.shape[1])
    if start is not None:
        weights = np.r_[start[:-1] * spread, start[-1] + start[:-1] @ middle]
    for _ in range(50):
        share = 1.0 / (1.0 + np.exp(-z @ weights))
        slope = z.T @ (trust * (share - label)) + ridge * weights
        bend = (z * (trust * share * (1 - share))[:, None]).T @ z + np.diag(ridge + 1e-9)
        step = np.linalg.solve(bend, slope)
        weights -= step
        if np.abs(step).max() < 1e-4:
            break
    plain = weights[:-1] / spread
    return plain, float(weights[-1] - plain @ middle)


def learned_spread(some: Sequence[Shown]) -> Array:
    """Factors (k,) of the terms."""
    errors, rest, terms = (
        np.concatenate([getattr(one, name) for one in some])
        for name in ("errors_mm", "rest", "terms")
    )
    near = np.linalg.norm(errors, axis=1) < 15.0  # farther off it is another's end
    errors, rest, terms = errors[near], rest[near], terms[near]
    parts = terms.transpose(0, 2, 3, 1).reshape(-1, len(TERMS))
    # such that it is least at the true covariance where errors are normal
    share = 3 * gamma(1.5) / (2 * POWER * 2**POWER * gamma(1.5 + POWER))

    def cost(log: Array) -> tuple[float, Array]:
        variance = np.exp(2 * log)
        total = (parts @ variance).reshape(rest.shape) + rest
        inverse = np.linalg.inv(total)
        towards = (inverse @ errors[..., None])[..., 0]
        square = (errors * towards).sum(axis=1)
        value = 0.5 * np.linalg.slogdet(total)[1] + share * square**POWER
        pull = 2 * share * POWER * square ** (POWER - 1)
        by_total = inverse - pull[:, None, None] * towards[:, :, None] * towards[:, None]
        return float(value.mean()), (by_total.ravel() @ parts) * variance / len(errors)

    # each begins by as much of the squared errors as each other: from nothing there is no slope
    each = np.trace(terms, axis1=2, axis2=3).mean(axis=0)
    start = 0.5 * np.log(np.square(errors).sum(axis=1).mean() / len(TERMS) / each)
    bounds = [(-8.0, 5.0)] * len(TERMS)
    # by default it stops on slow slopes far from the best
    stop = {"ftol": 1e-15, "maxiter": 2000, "maxfun": 4000}
    found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options=stop)
    return np.asarray(np.where(found.x > -7.0, np.exp(found.x), 0.0))


def learned_limits(frames: Path) -> dict[str, float]:
    """Each of `LIMITS` in turn, from those in use on: the least change that does best."""
    now, best, limits = fused.LEARNED, -np.inf, dict(fused.LEARNED.limits)
    by = in_order(now.weights, MEASURES), now.bias, now.least
    tried = [(name, value) for name, values in LIMITS.items() for value in values]
    for name, value in [("side", limits["side"]), *tried]:
        fused.LEARNED = replace(now, limits=limits | {name: value})
        count = judged(plain(every_shown(frames)), *by)
        if (gain := count["found"] - FALSE * count["false"]) > best:
            best, limits = gain, limits | {name: value}
    fused.LEARNED = now
    return limits


def judged(some: Sequence[Shown], weights: Array, bias: float, least: float) -> dict[str, Any]:
    """Ends visible and found, and false ones, of the best sets by these odds, and the mean mm."""
    count: dict[str, Any] = {"visible": 0, "found": 0, "false": 0}
    off = list[float]()
    for one in some:
        odds, kept = one.seen @ weights + bias, list[int]()
        for i in np.argsort(-odds, kind="stable").tolist():
            if odds[i] > least and len(kept) < Prior().udder and not one.through[i, kept].any():
                kept.append(i)
        ends, _ = means(one.places_mm, odds, kept)
        found = match(ends, one.ends_mm, one.visible, gate_mm(one.ends_mm))
        count["visible"] += found.counts.visible
        count["found"] += found.counts.matched
        count["false"] += found.counts.false
        off += [float(np.linalg.norm(ends[i] - one.ends_mm[j])) for i, j in found.pairs]
    return count | {"mean mm": round(float(np.mean(off)), 4)}


def decided(some: Sequence[Shown], limits: dict[str, float]) -> dict[str, Any]:
    """The learned file's table, but for the spread."""
    weights, bias = learned_odds(some)
    apart = list[tuple[str, list[Shown], tuple[Array, float]]]()
    for name in (*SITUATIONS, FREE, BESIDE):
        others = learned_odds([one for one in some if one.family != name], np.r_[weights, bias])
        apart.append((name, [one for one in some if one.family == name], others))

    def figures(least: float) -> dict[str, dict[str, Any]]:
        return {name: judged(own, *by, least) for name, own, by in apart}

    def gain(least: float) -> int:
        return sum(one["found"] - FALSE * one["false"] for one in figures(least).values())

    gains = {least: gain(least) for least in LEASTS}
    least = min(at for at, ends in gains.items() if ends >= NEARLY * max(gains.values()))
    right = np.concatenate([one.seen[_off(one) < NEAR_MM] for one in some])
    usual = dict(zip(MEASURES, np.round(right.mean(axis=0), 4).tolist(), strict=True))
    by_name = dict(zip(MEASURES, np.round(weights, 4).tolist(), strict=True))
    made = {"seed": SEED, "first": FIRST, "members": MEMBERS, "rigs": RIGS, "scenes": len(some)}
    odds = {"least": least, "bias": round(bias, 4), "weights": by_name, "usual": usual}
    return {
        "made": made | {"fits": sum(len(one.seen) for one in some)},
        "odds": odds,
        "spread": {},
        "limits": limits,
        "families left out": figures(least),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=FILE)
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--limits", action="store_true", help="learn the limits of refits too")
    what.add_argument("--spread", action="store_true", help="learn the variances alone")
    given = parser.parse_args()
    given.frames.mkdir(parents=True, exist_ok=True)
    some = every_shown(given.frames)
    (given.frames / "shown.pickle").write_bytes(pickle.dumps(some))  # for studies
    if given.spread:
        table = json.loads(FILE.read_text(encoding="utf-8"))
    else:
        tried = learned_limits(given.frames) if given.limits else dict(fused.LEARNED.limits)
        table = decided(plain(some), tried)
    factors = np.round(learned_spread(some), 5).tolist()
    table["spread"] = dict(zip(TERMS, factors, strict=True))
    ends = (sum(len(one.errors_mm) for one in of) for of in (plain(some), some))
    table["made"] |= dict(zip(("ends", "ends with perturbed"), ends, strict=True))
    given.out.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    for key in ("visible", "found", "false"):
        left_out = sum(one[key] for one in table["families left out"].values())
        print(f"{key}, families left out in turn: {left_out}")


if __name__ == "__main__":
    main()
