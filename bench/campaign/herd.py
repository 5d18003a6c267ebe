"""A simulated herd: cows that come several times, with teats that are hidden now and then, to score
what a detector makes of a cow's history. Predicted ends have a score of their own.

Udders fill between milkings and shrink by them (Miller 1995: rear teats come nearer to each other
by 45 to 50 %, others by 25 to 29 %), grow or shrink by days, and each teat stands a millimetre
elsewhere at each visit. A post hides a teat; a quarter may go dry, and its teat is gone.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import astuple, dataclass, fields, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import cast

import numpy as np

from bench.campaign.chunk import CHI2_95_OF_3, EXACT
from bench.campaign.visits import Confirmed, VisitStore
from bench.config import ConfigError
from bench.rig.loading import find_rig, load_rig
from bench.rig.scenes import draw, rig_renderer, warm
from detector import registry
from detector.calibration import Calibration
from detector.geometry import Array
from detector.history import last_visit
from detector.protocol import Context, Detection, WithContext
from instruments.world.draws import PLACES, Draw, plain, udder
from instruments.world.objects import make_object
from instruments.world.phantom import Phantom, PlatePose, Teat
from instruments.world.scene import Renderer
from instruments.world.setups import EYES_MM, Situation, faults

START = datetime(2026, 1, 1, tzinfo=UTC)
SPREAD = 1.25  # of a full udder against those of the families, so that teats stay apart when empty
HIDDEN, MOST_HIDDEN = 0.2, 2
GOES_DRY = 0.0006  # a quarter and visit
BY_HAND = 0.5  # of hidden teats that are attached after all
OWN_MM, ATTACHED_MM = 1.0, 0.4  # a teat's own variation; how well an attached end is known
NEAR_MM = 30.0  # a prediction farther from any unseen end invents a teat
DETECTOR = "fused"  # the one that ships and makes use of a history
VISITS, ROWS = "visits.sqlite", "herd.csv"
POST_MM = 38.0  # before a hidden end
FIRST = 3  # visits that only make the history


@dataclass(frozen=True, slots=True)
class Guess:
    """One unseen end at one visit, or an invented one (``teat`` 0). Errors are by own history, by
    the last visit, by another cow's history; ``inside`` its 95 % region.
    """

    cow: int
    visit: int
    teat: int
    error_mm: float | None = None
    last_mm: float | None = None
    swapped_mm: float | None = None
    inside: bool | None = None
    volume_ml: float | None = None
    found: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Stand:
    """A cow at one visit: full udder or less; ``teats`` that are there, from 1, ``hidden`` ones."""

    at: datetime
    hours: float
    days: float
    phantom: Phantom
    teats: tuple[int, ...]
    hidden: frozenset[int]

    @property
    def ends_mm(self) -> Array:
        return self.phantom.ends_mm


class Cow:
    """Cow ``number`` of a herd; all of her visits follow from both numbers."""

    def __init__(self, seed: int, number: int, visits: int) -> None:
        self._chance = np.random.default_rng([seed, number, *b"herd"])
        self._full = udder(Draw("herd", seed, number), spread=SPREAD)
        between = self._chance.uniform
        self._filling_h, self._growth = between(6.0, 10.0), between(-0.003, 0.006)
        rear, others = between(0.45, 0.50), between(0.25, 0.29)
        self._shrinks = np.array([[rear if y < 0 else others, others] for _, y in PLACES])
        self._dry: set[int] = set()
        self.stands = tuple(self._visits(visits))

    def _visits(self, count: int) -> Iterator[Stand]:
        at, first_day = START, self._chance.uniform(10.0, 250.0)
        for _ in range(count):
            hours = float(self._chance.uniform(4.0, 14.0))
            at += timedelta(hours=hours)
            days = (at - START) / timedelta(days=1)
            self._dry |= {t for t in (1, 2, 3, 4) if self._chance.random() < GOES_DRY}
            teats = tuple(t for t in (1, 2, 3, 4) if t not in self._dry)
            hidden = [t for t in teats if self._chance.random() < HIDDEN][:MOST_HIDDEN]
            phantom = self._stands(hours, days, teats)
            yield Stand(at, hours, first_day + days, phantom, teats, frozenset(hidden))

    def _stands(self, hours: float, days: float, teats: tuple[int, ...]) -> Phantom:
        share = 1.0 - self._shrinks * math.exp(-hours / self._filling_h)
        bases = np.array([teat.base_mm for teat in self._full.teats])
        middle = bases.mean(axis=0)
        bases = middle + (bases - middle) * share * (1.0 + self._growth * days)
        bases += self._chance.normal(0.0, OWN_MM, bases.shape)
        longer = self._chance.normal(0.0, OWN_MM, len(bases))
        moved = [self._teat(t, bases[t - 1], float(longer[t - 1])) for t in teats]
        x, y = self._chance.uniform(-12.0, 12.0, 2)
        turn = math.radians(self._chance.uniform(-4.0, 4.0))
        return Phantom(tuple(moved), PlatePose(float(x), float(y), 0.0, turn))

    def _teat(self, number: int, base_mm: Array, longer_mm: float) -> Teat:
        usual = self._full.teats[number - 1]
        shape = replace(usual.shape, length_mm=usual.shape.length_mm + longer_mm)
        return replace(usual, base_mm=(float(base_mm[0]), float(base_mm[1])), shape=shape)


def record_visits(store: VisitStore, name: str, cow: Cow, chance: np.random.Generator) -> None:
    """Add a cow's confirmed ends: those that were attached, hidden ones only now and then."""
    sure = ATTACHED_MM**2 * np.eye(3)
    for stand in cow.stands:
        ends = {
            teat: Confirmed(end + chance.normal(0.0, ATTACHED_MM, 3), sure, "attached")
            for teat, end in zip(stand.teats, stand.ends_mm, strict=True)
            if teat not in stand.hidden or chance.random() < BY_HAND
        }
        store.add(name, stand.at, stand.hours, ends, stand.days)


