"""A campaign's page: how often each detector fails in each family, and its worst scenes by name.

All figures come from the shards, by the database.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import duckdb

from bench.campaign.chunk import ASIDE
from bench.campaign.plan import Plan
from bench.campaign.shards import Shards
from bench.report.wording import key_values, table
from bench.scoring.rates import percent, plural
from instruments.world.situations import spoken
from reports.page import Banner, Page, Paragraph, Part, Section
from reports.render import write_report

REPORT = "report"
WORST = 25  # of each detector
ORDER = "false_teats DESC, missed DESC, max_mm DESC NULLS FIRST, family, member"
FAILURES = ("no answer", "false", "missed", "error")


@dataclass(frozen=True, slots=True)
class FamilyRate:
    """Scenes of a family that a detector was asked about, how many failed and how; errors are of
    each scene's worst teat, None where nothing was found.
    """

    family: str
    detector: str
    scenes: int
    failures: int
    no_answer: int
    false: int
    missed: int
    error: int
    median_mm: float | None
    p95_mm: float | None


RATES = f"""
SELECT family, detector,
  count(*) FILTER (failure != '{ASIDE}') AS scenes,
  count(*) FILTER (failure NOT IN ('', '{ASIDE}')) AS failures,
  count(*) FILTER (failure NOT IN ('', '{ASIDE}', 'false', 'missed', 'error')) AS no_answer,
  count(*) FILTER (failure = 'false') AS false_found,
  count(*) FILTER (failure = 'missed') AS missed,
  count(*) FILTER (failure = 'error') AS error,
  quantile_cont(max_mm, 0.5), quantile_cont(max_mm, 0.95)
FROM scenes GROUP BY family, detector ORDER BY family, detector
"""
WORST_FIRST = f"""
SELECT family, member, detector, failure, found, visible, false_teats, max_mm FROM scenes
WHERE failure NOT IN ('', '{ASIDE}')
QUALIFY row_number() OVER (PARTITION BY detector ORDER BY {ORDER}) <= {WORST}
ORDER BY detector, {ORDER}
"""


def family_rates(db: duckdb.DuckDBPyConnection) -> list[FamilyRate]:
    """Every family and detector."""
    return [FamilyRate(*row) for row in db.execute(RATES).fetchall()]


def scenes_aside(db: duckdb.DuckDBPyConnection) -> dict[str, str]:
    """The scenes that the bench could not do, by name, with why."""
    found = db.execute(
        "SELECT DISTINCT family, member, reason FROM scenes WHERE failure = ? ORDER BY ALL", [ASIDE]
    )
    return {f"{family}-{member:04d}": why for family, member, why in found.fetchall()}


def write_campaign_page(folder: Path, plan: Plan, made_by: Mapping[str, str]) -> Path:
    """``report/index.html`` of the campaign in ``folder``; gives back its path. Raises OSError."""
    with Shards(folder).connect() as db:
        rates, aside = family_rates(db), scenes_aside(db)
        worst = db.execute(WORST_FIRST).fetchall()
    sections = [Section("rates", "Failures by family", (_rates(rates, plan),))]
    if aside:
        rows = tuple(aside.items())
        found = table("Scenes set aside: no detector's failure", "scene | why", rows)
        sections.append(Section("aside", "Set aside", (found,)))
    sections.append(Section("worst", "Worst scenes", (_worst(worst),)))
    asked = {"families": ", ".join(map(spoken, plan.families)), "seed": plan.seed}
    asked |= {"first member": plan.first, "limit": f"{plan.limit_mm:g} mm", **made_by}
    sections.append(Section("made", "Made with", (key_values("Plan and program", asked),)))
    return write_report(_page(plan, rates, aside, tuple(sections)), folder / REPORT)


def _page(
    plan: Plan, rates: Sequence[FamilyRate], aside: Mapping[str, str], sections: tuple[Section, ...]
) -> Page:
    names = list(dict.fromkeys(rate.detector for rate in rates))
    sums = {
        name: (
            sum(rate.failures for rate in rates if rate.detector == name),
            sum(rate.scenes for rate in rates if rate.detector == name),
        )
        for name in names
    }
    sentence = "; ".join(
        f"{name} failed on {failures} of {plural(scenes, 'scene')}"
        for name, (failures, scenes) in sums.items()
    )
    lost = f" {plural(len(aside), 'scene')} set aside." if aside else ""
    banner = Banner(
        kind="emulated",
        verdict="no verdict",
        tested=f"{', '.join(names)} on {plural(len(plan.families), 'family')}.".replace(
            "familys", "families"
        ),
        sentence=f"{sentence or 'Nothing was scored'}.{lost}",
        confidence=(
            "Rates are of simulated scenes, with their 95 % intervals family by family; a sum over"
            " families weighs them as the plan does."
        ),
        next_action="Look at the worst scenes: 'teatbench scene sheet' draws them by seed.",
    )
    title = plan.title or "Campaign"
    return Page(title, "Simulated scenes, scored without instruments", banner, sections)


def _rates(rates: Sequence[FamilyRate], plan: Plan) -> Part:
    rows = []
    for rate in rates:
        span = plan.interval(rate.failures, rate.scenes)
        rows.append(
            (
                spoken(rate.family),
                rate.detector,
                rate.scenes,
                rate.failures,
                percent(rate.failures / rate.scenes) if rate.scenes else None,
                span and f"{100 * span[0]:.2f} to {100 * span[1]:.2f} %",
                *(rate.no_answer, rate.false, rate.missed, rate.error),
                rate.median_mm,
                rate.p95_mm,
            )
        )
    if not rows:
        return Paragraph("No scene was scored.", "warn")
    how = (
        "a confidence sequence, which holds at every look"
        if plan.half_width
        else "exact (Clopper and Pearson)"
    )
    return table(
        "Failures by family and detector",
        "family | detector | >scenes | >failures | >rate | >95 % interval | >no answer | >false"
        " | >missed | >error # a teat found further off than the limit"
        " | >median [mm] # of each scene's largest error | >95 % [mm]",
        rows,
        f"A scene counts once, by the gravest: no answer, false, missed, error. Intervals: {how}.",
        searchable=len(rows) > 10,
    )


def _worst(rows: Sequence[tuple[object, ...]]) -> Part:
    if not rows:
        return Paragraph("No scene failed.")
    shown = [
        (f"{family}-{member:04d}", detector, failure, f"{found} of {visible}", false, max_mm)
        for family, member, detector, failure, found, visible, false, max_mm in rows
    ]
    return table(
        f"Worst scenes (at most {WORST} of a detector)",
        "scene | detector | failure | >found of visible | >false | >largest error [mm] ~.2f?",
        shown,
        "A scene's name is its family and the seed of the member.",
        searchable=True,
    )
