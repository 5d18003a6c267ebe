"""The sensitivity study: a campaign whose families are quantities at a value, and what came of it
beside what no method could beat.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import hypot
from pathlib import Path

from pydantic import field_validator

from bench.campaign.chunk import ASIDE, WRONG
from bench.campaign.ledger import LEDGER
from bench.campaign.limits import Limit, limit_at
from bench.campaign.plan import Plan
from bench.campaign.quantities import Quantity, Varied, varied
from bench.campaign.run import PLAN, Campaign, OtherCampaignError
from bench.campaign.shards import SHARDS
from bench.config import ConfigError


class Study(Plan):
    """A plan of quantities at their values: `contrast=0.12` in place of families."""

    @field_validator("families")
    @classmethod
    def _families(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if not (names and all(map(varied, names))):
            raise ValueError(f"a quantity and its value are wanted, not {', '.join(names)}")
        return names

    @staticmethod
    def names(quantities: Sequence[Quantity]) -> tuple[str, ...]:
        """All their values."""
        return tuple(Varied(one, value).family for one in quantities for value in one.values)


@dataclass(frozen=True, slots=True)
class Tally:
    """What one detector did at one value: distances of the ends it found, and counts."""

    distances_mm: tuple[float, ...] = ()
    false: int = 0
    failures: int = 0


@dataclass(frozen=True, slots=True)
class Measured:
    """One value: ends that every camera sees, what each detector found, the limit."""

    value: float
    visible: int
    tallies: Mapping[str, Tally]
    limit: Limit | None


def opened(plan: Study, folder: Path) -> Campaign:
    """The study's campaign: continued, or new in place of another study's. Raises ConfigError."""
    try:
        return Campaign(plan, folder)
    except OtherCampaignError:
        shutil.rmtree(folder / SHARDS)
        (folder / PLAN).unlink()
        (folder / LEDGER).unlink(missing_ok=True)
        return Campaign(plan, folder)


def measured(campaign: Campaign, quantity: Quantity) -> Iterator[Measured]:
    """What every detector did at each value. Raises ConfigError for a scene set aside."""
    plan, job = campaign.plan, campaign.job
    members, renderer = range(plan.first, plan.first + plan.most_scenes), job.renderer()
    for value in quantity.values:
        at = Varied(quantity, value)
        tallies = _tallies(campaign, at)
        visible, limit = limit_at(at, members, renderer, plan.seed, job.stated)
        yield Measured(value, visible, tallies, limit)


def _tallies(campaign: Campaign, at: Varied) -> dict[str, Tally]:
    """What each detector did in all scenes of a value."""
    distances: dict[str, list[float]] = {name: [] for name in campaign.job.detector_names}
    counts = dict.fromkeys(distances, (0, 0))
    with campaign.shards.connect() as db:
        for member, why in db.execute(
            "SELECT member, reason FROM scenes WHERE family = ? AND failure = ?",
            [at.family, ASIDE],
        ).fetchall():
            raise ConfigError.plain(
                f"{at.quantity.name} {at.value:g} can't be set up for member {member}: {why};"
                " choose others by --first"
            )
        for name, *error in db.execute(
            "SELECT detector, x_mm, y_mm, z_mm FROM teats WHERE family = ? AND status = 'found'"
            " ORDER BY member, teat",
            [at.family],
        ).fetchall():
            distances[name].append(hypot(*error))
        for name, false, failures in db.execute(
            "SELECT detector, sum(false_teats), count(*) FILTER (NOT list_contains(?, failure))"
            " FROM scenes WHERE family = ? GROUP BY detector",
            [["", *WRONG], at.family],
        ).fetchall():
            counts[name] = int(false), failures
    return {name: Tally(tuple(mm), *counts[name]) for name, mm in distances.items()}