def run_herd(
    folder: Path,
    cows: int,
    visits: int,
    seed: int,
    workers: int | None = None,
    shown: Callable[[int, int], None] = lambda _done, _of: None,
) -> tuple[Guess, ...]:
    """The guesses of a herd; ``folder`` gets the visits and a row a guess. Raises ConfigError."""
    if folder.exists() and any(folder.iterdir()):
        raise ConfigError.plain(f"{folder} is there already. Name a new folder.")
    folder.mkdir(parents=True, exist_ok=True)
    store, chance = VisitStore(folder / VISITS), np.random.default_rng([seed, *b"attached"])
    for number in range(cows):
        record_visits(store, str(number), Cow(seed, number, visits), chance)
    jobs = [(folder, seed, number, cows, visits) for number in range(cows)]
    guesses: list[Guess] = []
    with ExitStack() as stack:
        stack.callback(_bench.cache_clear)  # a renderer is some 100 MB
        each: Iterable[list[Guess]] = (of_cow(*job) for job in jobs)
        if workers != 1:
            apart = ProcessPoolExecutor(workers, mp_context=get_context("spawn"))
            each = stack.enter_context(apart).map(of_cow, *zip(*jobs, strict=True))
        for done, found in enumerate(each, 1):
            guesses += found
            shown(done * visits, cows * visits)
    with (folder / ROWS).open("w", encoding="utf-8", newline="") as file:
        lines = csv.writer(file)
        lines.writerow([one.name for one in fields(Guess)])
        lines.writerows(map(astuple, guesses))
    return tuple(guesses)


def of_cow(folder: Path, seed: int, number: int, cows: int, visits: int) -> list[Guess]:
    """The guesses of one cow's visits."""
    renderer, calibration = _bench(seed)
    store, detector = VisitStore(folder / VISITS), cast("WithContext", registry.create(DETECTOR))
    found: list[Guess] = []
    for k, stand in enumerate(Cow(seed, number, visits).stands):
        if k < FIRST:
            continue
        own, others = (
            store.context(str(of), stand.at, stand.hours, stand.days)
            for of in (number, (number + 1) % cows)
        )
        shot = draw(renderer, "herd", warm(_situation(stand, seed + k)), [seed, number, k])
        answer = detector.detect_with(shot.frames, calibration, own)
        swapped = detector.detect_with(shot.frames, calibration, others)
        visible = [row.visible for row in shot.truth]
        found += judged(number, k, stand, visible, answer, swapped, own)
    return found


@cache
def _bench(seed: int) -> tuple[Renderer, Calibration]:
    rig = load_rig(find_rig(None))
    return rig_renderer(rig, seed), replace(rig.calibration, covariance=EXACT)


