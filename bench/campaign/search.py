"""Looks for scenes on which a detector fails: evenly over a member's parameters first, then uphill
from the worst of these.

What it finds are failures, not how often they come: their share among what it tried says nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count, islice

import numpy as np
from cmaes import CMA
from numpy.typing import NDArray
from scipy.stats import qmc

from bench.campaign.chunk import (
    Bench,
    Rows,
    Scene,
    SceneRow,
    run_scene,
)
from bench.scoring.weighted import Proposal, WeightedRate, weighted_rate
from instruments.world.setups import Situation
from instruments.world.situations import ATTEMPTS, Around, drawn

Floats = NDArray[np.float64]

APART = 0.2  # of the parameters' ranges, root mean square; two even points are 0.41 apart
EVEN_SHARE = 0.3  # of a search's scenes, before it goes uphill
STEP = 0.3  # of the parameters' ranges, at first
POPULATION = 8  # points of a generation
STALE = 3  # generations of a climb that bring nothing new, until it ends
ASKED = 1000  # points for one that can be set up
RATE_FIRST = 500_000_000  # the first member of which a rate is measured
GATE_MM = 25.0  # a missed or false teat is as bad as an error so large


@dataclass(frozen=True, slots=True, eq=False)
class Tried:
    """A scene that was scored: its point (d,), in shares of the parameters' ranges, and its grade,
    which is above the limit where the detector failed.
    """

    point: Floats
    grade_mm: float
    failed: bool
    row: SceneRow | None = None


# None for a point that can't be set up, which costs nothing
Evaluate = Callable[[Floats], Tried | None]


class NothingFitsError(Exception):
    """Of `ASKED` points none can be set up."""


def grade_mm(rows: Rows, detector: str, limit_mm: float) -> tuple[float, bool]:
    """How near a detector came to failing on one scene, and whether it did.

    For a success the worst of its teats' errors and of their standard deviations by the detector's
    own account, at most the limit. A failure is the limit, and `GATE_MM` for each teat missed or
    false, and the worst error above the limit.
    """
    row: SceneRow = next(one for one in rows.scenes if one.detector == detector)
    worst = row.max_mm or 0.0
    if row.failure:
        lost = row.missed + row.false_teats or int(row.max_mm is None)
        return limit_mm + GATE_MM * lost + max(0.0, worst - limit_mm), True
    sd = max(
        (
            float(np.linalg.norm([teat.sd_x_mm, teat.sd_y_mm or 0.0, teat.sd_z_mm or 0.0]))
            for teat in rows.teats
            if teat.detector == detector and teat.sd_x_mm is not None
        ),
        default=0.0,
    )
    return min(limit_mm, max(worst, sd)), False


def distinct(tried: Sequence[Tried], apart: float = APART) -> list[Tried]:
    """The failures that are `apart` from all those before them, in the order found."""
    kept: list[Tried] = []
    for one in tried:
        if one.failed and not _near(one.point, kept, apart):
            kept.append(one)
    return kept


def at_random(evaluate: Evaluate, dimensions: int, scenes: int, seed: int) -> list[Tried]:
    """So many scenes as the family draws them: what a search is compared with."""
    chance = np.random.default_rng([seed, *b"random"])
    return list(islice(_tried(evaluate, _random(chance, dimensions)), scenes))


def search(
    evaluate: Evaluate, dimensions: int, scenes: int, seed: int, apart: float = APART
) -> Iterator[Tried]:
    """So many scenes, each as soon as it was scored. Raises NothingFitsError."""
    chance = np.random.default_rng([seed, *b"search"])
    tried: list[Tried] = []
    failures: list[Tried] = []
    even = islice(_tried(evaluate, _sobol(chance, dimensions)), max(1, round(EVEN_SHARE * scenes)))
    for one in even:
        tried.append(one)
        failures += distinct([*failures, one], apart)[len(failures) :]
        yield one
    climbed: list[Tried] = []
    while len(tried) < scenes:
        new = [one for one in tried if not _near(one.point, climbed, apart)]
        start = max(new or tried, key=lambda one: one.grade_mm)
        climbed.append(start)
        for one in _climb(evaluate, start, failures, chance, apart):
            tried.append(one)
            yield one
            if len(tried) == scenes:
                return


def _climb(
    evaluate: Evaluate,
    start: Tried,
    failures: list[Tried],
    chance: np.random.Generator,
    apart: float,
) -> Iterator[Tried]:
    """Scenes uphill by CMA-ES (Hansen, The CMA Evolution Strategy: A Tutorial, 2016). A failure
    beside one that is known counts for nothing, so that it goes on to others; new ones are added.
    """
    box = np.tile([0.0, 1.0], (len(start.point), 1))
    steps = CMA(
        start.point, STEP, bounds=box, seed=int(chance.integers(2**31)), population_size=POPULATION
    )
    best, stale = start.grade_mm, 0
    while stale < STALE:
        asked = (steps.ask() for _ in count())
        told, found = [], False
        for _ in range(steps.population_size):
            try:
                one = next(_tried(evaluate, asked))
            except NothingFitsError:
                return
            yield one
            new = one.failed and not _near(one.point, failures, apart)
            if new:
                failures.append(one)
            worth = one.grade_mm if new or not one.failed else 0.0
            found |= new or worth > best
            best = max(best, worth)
            told.append((one.point, -worth))
        steps.tell(told)
        stale = 0 if found else stale + 1


def evaluate_around(bench: Bench, around: Around) -> Evaluate:
    """Scores points of a member's parameters with the first detector of the bench."""

    def evaluate(point: Floats) -> Tried | None:
        shares = dict(zip(around.parameters, point.tolist(), strict=True))
        found, _ = around.at(shares)
        scene = Scene(around.name, around.seed)
        return None if found is None else _scored(bench, scene, found, point)

    return evaluate


