"""What a campaign's rows say: rates, teats, errors, the worst scenes, and the parameters on which
failures depend; all by the database, a million rows in less than a second.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import duckdb
from scipy.special import chdtrc

from bench.campaign.chunk import ASIDE, SHARES, SceneId
from bench.campaign.plan import CampaignPlan
from bench.campaign.shards import Shards
from bench.scoring.comparison import ALPHA, holm

WORST = 25  # of each detector, listed
MAPPED = 5000  # members of a family from which its failures are mapped
FEWEST = 8  # failures, and successes, of which a map is made
CELLS = 5  # of a map along each parameter, fewer of few scenes
FOUND = f"failure NOT IN ('', '{ASIDE}')"
ORDER = "false_teats DESC, missed DESC, max_mm DESC NULLS FIRST, family, member"


@dataclass(frozen=True, slots=True)
class FamilyRate:
    """Scenes of a family and detector, failures by kind, and sums over teats as in `SceneRow`.
    ``spread_mm``: quantiles (5, 25, 50, 75, 95 %) of each scene's largest error.
    """

    family: str
    detector: str
    scenes: int
    failures: int
    no_answer: int
    false: int
    missed: int
    error: int
    visible: int
    found: int
    false_teats: int
    sure_wrong: int
    stated: int
    inside: int
    nees: float | None
    spread_mm: Sequence[float] | None


RATES = f"""
SELECT family, detector,
  count(*) FILTER (failure != '{ASIDE}'),
  count(*) FILTER ({FOUND}),
  count(*) FILTER ({FOUND} AND failure NOT IN ('false', 'missed', 'error')),
  count(*) FILTER (failure = 'false'),
  count(*) FILTER (failure = 'missed'),
  count(*) FILTER (failure = 'error'),
  sum(visible)::BIGINT, sum(found)::BIGINT, sum(false_teats)::BIGINT, sum(sure_wrong)::BIGINT,
  sum(stated)::BIGINT, sum(inside)::BIGINT, sum(nees * stated) / sum(stated),
  quantile_cont(max_mm, [0.05, 0.25, 0.5, 0.75, 0.95])
FROM scenes GROUP BY family, detector ORDER BY family, detector
"""
WORST_OF = f"""
SELECT family, member, detector, failure, found, visible, false_teats, sure_wrong, max_mm
FROM scenes WHERE detector = ? AND {FOUND} ORDER BY {ORDER} LIMIT {WORST}
"""
TYPICAL_OF = """
SELECT family, member FROM scenes WHERE detector = ? AND failure = ''
ORDER BY abs(max_mm - ?), family, member LIMIT 1
"""
QUARTERS = f"""
SELECT family, detector, name, share // 64, count(*), count(*) FILTER (failure != '')
FROM (
  SELECT family, detector, failure, unnest(string_split(parameters, ',')) AS name,
    unnest(shares) AS share
  FROM everything WHERE member < ? AND failure != '{ASIDE}'
) GROUP BY ALL ORDER BY ALL
"""
COUNTED = f"""
SELECT x * ? // {SHARES + 1}, y * ? // {SHARES + 1}, count(*), count(*) FILTER (failure != '')
FROM (
  SELECT failure, shares[list_position(names, ?)]::INTEGER AS x,
    shares[list_position(names, ?)]::INTEGER AS y
  FROM (
    SELECT failure, shares, string_split(parameters, ',') AS names FROM everything
    WHERE family = ? AND detector = ? AND member < ? AND failure != '{ASIDE}'
  )
) WHERE x IS NOT NULL AND y IS NOT NULL GROUP BY ALL
"""


@dataclass(frozen=True, slots=True)
class FailureTrend:
    """Failures and scenes in each quarter of a parameter's range, and the chance of such counts
    (chi-square, adjusted after Holm over the family).
    """

    family: str
    detector: str
    name: str
    quarters: tuple[tuple[int, int], ...]
    p_value: float


@dataclass(frozen=True, slots=True)
class FailureMap:
    """Scenes and failures of a family in cells of two ``parameters``, rows along the second."""

    parameters: tuple[FailureTrend, FailureTrend]
    scenes: list[list[int]]
    failures: list[list[int]]


@dataclass(frozen=True, slots=True)
class Numbers:
    """The figures of a campaign's page; ``worst`` are rows of `WORST_OF` by detector."""

    rates: list[FamilyRate]
    aside: Mapping[str, str]
    worst: Mapping[str, list[tuple[object, ...]]]
    typical: SceneId | None
    parameters: list[FailureTrend]
    maps: list[FailureMap] = field(default_factory=list)

    @property
    def detectors(self) -> tuple[str, ...]:
        return tuple(self.worst)

    @property
    def families(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(rate.family for rate in self.rates))

    def of(self, detector: str) -> dict[str, FamilyRate]:
        """A detector's rates by family."""
        return {rate.family: rate for rate in self.rates if rate.detector == detector}


