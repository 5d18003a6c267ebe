"""Looks for scenes on which a detector fails: evenly over a member's parameters first, then uphill
from the worst of these; and from each failure on to others, by drawing anew what does not matter to
it.

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

from bench.campaign.chunk import Bench, Rows, Scene, SceneRow, run_scene
from bench.scoring.errors import Floats
from bench.scoring.weighted import Proposal, WeightedRate, weighted_rate
from instruments.world.setups import Situation
from instruments.world.situations import ATTEMPTS, Around, drawn

APART = 0.2  # of the parameters' ranges, root mean square; two even points are 0.41 apart
EVEN_SHARE = 0.3  # of a search's scenes, before it goes uphill
STEP = 0.3  # of the parameters' ranges, at first
POPULATION = 8  # points of a generation
STALE = 3  # generations of a climb that bring nothing new, until it ends
BARREN = 8  # scenes beside failures that bring no new one, until it climbs again
LEG = 20  # scenes beside failures at most, until a generation of a climb
SURE = 3.0  # how much what was seen decides which parameters are drawn anew
FURTHER = 1.05  # than apart
ASKED = 1000  # points for one that can be set up
RATE_FIRST = 500_000_000  # the first member of which a rate is measured
GATE_MM = 25.0  # a missed or false teat is as bad as an error so large


@dataclass(frozen=True, slots=True, eq=False)
class Tried:
    """A scored scene: its point (d,) in shares of the ranges; a grade above the limit failed."""

    point: Floats
    grade_mm: float
    failed: bool
    row: SceneRow | None = None


# None for a point that can't be set up, which costs nothing
Evaluate = Callable[[Floats], Tried | None]


class NothingFitsError(Exception):
    """Of `ASKED` points none can be set up."""


def grade_mm(rows: Rows, detector: str, limit_mm: float) -> tuple[float, bool]:
    """How near a detector came to failing, and whether it did. A success: the worst of errors and
    stated deviations; a failure: the limit, `GATE_MM` a lost teat, and the excess error.
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


def search(
    evaluate: Evaluate, dimensions: int, scenes: int, seed: int, apart: float = APART
) -> Iterator[Tried]:
    """So many scenes, each as soon as it was scored. Raises NothingFitsError."""
    return islice(_Search(evaluate, dimensions, scenes, seed, apart).scenes(), scenes)


class _Kind:
    """Failures of one origin; (d,) counts of parameters drawn anew, and of these failures."""

    def __init__(self, first: Tried) -> None:
        self.failures = [first]
        self.redrawn, self.kept = np.zeros((2, len(first.point)))
        self.found = self.lost = 0


class _Search:
    """What a search around one member has tried so far."""

    def __init__(
        self, evaluate: Evaluate, dimensions: int, scenes: int, seed: int, apart: float
    ) -> None:
        self._evaluate, self._dimensions, self._apart = evaluate, dimensions, apart
        self._even = max(1, round(EVEN_SHARE * scenes))
        self._chance = np.random.default_rng([seed, *b"search"])
        self._tried: list[Tried] = []
        self._known: list[Tried] = []
        self._climbed: list[Tried] = []
        self._kinds: list[_Kind] = []

    def scenes(self) -> Iterator[Tried]:
        """Without an end."""
        evenly = _tried(self._evaluate, _sobol(self._chance, self._dimensions))
        for one in islice(evenly, self._even):
            if self._add(one):
                self._kinds.append(_Kind(one))
            yield one
        climb: Iterator[Tried] | None = None
        while True:
            before = len(self._tried)
            yield from self._spread()
            climb = climb or self._climb(self._start())
            between = len(self._tried)
            yield from islice(climb, POPULATION)
            if len(self._tried) < between + POPULATION:
                climb = None
            if len(self._tried) == before:  # nothing fits near what was tried
                one = next(evenly)
                self._add(one)
                yield one

    def _start(self) -> Tried:
        """The worst success apart from those that were climbed from before."""
        new = [one for one in self._tried if not _near(one.point, self._climbed, self._apart)]
        start = max(new or self._tried, key=lambda one: 0.0 if one.failed else one.grade_mm)
        self._climbed.append(start)
        return start

    def _add(self, one: Tried) -> bool:
        """Whether it is a failure apart from all that are known; then it is one of them."""
        self._tried.append(one)
        new = one.failed and not _near(one.point, self._known, self._apart)
        if new:
            self._known.append(one)
        return new

    def _spread(self) -> Iterator[Tried]:
        """Draw beside known failures until `BARREN` scenes bring no new one, or `LEG` are done."""
        barren = done = 0
        while self._kinds and barren < BARREN and done < LEG:
            done += 1
            kind = max(
                self._kinds, key=lambda one: self._chance.beta(1.0 + one.found, 1.0 + one.lost)
            )
            for _ in range(ASKED):
                point, changed = self._beside(kind)
                if _near(point, self._known, self._apart):
                    continue
                if (one := self._evaluate(point)) is not None:
                    break
            else:
                return
            kind.redrawn[changed] += 1.0
            kind.kept[changed] += one.failed
            kind.found, kind.lost = kind.found + one.failed, kind.lost + (not one.failed)
            if self._add(one):
                kind.failures.append(one)
                barren = 0
            else:
                barren += 1
            yield one

    def _beside(self, kind: _Kind) -> tuple[Floats, NDArray[np.intp]]:
        """A failure with parameters drawn anew, least important first, until it is apart."""
        whole = kind.failures[self._chance.integers(len(kind.failures))].point
        matters_not = (1.0 + kind.kept) / (2.0 + kind.redrawn)
        order = np.argsort(-SURE * np.log(matters_not) - self._chance.gumbel(size=len(whole)))
        drawn = self._chance.random(len(whole))
        moved = np.cumsum((drawn[order] - whole[order]) ** 2) / len(whole)
        changed = order[: 1 + int(np.searchsorted(moved, (FURTHER * self._apart) ** 2))]
        point = whole.copy()
        point[changed] = drawn[changed]
        return point, changed

    def _climb(self, start: Tried) -> Iterator[Tried]:
        """Scenes uphill by CMA-ES (Hansen, The CMA Evolution Strategy: A Tutorial, 2016) to the
        first failure that isn't known. One beside a known failure counts for nothing.
        """
        box = np.tile([0.0, 1.0], (len(start.point), 1))
        seed = int(self._chance.integers(2**31))
        steps = CMA(start.point, STEP, bounds=box, seed=seed, population_size=POPULATION)
        best, stale = start.grade_mm, 0
        while stale < STALE:
            asked = (steps.ask() for _ in count())
            graded, better = [], False
            for _ in range(steps.population_size):
                try:
                    one = next(_tried(self._evaluate, asked))
                except NothingFitsError:
                    return
                new = self._add(one)
                yield one
                if new:
                    self._kinds.append(_Kind(one))
                    return
                worth = 0.0 if one.failed else one.grade_mm
                better |= worth > best
                best = max(best, worth)
                graded.append((one.point, -worth))
            steps.tell(graded)
            stale = 0 if better else stale + 1


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


def _sobol(chance: np.random.Generator, dimensions: int) -> Iterator[Floats]:
    points = qmc.Sobol(dimensions, rng=chance)
    while True:
        yield from points.random(64)