def _scored(bench: Bench, scene: Scene, found: Situation, point: Floats) -> Tried | None:
    try:
        rows = run_scene(bench, scene, found)
    except ValueError:  # a thing too near a camera
        return None
    grade, failed = grade_mm(rows, bench.detectors[0].name, bench.limit_mm)
    return Tried(point, grade, failed, rows.scenes[0])


def family_rate(
    bench: Bench, family: str, known: Sequence[Mapping[str, float]], scenes: int
) -> Iterator[WeightedRate]:
    """The family's failure rate after each of so many scenes, half of them drawn near failures that
    are ``known`` by the shares of their parameters. Their members are none that was searched.
    """
    names = list(dict.fromkeys(name for one in known for name in one))
    table = np.array([[one.get(name, np.nan) for name in names] for one in known])
    proposal = Proposal.around(table) if names else Proposal(np.empty(0), np.empty(0), 1.0)
    failed: list[bool] = []
    weights: list[float] = []
    for member in range(RATE_FIRST, RATE_FIRST + scenes):
        chance = np.random.default_rng([bench.seed, member, *family.encode()])
        for attempt in range(ATTEMPTS):
            point = proposal.draw(chance)
            shares = dict(zip(names, point.tolist(), strict=True))
            found, parameters = drawn(family, member, attempt, shares)
            if found and (one := _scored(bench, Scene(family, member), found, point)):
                there = np.array([name in parameters for name in names], dtype=np.bool_)
                weights.append(proposal.weight(np.where(there, point, np.nan)))
                failed.append(one.failed)
                yield weighted_rate(failed, weights, proposal.largest)
                break


def _tried(evaluate: Evaluate, points: Iterator[Floats]) -> Iterator[Tried]:
    while True:
        for point in islice(points, ASKED):
            if (one := evaluate(point)) is not None:
                yield one
                break
        else:
            raise NothingFitsError


def _near(point: Floats, others: Sequence[Tried], apart: float) -> bool:
    return any(np.sqrt(np.mean((point - one.point) ** 2)) < apart for one in others)


def _random(chance: np.random.Generator, dimensions: int) -> Iterator[Floats]:
    while True:
        yield chance.random(dimensions)


def _sobol(chance: np.random.Generator, dimensions: int) -> Iterator[Floats]:
    points = qmc.Sobol(dimensions, rng=chance)
    while True:
        yield from points.random(64)