def _situation(stand: Stand, light: int) -> Situation:
    """The visit as a scene: a post before each hidden end that has room for one."""
    eye, found = np.mean(EYES_MM, axis=0), plain(Draw("herd-light", light, 0), stand.phantom)
    for teat in sorted(stand.hidden):
        end = stand.ends_mm[stand.teats.index(teat)]
        y = float(end[1]) - POST_MM
        x = float(eye[0] + (end[0] - eye[0]) * (y - eye[1]) / (end[1] - eye[1]))
        tall = float(end[2]) + 22.0
        post = make_object("rod", x_mm=x, y_mm=y, height_mm=tall, radius_mm=15.0)
        with_it = replace(found, objects=(*found.objects, post))
        found = found if faults(with_it) else with_it
    return found


def judged(
    cow: int,
    visit: int,
    stand: Stand,
    visible: Sequence[bool],
    answer: Detection,
    swapped: Detection,
    context: Context,
) -> Iterator[Guess]:
    """What became of each unseen end, and predictions of no teat at all."""
    ends = stand.ends_mm
    answered = [
        any(np.linalg.norm(teat.world_mm - end) < NEAR_MM / 2 for teat in answer.teats)
        for end in ends
    ]
    last = last_visit(context, answer.teats)
    for i in (i for i, shown in enumerate(visible) if not shown):
        if answered[i]:
            yield Guess(cow, visit, stand.teats[i], found=True)
            continue
        own, other = (_nearest(one, ends[i]) for one in (answer, swapped))
        before, inside, volume_ml = last.get(stand.teats[i]), None, None
        if own is not None:
            miss, covariance = own
            inside = bool(miss @ np.linalg.solve(covariance, miss) < CHI2_95_OF_3)
            root = math.sqrt(float(np.linalg.det(covariance)))
            volume_ml = 4.0 / 3.0 * math.pi * CHI2_95_OF_3**1.5 * root / 1000.0
        misses = own and own[0], None if before is None else before - ends[i], other and other[0]
        by_own, by_last, by_other = (
            None if miss is None else float(np.linalg.norm(miss)) for miss in misses
        )
        yield Guess(cow, visit, stand.teats[i], by_own, by_last, by_other, inside, volume_ml)
    for teat in answer.predicted:
        unfound = (end for end, found in zip(ends, answered, strict=True) if not found)
        if all(np.linalg.norm(teat.world_mm - end) > NEAR_MM for end in unfound):
            yield Guess(cow, visit, 0)


def _nearest(answer: Detection, end_mm: Array) -> tuple[Array, Array] | None:
    near = [
        (teat.world_mm - end_mm, teat.covariance_mm2)
        for teat in answer.predicted
        if teat.covariance_mm2 is not None and np.linalg.norm(teat.world_mm - end_mm) < NEAR_MM
    ]
    return min(near, key=lambda one: float(np.linalg.norm(one[0])), default=None)


@dataclass(frozen=True, slots=True)
class Score:
    """Of unseen ends: how many, found after all, predicted; medians in mm; shares of them."""

    visits: int
    unseen: int
    found: int
    predicted: int
    median_mm: float
    last_median_mm: float
    within_5_mm: float
    last_within_5_mm: float
    inside: float
    median_volume_ml: float
    swapped: int
    swapped_within_5_mm: float
    invented_visits: int


def score(found: Sequence[Guess], cows: int, visits: int) -> Score:
    """The herd's own table. Shares are of the unseen ends that were not found."""
    unseen = [one for one in found if one.teat and not one.found]
    own, last, swapped = (
        np.array([getattr(one, name) for one in unseen if getattr(one, name) is not None])
        for name in ("error_mm", "last_mm", "swapped_mm")
    )
    many = max(len(unseen), 1)
    inside = [one.inside for one in unseen if one.inside is not None]
    volumes = [one.volume_ml for one in unseen if one.volume_ml is not None]
    return Score(
        cows * max(visits - FIRST, 0),
        len(unseen) + sum(one.found for one in found),
        sum(one.found for one in found),
        len(own),
        _median(own),
        _median(last),
        float((own < 5.0).sum()) / many,
        float((last < 5.0).sum()) / many,
        float(np.mean(inside)) if inside else math.nan,
        _median(np.array(volumes)),
        len(swapped),
        float((swapped < 5.0).sum()) / many,
        len({(one.cow, one.visit) for one in found if not one.teat}),
    )


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else math.nan