def family_rates(db: duckdb.DuckDBPyConnection) -> list[FamilyRate]:
    """Every family and detector."""
    return [FamilyRate(*row) for row in db.execute(RATES).fetchall()]


def scenes_aside(db: duckdb.DuckDBPyConnection) -> dict[str, str]:
    """The scenes that the bench could not do, by name, with why."""
    found = db.execute(
        "SELECT DISTINCT family, member, reason FROM scenes WHERE failure = ? ORDER BY ALL", [ASIDE]
    )
    return {f"{family}-{member:04d}": why for family, member, why in found.fetchall()}


def campaign_numbers(folder: Path, plan: CampaignPlan, detectors: Sequence[str] = ()) -> Numbers:
    """Of the shards in ``folder``; ``detectors`` are their names in the order of the page."""
    with Shards(folder).connect() as db:
        db.execute("SET parquet_metadata_cache = true")
        places = {name: place for place, name in enumerate(plan.families)}
        rates = sorted(family_rates(db), key=lambda one: places.get(one.family, len(places)))
        there = dict.fromkeys(rate.detector for rate in rates)
        names = [name for name in (*detectors, *there) if name in there]
        worst = {name: db.execute(WORST_OF, [name]).fetchall() for name in names}
        parameters = _parameters(db, plan)
        maps = [one for name in worst for one in _map(db, plan, name, parameters)]
        typical = _typical(db, next(iter(worst), ""), rates)
        return Numbers(rates, scenes_aside(db), worst, typical, parameters, maps)


def _typical(
    db: duckdb.DuckDBPyConnection, detector: str, rates: Sequence[FamilyRate]
) -> SceneId | None:
    """A success with an error in the middle of those of the families."""
    middles = sorted(
        one.spread_mm[2] for one in rates if one.spread_mm and one.detector == detector
    )
    if not middles:
        return None
    found = db.execute(TYPICAL_OF, [detector, middles[len(middles) // 2]]).fetchone()
    return SceneId(*found) if found else None


def _parameters(db: duckdb.DuckDBPyConnection, plan: CampaignPlan) -> list[FailureTrend]:
    counts: dict[tuple[str, str, str], dict[int, tuple[int, int]]] = defaultdict(dict)
    for family, detector, name, quarter, scenes, failures in db.execute(
        QUARTERS, [plan.first + MAPPED]
    ).fetchall():
        counts[family, detector, name][quarter] = failures, scenes
    groups: dict[tuple[str, str], list[FailureTrend]] = defaultdict(list)
    for (family, detector, name), by_quarter in counts.items():
        quarters = tuple(by_quarter.get(quarter, (0, 0)) for quarter in range(4))
        failed, good = sum(f for f, _ in quarters), sum(n - f for f, n in quarters)
        if min(failed, good) >= FEWEST and all(n for _, n in quarters):
            # of a failure's quarter with that of a success, 3 degrees of freedom
            share = failed / (failed + good)
            square = sum((f - share * n) ** 2 / (share * (1.0 - share) * n) for f, n in quarters)
            p_value = float(chdtrc(3, square))
            groups[family, detector].append(FailureTrend(family, detector, name, quarters, p_value))
    found: list[FailureTrend] = []
    for group in groups.values():
        group.sort(key=lambda one: one.p_value)
        adjusted = holm([one.p_value for one in group])
        found += [replace(one, p_value=p) for one, p in zip(group, adjusted, strict=True)]
    return found


def _map(
    db: duckdb.DuckDBPyConnection,
    plan: CampaignPlan,
    detector: str,
    parameters: Sequence[FailureTrend],
) -> Iterator[FailureMap]:
    """The family whose failures depend most on a parameter; none where it may be chance."""
    mine = [one for one in parameters if one.detector == detector and one.p_value < ALPHA]
    if not mine:
        return
    most = min(mine, key=lambda one: one.p_value)
    family = [one for one in parameters if (one.family, one.detector) == (most.family, detector)]
    if len(family) < 2:
        return
    first, second = family[:2]
    scenes = sum(n for _, n in first.quarters)
    cells = max(2, min(CELLS, int((scenes / FEWEST) ** 0.5)))
    all_of, failed = ([[0] * cells for _ in range(cells)] for _ in range(2))
    asked = [cells, cells, first.name, second.name, first.family, detector, plan.first + MAPPED]
    for x, y, n, failures in db.execute(COUNTED, asked).fetchall():
        all_of[y][x], failed[y][x] = n, failures
    yield FailureMap((first, second), all_of, failed)
